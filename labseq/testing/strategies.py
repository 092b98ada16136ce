"""hypothesis strategies for arrays, targets, grids, plans and tone programs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy
from numpy.typing import NDArray

from labseq.model import Batch, MotionSpec, Occupancy, Plan, SiteGrid, TargetPattern, ToneProgram

Shape: TypeAlias = tuple[int, int]


def shapes(max_shape: Shape = (6, 6)) -> SearchStrategy[Shape]:
    """Shapes (n_rows, n_cols) from (1, 1) to ``max_shape``, often single lines and sites."""
    return st.tuples(st.integers(1, max_shape[0]), st.integers(1, max_shape[1]))


def occupancies(shape: Shape | None = None, *, max_shape: Shape = (6, 6)) -> SearchStrategy[Occupancy]:
    """Any loading, including the empty and the full one, bool (n_rows, n_cols).

    Args:
        shape: The wanted shape, or None for any up to ``max_shape``.
        max_shape: The largest shape.
    """
    if shape is None:
        return shapes(max_shape).flatmap(occupancies)
    return masks(shape)


def masks(shape: Shape) -> SearchStrategy[NDArray[np.bool_]]:
    """Masks of a given shape, bool. Drawn as the bits of one number, which is quick and shrinks well."""
    n_sites = shape[0] * shape[1]

    def of_bits(bits: int) -> NDArray[np.bool_]:
        array = np.frombuffer(bits.to_bytes(n_sites // 8 + 1, "little"), np.uint8)
        return np.unpackbits(array, count=n_sites, bitorder="little").astype(np.bool_).reshape(shape)

    return st.integers(0, 2**n_sites - 1).map(of_bits)


def targets(shape: Shape | None = None, *, max_shape: Shape = (6, 6)) -> SearchStrategy[TargetPattern]:
    """Targets with any sites to be filled, cleared or neither, including targets without atoms.

    Args:
        shape: The grid's (n_rows, n_cols), or None for any up to ``max_shape``.
        max_shape: The largest shape.
    """
    if shape is None:
        return shapes(max_shape).flatmap(targets)
    pairs = st.tuples(masks(shape), masks(shape))
    return pairs.map(lambda pair: TargetPattern(pair[0], pair[1] & ~pair[0]))


@st.composite
def cases(draw: DrawFn, max_shape: Shape = (6, 6)) -> tuple[TargetPattern, Occupancy]:
    """A target and an occupancy of the same shape, as a planner gets them."""
    target = draw(targets(max_shape=max_shape))
    return target, draw(occupancies(target.shape))


@st.composite
def grids(draw: DrawFn, max_shape: Shape = (6, 6)) -> SiteGrid:
    """Grids of both lattices, up to ``max_shape``."""
    n_rows, n_cols = draw(shapes(max_shape))
    spacing_m = draw(st.floats(2e-6, 10e-6))
    lattice = draw(st.sampled_from(("triangular", "square")))
    return SiteGrid(n_rows, n_cols, spacing_m, lattice, draw(st.sampled_from((1, -1))))


@st.composite
def plans(draw: DrawFn, occupancy: Occupancy, *, max_batches: int = 4, max_tweezers: int = 20) -> Plan:
    """Legal plans for an occupancy, with batches along one line each and without ejection or links.

    In each batch some atoms of a line stay, and the atoms between two of them move to
    other sites there, in their order.

    Args:
        draw: Given by hypothesis.
        occupancy: bool (n_rows, n_cols), at the start of the plan.
        max_batches: Maximum number of batches.
        max_tweezers: Maximum number of atoms that move in a batch.
    """
    atoms = np.array(occupancy, np.bool_)
    batches: list[Batch] = []
    for _ in range(draw(st.integers(0, max_batches))):
        along_row = draw(st.booleans())
        lines = atoms if along_row else atoms.T
        line = draw(st.integers(0, len(lines) - 1))
        goals = draw(_line_moves(np.flatnonzero(lines[line]).tolist(), lines.shape[1], max_tweezers))
        if not goals:
            continue
        sites = np.array([[(line, start), (line, goal)] for start, goal in goals], np.int16)
        if not along_row:
            sites = sites[..., ::-1]
        batches.append(Batch(sites[:, 0], sites[:, 1]))
        atoms[tuple(sites[:, 0].T)] = False
        atoms[tuple(sites[:, 1].T)] = True
    return Plan.from_batches(batches)


@st.composite
def _line_moves(draw: DrawFn, atoms: list[int], n_sites: int, max_moves: int) -> list[tuple[int, int]]:
    """Moves (from, to) of some of the atoms along one line of ``n_sites``."""
    moving = draw(st.lists(st.sampled_from(atoms), unique=True, max_size=max_moves)) if atoms else []
    standing = [-1, *(atom for atom in atoms if atom not in moving), n_sites]
    moves: list[tuple[int, int]] = []
    for before, after in pairwise(standing):
        between = sorted(atom for atom in moving if before < atom < after)
        if not between:
            continue
        free = st.lists(
            st.sampled_from(range(before + 1, after)),
            unique=True,
            min_size=len(between),
            max_size=len(between),
        )
        moves += zip(between, sorted(draw(free)), strict=True)
    return [(start, goal) for start, goal in moves if start != goal]


@st.composite
def tone_programs(
    draw: DrawFn,
    *,
    grid: SiteGrid | None = None,
    motion: MotionSpec | None = None,
    max_shape: Shape = (6, 6),
) -> ToneProgram:
    """Tone programs of small legal plans, including programs without segments.

    Args:
        draw: Given by hypothesis.
        grid: The grid. Default any up to ``max_shape``.
        motion: Motion of the mobile tweezers. Default the paper's.
        max_shape: The largest grid.
    """
    from labseq.motion import tone_program

    grid = grid or draw(grids(max_shape))
    plan = draw(plans(draw(occupancies(grid.shape))))
    return tone_program(plan, grid=grid, motion=motion or MotionSpec())


def drawn(target: TargetPattern, occupancy: Occupancy) -> str:
    """Draw a case for a message, one line per row.

    Example:
        >>> target = TargetPattern([[1, 1, 0, 0, 0]], [[0, 0, 1, 1, 0]])
        >>> drawn(target, np.array([[1, 0, 1, 0, 1]], np.bool_))
        '#_!.o  (# atom in place, _ defect, ! surplus, . to be empty, o reservoir atom)'
    """
    marks = np.where(occupancy, "o", " ")
    marks = np.where(target.fill, np.where(occupancy, "#", "_"), marks)
    marks = np.where(target.clear, np.where(occupancy, "!", "."), marks)
    rows: Sequence[str] = ["".join(row) for row in marks.tolist()]
    legend = "(# atom in place, _ defect, ! surplus, . to be empty, o reservoir atom)"
    return "\n".join(rows) + ("\n" if len(rows) > 1 else "  ") + legend
