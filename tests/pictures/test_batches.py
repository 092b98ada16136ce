from __future__ import annotations

import numpy as np
from hypothesis import given, settings, strategies as st
from hypothesis.strategies import DataObject

from labseq.model import MotionSpec, Plan, SiteGrid, TargetPattern
from labseq.motion import check_plan
from labseq.pictures.plans import lines_label, occupancies, on_grid, summarise_batches
from labseq.testing import strategies


@settings(deadline=None)
@given(st.data())
def test_the_last_occupancy_is_the_one_that_the_check_predicts(data: DataObject) -> None:
    before = data.draw(strategies.occupancies())
    plan = data.draw(strategies.plans(before))
    nothing = np.zeros_like(before)
    grid = SiteGrid(*before.shape)
    report = check_plan(plan, before, TargetPattern(nothing, nothing), 20, grid, MotionSpec(), "any")
    shown = occupancies(plan, before)
    assert len(shown) == plan.n_batches + 1
    assert np.array_equal(shown[0], before)
    assert np.array_equal(shown[-1], report.predicted)


@settings(deadline=None)
@given(st.data())
def test_a_story_counts_what_moves(data: DataObject) -> None:
    before = data.draw(strategies.occupancies())
    plan = data.draw(strategies.plans(before))
    for summary, batch in zip(summarise_batches(plan, before.shape), plan.batches, strict=True):
        assert (summary.n_atoms, summary.n_ejected) == (len(batch), 0)
        assert summary.n_sites == int(np.abs(batch.to_sites - batch.from_sites).sum(axis=1).max())
        column = 1 if summary.axis == "column" else 0
        assert set(summary.lines) == set(batch.from_sites[:, column].tolist())
        assert np.array_equal(batch.from_sites[:, column], batch.to_sites[:, column])


def test_ejected_atoms_leave_the_array() -> None:
    plan = Plan.from_batches([([(0, 0), (0, 2)], [(0, -1), (0, 3)])])
    (summary,) = summarise_batches(plan, (1, 3))
    assert (summary.n_ejected, summary.n_sites) == (2, 1)
    assert occupancies(plan, np.ones((1, 3), np.bool_))[1].tolist() == [[False, True, False]]


def test_sites_on_and_off_the_grid() -> None:
    sites = np.array([[0, 0], [-1, 0], [0, 3], [1, 2], [2, 2]])
    assert on_grid(sites, (2, 3)).tolist() == [True, False, False, True, False]


@settings(deadline=None)
@given(st.sets(st.integers(0, 30), min_size=1))
def test_line_words_name_every_line_once(lines: set[int]) -> None:
    words = lines_label("row", lines)
    spans = words.split(" ", 1)[1].split(", ")
    named = [n for span in spans for n in range(int(span.split("-")[0]), int(span.split("-")[-1]) + 1)]
    assert named == sorted(lines)
    assert words.startswith("rows " if len(lines) > 1 else "row ")
