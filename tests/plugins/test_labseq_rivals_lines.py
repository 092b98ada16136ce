"""MTA1, Tetris and the interleaved pattern; tests/plugins/test_planners.py has what all planners promise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from labseq_rivals.interleaved import InterleavedSettings, interleaved
from labseq_rivals.planners import ScannedPlan
from pydantic import ValidationError

from labseq.plugin import Context, LimitError, MotionSpec, Plan, SiteGrid, TargetPattern
from labseq.plugin.planning import check_plan

from .planning import Bools, loadings, mta1, tetris

EBADI = MotionSpec(
    pick_up_s=15e-6, drop_off_s=15e-6, speed_m_s=0.075, overhead_per_batch_s=0.0, overhead_per_cycle_s=0.0
)


def read(rows: Sequence[str]) -> tuple[Bools, TargetPattern]:
    """Atoms and target of a drawing, with the marks of :func:`labseq.testing.strategies.drawn`."""
    marks = np.array([list(row) for row in rows])
    target = TargetPattern(np.isin(marks, ["#", "_"]), np.isin(marks, ["!", "."]))
    return np.isin(marks, ["#", "!", "o"]), target


def scan(*rows: str, dop: int = 7) -> ScannedPlan:
    return mta1(Context(), dop).scan(*read(rows))


def batches(plan: Plan) -> list[list[tuple[int, ...]]]:
    return [
        [tuple(move) for move in np.hstack([batch.from_sites, batch.to_sites]).tolist()]
        for batch in plan.batches
    ]


MTA1_PLANS: dict[str, tuple[tuple[str, ...], list[list[tuple[int, ...]]], list[int]]] = {
    # Left of column 1 there are two to spare; right of it two, but column 2 lacks one.
    "the side with more atoms to spare": (
        ("o_# ", "o##o", "  _o"),
        [[(0, 0, 0, 1)], [(2, 3, 2, 2)]],
        [2, 2],
    ),
    "the same, mirrored": ((" #_o", "o##o", "o_  "), [[(2, 0, 2, 1)], [(0, 3, 0, 2)]], [2, 2]),
    # Column 0 takes the atom of column 1, which then takes the nearest from column 2.
    "the nearest atoms, even of a column that then lacks one": (
        ("_#oo", "# oo"),
        [[(0, 1, 0, 0)], [(0, 2, 0, 1)]],
        [2, 2],
    ),
    "one scan gathers atoms of several columns": (
        ("_o  ", "_ o ", "_ o ", "_  o"),
        [[(3, 3, 3, 0)], [(1, 2, 1, 0), (2, 2, 2, 0)], [(0, 1, 0, 0)]],
        [4],
    ),
    "one atom of each column after the other": (
        ("oo", "__", "o ", "_ "),
        [[(0, 0, 1, 0), (0, 1, 1, 1)], [(2, 0, 3, 0)]],
        [4],
    ),
    "a blocked atom waits for a scan": (
        ("o", "o", "_", "_"),
        [[(1, 0, 3, 0)], [(0, 0, 2, 0)]],
        [4, 4],
    ),
    "a blocked atom goes as far as it can": (
        ("o", " ", "o", "_", "_"),
        [[(0, 0, 1, 0)], [(2, 0, 4, 0)], [(1, 0, 3, 0)]],
        [5, 5],
    ),
    "downward scans come before upward ones": (("_o", "o_"), [[(0, 1, 1, 1)], [(1, 0, 0, 0)]], [2, 2]),
    "surplus atoms leave below the last row, the lowest first": (
        ("!.", "!!", "#_"),
        [[(1, 1, 2, 1)], [(2, 0, 3, 0)], [(1, 0, 3, 0)], [(0, 0, 2, 0)]],
        [4, 4, 3],
    ),
}


@pytest.mark.parametrize("case", MTA1_PLANS)
def test_scans_of_mta1(case: str) -> None:
    rows, moves, lines_passed = MTA1_PLANS[case]
    scanned = scan(*rows)
    assert batches(scanned.plan) == moves
    assert scanned.lines_passed.tolist() == lines_passed
    assert scanned.n_scans == len(lines_passed)


def test_no_more_tweezers_than_allowed_are_on_in_a_scan() -> None:
    assert scan("ooo", "   ", "___", dop=3).n_scans == 1
    scanned = scan("ooo", "   ", "___", dop=2)
    assert batches(scanned.plan) == [[(0, 0, 2, 0), (0, 1, 2, 1)], [(0, 2, 2, 2)]]
    assert scanned.n_scans == 2
    assert scan("_o  ", "_ o ", "_ o ", "_  o", dop=2).lines_passed.tolist() == [3, 4]


def test_a_scan_waits_on_every_line() -> None:
    scanned = ScannedPlan(Plan.from_batches([]), np.array([3, 5]))
    grid = SiteGrid(5, 5, spacing_m=7.5e-6)
    assert scanned.duration_s(grid, EBADI) == pytest.approx(8 * 15e-6 + 6 * 100e-6)
    assert ScannedPlan(Plan.from_batches([]), np.zeros(0, np.int64)).duration_s(grid, EBADI) == 0.0


def test_where_presorting_does_not_help_rows_exchange_atoms() -> None:
    atoms, target = read(("_##", "_##", "  o", "  o"))
    scanned = mta1(Context(), 7).scan(atoms, target)
    assert check_plan(scanned.plan, atoms, target, 7).meets_target
    assert (scanned.lines_passed > 1).all()


def test_scans_of_the_sources_geometry() -> None:
    grid = SiteGrid(33, 16)
    target = interleaved(InterleavedSettings(rows=16, cols=16), grid)
    planner = mta1(Context(grid=grid, motion=EBADI), 16)
    n_scans: list[int] = []
    for atoms in loadings(30, (33, 16), 0.55):
        scanned = planner.scan(atoms, target)
        assert check_plan(scanned.plan, atoms, target, 16, grid=grid, motion=EBADI).meets_target
        for batch in scanned.plan.batches:
            lines = [batch.from_sites, batch.to_sites]
            assert min(max(len(np.unique(ends[:, axis])) for ends in lines) for axis in (0, 1)) == 1
        assert set(scanned.lines_passed.tolist()) <= set(range(2, 17)) | {33}
        n_scans.append(scanned.n_scans)
    assert np.mean(n_scans) == pytest.approx(17.4, abs=0.5)


TETRIS_PLANS: dict[str, tuple[tuple[str, ...], list[list[tuple[int, ...]]]]] = {
    # Row 0 serves the first open row of both columns, row 1 the lower one of column 0.
    "rows are piled up from the top": (
        (" oo", "__o", "__ ", "oo "),
        [[(0, 1, 0, 0), (0, 2, 0, 1)], [(1, 2, 1, 0)], [(3, 0, 2, 0)], [(0, 1, 1, 1), (3, 1, 2, 1)]],
    ),
    "columns that hold an atom of the row come first": (("__#", "oo "), [[(1, 0, 0, 0)], [(1, 1, 0, 1)]]),
    "rows stay as they are once every column has its atoms": (("##", "o ", " o"), []),
    "surplus atoms leave on both sides": (("!", "!", "!"), [[(0, 0, -1, 0), (2, 0, 3, 0)], [(1, 0, -1, 0)]]),
}


@pytest.mark.parametrize("case", TETRIS_PLANS)
def test_batches_of_tetris(case: str) -> None:
    rows, moves = TETRIS_PLANS[case]
    assert batches(tetris(Context(), 7).plan(*read(rows))) == moves


def test_a_row_with_more_atoms_than_allowed_takes_several_batches() -> None:
    plan = tetris(Context(), 2).plan(*read(("  ooo", "___  ")))
    assert [len(batch) for batch in plan.batches] == [2, 1, 1, 1, 1]


def test_an_interleaved_pattern_is_centred_with_reservoir_around() -> None:
    target = interleaved(InterleavedSettings(rows=16, cols=16), SiteGrid(33, 18))
    rows, cols = np.nonzero(target.fill)
    assert sorted(set(rows.tolist())) == list(range(1, 33, 2))
    assert sorted(set(cols.tolist())) == list(range(1, 17))
    assert not target.clear.any()


def test_wider_gaps_an_origin_and_rows_between_to_be_cleared() -> None:
    made = InterleavedSettings(rows=2, cols=2, reservoir_rows=2, origin=(0, 1), clear="bounding_box")
    target = interleaved(made, SiteGrid(5, 3))
    assert target.fill.astype(int).tolist() == [[0, 1, 1], [0] * 3, [0] * 3, [0, 1, 1], [0] * 3]
    assert target.clear.astype(int).tolist() == [[0] * 3, [0, 1, 1], [0, 1, 1], [0] * 3, [0] * 3]
    compact = interleaved(InterleavedSettings(rows=3, cols=2, reservoir_rows=0), SiteGrid(3, 2))
    assert compact.fill.all()


def test_an_interleaved_pattern_that_does_not_fit_is_refused() -> None:
    with pytest.raises(LimitError, match="31 rows x 16 columns"):
        interleaved(InterleavedSettings(rows=16, cols=16), SiteGrid(20, 20))
    wrong: dict[str, Any] = {"rows": 0, "cols": 1}
    with pytest.raises(ValidationError):
        InterleavedSettings(**wrong)
