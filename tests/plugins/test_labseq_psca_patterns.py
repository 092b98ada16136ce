"""PSCA ends every pattern right, by a replay that uses nothing of labseq."""

from __future__ import annotations

import os
import runpy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_psca.planner import PscaPlanner, PscaSettings
from numpy.typing import NDArray

from labseq import Context, LimitError, SiteGrid, TargetPattern, make_target

ROOT = Path(__file__).parents[2]
N_SEEDS = int(os.environ.get("LABSEQ_SEEDS", "3"))

replay: Callable[[dict[str, Any]], None] = runpy.run_path(str(ROOT / "tests" / "system" / "replay.py"))[
    "replay"
]

EVERYWHERE: dict[str, dict[str, Any]] = {
    "compact": {"rows": 15, "cols": 15},
    "checkerboard": {"rows": 15, "cols": 15},
    "checkerboard of the whole grid": {"rows": 20, "cols": 20},
    "sierpinski": {"order": 4},
    "sierpinski at a corner": {"order": 4, "origin": (4, 4)},
    "ring": {"radius": 7},
    "bitmap": {"file": str(ROOT / "sequences" / "lion_head.txt")},
}
TRIANGULAR: dict[str, dict[str, Any]] = {
    "kagome": {"rows": 15, "cols": 15},
    "honeycomb": {"rows": 15, "cols": 15},
    "honeycomb of the whole grid": {"rows": 20, "cols": 20},
    "link_kagome": {"rows": 17, "cols": 17},
}
GRIDS = {
    "triangular": SiteGrid(),
    "mirrored": SiteGrid(shear=-1),
    "square": SiteGrid(lattice="square"),
}
CASES = [
    pytest.param(name, values, GRIDS[grid], id=f"{name}, {grid}")
    for grid in GRIDS
    for name, values in (EVERYWHERE if grid == "square" else EVERYWHERE | TRIANGULAR).items()
]


def play(atoms: NDArray[np.bool_], target: TargetPattern, grid: SiteGrid, dop: int = 7) -> None:
    """Plan, and replay the plan with the array that is expected at its end."""
    planner = PscaPlanner(PscaSettings(degree_of_parallelism=dop), Context(grid=grid))
    plan = planner.plan(atoms, target)
    after = atoms.copy()
    for batch in plan.batches:
        inside = np.logical_and(batch.to_sites >= 0, batch.to_sites < grid.shape).all(axis=1)
        after[tuple(batch.from_sites.T)] = False
        after[tuple(batch.to_sites[inside].T)] = True
    replay(
        {
            "grid": {"n_rows": grid.n_rows, "n_cols": grid.n_cols},
            "degree_of_parallelism": dop,
            "occupancy": atoms.tolist(),
            "target": {"fill": target.fill.tolist(), "clear": target.clear.tolist()},
            "n_batches": plan.n_batches,
            "n_atom_moves": plan.n_atom_moves,
            "batches": [
                {"from": b.from_sites.tolist(), "to": b.to_sites.tolist(), "linked": b.linked}
                for b in plan.batches
            ],
            "predicted": after.tolist(),
        }
    )


def make(name: str, grid: SiteGrid, values: dict[str, Any]) -> TargetPattern:
    return make_target(name.partition(" ")[0], grid=grid, **values)


def exactly(n_atoms: int, order: NDArray[np.intp], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Atoms on the first sites of an order of all sites."""
    atoms = np.zeros(shape, np.bool_)
    atoms.flat[order[:n_atoms]] = True
    return atoms


def extremes(target: TargetPattern, rng: np.random.Generator) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Loadings with enough atoms, and some with exactly enough of them."""
    shape, n_sites, n_atoms = target.shape, target.fill.size, target.n_atoms
    shuffled = rng.permutation(n_sites)
    column_by_column = np.arange(n_sites).reshape(shape).T[::-1].ravel()
    off_target = shuffled[np.argsort(target.fill.flat[shuffled], kind="stable")]
    yield "full", np.ones(shape, np.bool_)
    yield "all but one", exactly(n_sites - 1, shuffled, shape)
    yield "exactly enough, anywhere", exactly(n_atoms, shuffled, shape)
    yield "exactly enough, from the top", exactly(n_atoms, np.arange(n_sites), shape)
    yield "exactly enough, from the right", exactly(n_atoms, column_by_column, shape)
    yield "exactly enough, where they are not wanted", exactly(n_atoms, off_target, shape)
    yield "met already", target.fill.copy()
    yield "one too few", exactly(n_atoms - 1, shuffled, shape)


@pytest.mark.parametrize(("name", "values", "grid"), CASES)
def test_every_loading_with_enough_atoms_ends_right(
    name: str, values: dict[str, Any], grid: SiteGrid
) -> None:
    target = make(name, grid, values)
    for seed in range(N_SEEDS):
        atoms = np.random.default_rng(seed).random(grid.shape) < 0.75
        play(atoms, target, grid, dop=(7, 2, 15)[seed % 3])


@pytest.mark.parametrize(("name", "values", "grid"), CASES)
def test_extreme_loadings_end_right(name: str, values: dict[str, Any], grid: SiteGrid) -> None:
    target = make(name, grid, values)
    for seed in range(N_SEEDS):
        for loading, atoms in extremes(target, np.random.default_rng(seed)):
            try:
                play(atoms, target, grid)
            except Exception as error:
                raise AssertionError(f"{loading}, seed {seed}: {error}") from error


@st.composite
def patterns(draw: st.DrawFn) -> tuple[TargetPattern, SiteGrid]:
    """A pattern of any kind, size and place that fits on a small grid."""
    grid = SiteGrid(draw(st.integers(2, 9)), draw(st.integers(2, 9)), shear=draw(st.sampled_from((1, -1))))
    name = draw(
        st.sampled_from(
            ("checkerboard", "compact", "honeycomb", "kagome", "link_kagome", "ring", "sierpinski")
        )
    )
    rows, cols = draw(st.integers(1, grid.n_rows)), draw(st.integers(1, grid.n_cols))
    values: dict[str, Any] = {"rows": rows, "cols": cols}
    values["origin"] = draw(st.tuples(st.integers(0, grid.n_rows - rows), st.integers(0, grid.n_cols - cols)))
    if name != "compact":
        values["clear"] = draw(st.sampled_from(("bounding_box", "none")))
    try:
        return make_target(name, grid=grid, **values), grid
    except LimitError:  # a single site may be one that the pattern leaves out
        return make_target("compact", grid=grid, rows=rows, cols=cols), grid


@given(patterns(), st.randoms(use_true_random=False), st.integers(1, 9))
@settings(max_examples=75, deadline=None)
def test_any_size_and_place_ends_right(case: tuple[TargetPattern, SiteGrid], random: Any, dop: int) -> None:
    target, grid = case
    n_sites = target.fill.size
    order = np.array(random.sample(range(n_sites), n_sites))
    play(exactly(random.randint(target.n_atoms, n_sites), order, grid.shape), target, grid, dop)
