"""MTA1's scans, worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from labseq_scans.pattern import InterleavedSettings, interleaved
from labseq_scans.planners import Mta1Planner, Mta1Settings, ScannedPlan
from numpy.typing import NDArray

from labseq import Context, MotionSpec, Plan, SiteGrid, TargetPattern, check_plan

Bools = NDArray[np.bool_]
EBADI = MotionSpec(
    pick_up_s=15e-6, drop_off_s=15e-6, speed_m_s=0.075, overhead_per_batch_s=0.0, overhead_per_cycle_s=0.0
)


def mta1(dop: int = 7) -> Mta1Planner:
    return Mta1Planner(Mta1Settings(degree_of_parallelism=dop), Context())


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


def test_the_side_with_more_atoms_to_spare_supplies_a_column() -> None:
    rows = ("o_# ", "o##o", "  _o")
    # Left of column 1 there are two to spare; right of it two, but column 2 lacks one.
    atoms, target = drawn(*rows)
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 0, 0, 1)], [(2, 3, 2, 2)]]
    assert scanned.lines_passed.tolist() == [2, 2]
    atoms, target = drawn(*(row[::-1] for row in rows))
    assert batches(mta1().plan(atoms, target)) == [[(2, 0, 2, 1)], [(0, 3, 0, 2)]]


def test_the_nearest_atoms_come_first_and_their_columns_may_lack_atoms_afterwards() -> None:
    atoms, target = drawn(
        "_#oo",
        "# oo",
    )
    # Column 0 takes the atom of column 1, which then takes the nearest from column 2.
    assert batches(mta1().plan(atoms, target)) == [[(0, 1, 0, 0)], [(0, 2, 0, 1)]]


def test_a_horizontal_scan_gathers_atoms_of_several_columns() -> None:
    atoms, target = drawn(
        "_o  ",
        "_ o ",
        "_ o ",
        "_  o",
    )
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [
        [(3, 3, 3, 0)],
        [(1, 2, 1, 0), (2, 2, 2, 0)],
        [(0, 1, 0, 0)],
    ]
    assert scanned.lines_passed.tolist() == [4]
    assert mta1(2).scan(atoms, target).lines_passed.tolist() == [3, 4]


def test_a_scan_moves_one_atom_of_each_column_after_the_other() -> None:
    atoms, target = drawn(
        "oo",
        "__",
        "o ",
        "_ ",
    )
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 0, 1, 0), (0, 1, 1, 1)], [(2, 0, 3, 0)]]
    assert scanned.lines_passed.tolist() == [4]


def test_a_blocked_atom_waits_for_the_next_scan() -> None:
    atoms, target = drawn("o", "o", "_", "_")
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(1, 0, 3, 0)], [(0, 0, 2, 0)]]
    assert scanned.lines_passed.tolist() == [4, 4]


def test_a_blocked_atom_goes_as_far_as_it_can() -> None:
    atoms, target = drawn("o", " ", "o", "_", "_")
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 0, 1, 0)], [(2, 0, 4, 0)], [(1, 0, 3, 0)]]
    assert scanned.n_scans == 2


def test_downward_scans_come_before_upward_ones() -> None:
    atoms, target = drawn(
        "_o",
        "o_",
    )
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 1, 1, 1)], [(1, 0, 0, 0)]]
    assert scanned.lines_passed.tolist() == [2, 2]


def test_surplus_atoms_leave_below_the_last_row_lowest_first() -> None:
    atoms, target = drawn(
        "!.",
        "!!",
        "#_",
    )
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(1, 1, 2, 1)], [(2, 0, 3, 0)], [(1, 0, 3, 0)], [(0, 0, 2, 0)]]
    assert scanned.lines_passed.tolist() == [4, 4, 3]


def test_no_more_tweezers_than_allowed_are_on_in_a_scan() -> None:
    atoms, target = drawn("ooo", "   ", "___")
    assert mta1(3).scan(atoms, target).n_scans == 1
    scanned = mta1(2).scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 0, 2, 0), (0, 1, 2, 1)], [(0, 2, 2, 2)]]
    assert scanned.n_scans == 2


def test_a_scan_waits_on_every_line() -> None:
    scanned = ScannedPlan(Plan.from_batches([]), np.array([3, 5]))
    grid = SiteGrid(5, 5, spacing_m=7.5e-6)
    assert scanned.duration_s(grid, EBADI) == pytest.approx(8 * 15e-6 + 6 * 100e-6)
    assert ScannedPlan(Plan.from_batches([]), np.zeros(0, np.int64)).duration_s(grid, EBADI) == 0.0


def test_where_no_row_of_a_side_helps_columns_are_supplied_all_the_same() -> None:
    atoms, target = drawn(
        "_##",
        "_##",
        "  o",
        "  o",
    )
    scanned = mta1().scan(atoms, target)
    report = check_plan(scanned.plan, atoms, target, 7)
    assert report.meets_target
    assert scanned.duration_s(SiteGrid(4, 3), EBADI) > 0


def test_scans_of_the_sources_geometry() -> None:
    grid = SiteGrid(33, 16)
    target = interleaved(InterleavedSettings(rows=16, cols=16), grid)
    planner = Mta1Planner(Mta1Settings(degree_of_parallelism=16), Context(grid=grid, motion=EBADI))
    n_scans: list[int] = []
    for atoms in np.random.default_rng(1).random((100, 33, 16)) < 0.55:
        scanned = planner.scan(atoms, target)
        assert check_plan(scanned.plan, atoms, target, 16, grid=grid, motion=EBADI).meets_target
        for batch in scanned.plan.batches:
            lines = [batch.from_sites, batch.to_sites]
            assert min(max(len(np.unique(ends[:, axis])) for ends in lines) for axis in (0, 1)) == 1
        assert set(scanned.lines_passed.tolist()) <= set(range(2, 17)) | {33}
        n_scans.append(scanned.n_scans)
    assert np.mean(n_scans) == pytest.approx(17.4, abs=0.5)
