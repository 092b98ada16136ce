"""What each batch of a plan does, for people."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from labseq.model import Batch, Occupancy, Plan

Axis = Literal["row", "column"]


@dataclass(frozen=True, slots=True)
class BatchSummary:
    """A batch in a few numbers.

    Attributes:
        axis: Whether its atoms move along rows or along columns.
        lines: The rows, or the columns, that they move along; sorted.
        n_atoms: How many atoms move.
        n_ejected: How many of them leave the grid.
        n_sites: The longest way, in sites.
    """

    axis: Axis
    lines: tuple[int, ...]
    n_atoms: int
    n_ejected: int
    n_sites: int


def summarise_batches(plan: Plan, shape: tuple[int, int]) -> list[BatchSummary]:
    """Sum up each batch of a checked plan.

    Args:
        plan: The plan.
        shape: (n_rows, n_cols) of the grid.

    Example:
        >>> summarise_batches(Plan.from_batches([([(2, 0), (2, 1)], [(2, 3), (2, 4)])]), (5, 4))
        [BatchSummary(axis='row', lines=(2,), n_atoms=2, n_ejected=1, n_sites=3)]
    """
    return [_summarise(batch, shape) for batch in plan.batches]


def _summarise(batch: Batch, shape: tuple[int, int]) -> BatchSummary:
    way = batch.to_sites - batch.from_sites
    axis: Axis = "column" if way[:, 0].any() else "row"
    lines = np.unique(batch.from_sites[:, 1 if axis == "column" else 0])
    return BatchSummary(
        axis=axis,
        lines=tuple(lines.tolist()),
        n_atoms=len(batch),
        n_ejected=int(np.count_nonzero(~on_grid(batch.to_sites, shape))),
        n_sites=int(np.abs(way).max(initial=0)),
    )


def on_grid(sites: NDArray[np.integer], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Which sites are on the grid.

    Args:
        sites: (n, 2), row and column.
        shape: (n_rows, n_cols) of the grid.

    Returns:
        bool (n,).
    """
    inside = (sites >= 0) & (sites < shape)
    return inside[:, 0] & inside[:, 1]


def occupancies(plan: Plan, occupancy: Occupancy) -> list[Occupancy]:
    """The occupancy before each batch, and after the last: n_batches + 1 of them.

    Args:
        plan: A plan that was checked for this occupancy.
        occupancy: bool (n_rows, n_cols), before the plan.

    Example:
        >>> plan = Plan.from_batches([([(0, 0), (0, 1)], [(0, 1), (0, 2)])])
        >>> [a.astype(int).tolist() for a in occupancies(plan, np.array([[True, True, False]]))]
        [[[1, 1, 0]], [[0, 1, 1]]]
    """
    before = [occupancy]
    for batch in plan.batches:
        atoms = before[-1].copy()
        atoms[tuple(batch.from_sites.T)] = False
        atoms[tuple(batch.to_sites[on_grid(batch.to_sites, occupancy.shape)].T)] = True
        before.append(atoms)
    return before


def lines_label(axis: Axis, lines: Iterable[int]) -> str:
    """Name rows or columns, counted from 0.

    Example:
        >>> lines_label("row", [7]), lines_label("column", [2, 3, 4, 9])
        ('row 7', 'columns 2-4, 9')
    """
    numbers = sorted(set(lines))
    starts = [n for n, before in zip(numbers, [None, *numbers], strict=False) if before != n - 1]
    bounds = pairwise([*starts, 1 << 31])
    spans = [[n for n in numbers if start <= n < stop] for start, stop in bounds]
    words = [str(span[0]) if span[0] == span[-1] else f"{span[0]}-{span[-1]}" for span in spans]
    return f"{axis}{'s' if len(numbers) > 1 else ''} {', '.join(words)}"
