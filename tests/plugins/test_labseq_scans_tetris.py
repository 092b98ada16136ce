"""Tetris, worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from labseq_scans.planners import TetrisPlanner, TetrisSettings
from numpy.typing import NDArray

from labseq import Context, Plan, TargetPattern, check_plan

Bools = NDArray[np.bool_]


def tetris(dop: int = 7) -> TetrisPlanner:
    return TetrisPlanner(TetrisSettings(degree_of_parallelism=dop), Context())


def drawn(*rows: str) -> tuple[Bools, TargetPattern]:
    """Atoms and target of a drawing, with the marks of :func:`labseq.testing.strategies.drawn`."""
    marks = np.array([list(row) for row in rows])
    target = TargetPattern(np.isin(marks, ["#", "_"]), np.isin(marks, ["!", "."]))
    return np.isin(marks, ["#", "!", "o"]), target


def batches(plan: Plan) -> list[list[tuple[int, ...]]]:
    return [
        [tuple(move) for move in np.hstack([batch.from_sites, batch.to_sites]).tolist()]
        for batch in plan.batches
    ]


def test_the_rows_are_piled_up_from_the_top() -> None:
    atoms, target = drawn(
        " oo",
        "__o",
        "__ ",
        "oo ",
    )
    # Row 0 serves the first open row of both columns, row 1 the lower one of column 0.
    assert batches(tetris().plan(atoms, target)) == [
        [(0, 1, 0, 0), (0, 2, 0, 1)],
        [(1, 2, 1, 0)],
        [(3, 0, 2, 0)],
        [(0, 1, 1, 1), (3, 1, 2, 1)],
    ]


def test_columns_that_hold_an_atom_of_the_row_come_first() -> None:
    atoms, target = drawn(
        "__#",
        "oo ",
    )
    assert batches(tetris().plan(atoms, target)) == [[(1, 0, 0, 0)], [(1, 1, 0, 1)]]


def test_rows_are_left_alone_once_every_column_has_its_atoms() -> None:
    atoms, target = drawn("##", "o ", " o")
    assert tetris().plan(atoms, target).n_batches == 0


def test_a_row_with_more_atoms_than_allowed_takes_several_batches() -> None:
    atoms, target = drawn("  ooo", "___  ")
    assert [len(batch) for batch in tetris(2).plan(atoms, target).batches] == [2, 1, 1, 1, 1]


def test_surplus_atoms_leave_on_both_sides() -> None:
    atoms, target = drawn("!", "!", "!")
    assert batches(tetris().plan(atoms, target)) == [[(0, 0, -1, 0), (2, 0, 3, 0)], [(1, 0, -1, 0)]]


@pytest.mark.parametrize(("dop", "most_batches"), [(15, 31.0), (7, 48.5)])
def test_mean_number_of_batches_of_the_papers_array(dop: int, most_batches: float) -> None:
    fill = np.pad(np.ones((15, 15), np.bool_), ((2, 3), (2, 3)))
    target = TargetPattern(fill, np.zeros_like(fill))
    n_batches: list[int] = []
    for atoms in np.random.default_rng(1).random((200, 20, 20)) < 0.75:
        plan = tetris(dop).plan(atoms, target)
        assert check_plan(plan, atoms, target, dop).meets_target
        n_batches.append(plan.n_batches)
    assert np.mean(n_batches) <= most_batches
