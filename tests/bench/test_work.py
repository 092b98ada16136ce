from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from labseq import Plan
from labseq.assembly.occupancies import read_source
from labseq.bench.comparison import Comparison, Condition, PlannerEntry
from labseq.bench.work import Job, PreparedCondition, draw, lines_to_cover, loading_seed, set_up, work


def fewest_lines(vacancies: NDArray[np.bool_]) -> int:
    """Try every set of rows; the columns of what is left must all be covered."""
    n_rows = len(vacancies)
    return min(
        n + int(np.delete(vacancies, rows, axis=0).any(axis=0).sum())
        for n in range(n_rows + 1)
        for rows in combinations(range(n_rows), n)
    )


@settings(deadline=None)  # the first one imports scipy
@given(
    st.tuples(st.integers(1, 4), st.integers(1, 5), st.integers(1, 5)).flatmap(
        lambda shape: arrays(np.bool_, shape)
    )
)
def test_the_bound_is_the_fewest_lines_that_cover_all_vacancies(vacancies: NDArray[np.bool_]) -> None:
    assert lines_to_cover(vacancies).tolist() == [fewest_lines(one) for one in vacancies]


@given(st.integers(0, 2**64), st.integers(0, 20))
def test_loadings_are_seeded_by_the_children_of_the_seed(seed: int, index: int) -> None:
    child = np.random.SeedSequence(seed).spawn(index + 1)[index]
    assert loading_seed(seed, index) == child.generate_state(1)[0]


def test_a_loading_is_what_labseq_plan_draws() -> None:
    source = read_source("random:7x9@0.6", loading_seed(3, 12))
    assert np.array_equal(draw((7, 9), 0.6, 3, 12), source.occupancy)


def test_loadings_differ_from_one_another_and_fill_as_asked() -> None:
    drawn = np.array([draw((20, 20), 0.75, 1, index) for index in range(200)])
    assert len({one.tobytes() for one in drawn}) == 200
    assert drawn.mean() == pytest.approx(0.75, abs=0.01)


class Scripted:
    """A planner that returns a given plan, or raises a given error."""

    degree_of_parallelism = 1

    def __init__(self, made: Any) -> None:
        self.made = made

    def plan(self, occupancy: Any, target: Any) -> Any:
        if isinstance(self.made, Exception):
            raise self.made
        return self.made


def course_with(planner: Any) -> PreparedCondition:
    condition = Condition(
        (4, 4), "{pattern: compact, rows: 2, cols: 2}", loading=1.0, degree_of_parallelism=1
    )
    (course,) = set_up(Comparison((PlannerEntry("psca"),), (condition,), 3, 1))
    return replace(course, runners=(replace(course.runners[0], planner=planner),))


L_SHAPE = Plan(
    np.array([[0, 0, -1, 0], [0, 1, -1, 1], [1, 1, 0, 1], [0, 1, 0, 0]], np.int16),
    np.arange(5, dtype=np.int32),
    np.array([False, False, False, True]),
)


def test_linked_batches_count_as_one() -> None:
    done = work([course_with(Scripted(L_SHAPE))], 1, Job(0, 0, 2))
    result = done.results[0, 0]
    assert not result["failed"]
    assert (result["n_batches"], result["n_atoms_moved"]) == (3, 3)
    assert result["distance_m"] == pytest.approx(4 * 4.49e-6)
    assert result["motion_s"] == pytest.approx(3 * 120e-6 + 4 * 4.49e-6 / 0.130)
    assert np.isnan(result["n_scans"])
    assert result["n_defects"] == 1


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (ValueError("odd"), "plan() raised ValueError: odd"),
        (RuntimeError(), "plan() raised RuntimeError"),
        (None, "makes one), not NoneType"),
        (Plan.from_batches([([(0, 0)], [(0, 1)])]), "breaks the rule 'goal'"),
    ],
)
def test_what_a_planner_does_wrong_is_counted(made: Any, words: str) -> None:
    done = work([course_with(Scripted(made))], 1, Job(0, 1, 3))
    assert done.results["failed"].all()
    (failure,) = done.failures
    assert (failure.planner_entry, failure.condition, failure.loading) == (0, 0, 1)
    assert words in failure.message


class Scanning(Scripted):
    def scan(self, occupancy: Any, target: Any) -> Any:
        plan = self.made

        class Scanned:
            n_scans = 2

            def __init__(self) -> None:
                self.plan = plan

            def duration_s(self, grid: Any, motion: Any) -> float:
                return grid.n_rows * motion.pick_up_s

        return Scanned()


def test_scans_are_counted_as_their_source_counts_them() -> None:
    result = work([course_with(Scanning(L_SHAPE))], 1, Job(0, 0, 1)).results[0, 0]
    assert (result["n_batches"], result["n_scans"]) == (3, 2)
    assert result["scan_s"] == pytest.approx(4 * 60e-6)


class Writing(Scripted):
    def plan(self, occupancy: Any, target: Any) -> Any:
        occupancy[:] = False
        return Plan.from_batches([])


def test_a_planner_that_writes_into_its_input_harms_only_itself() -> None:
    done = work([course_with(Writing(None))], 1, Job(0, 0, 1))
    assert not done.results["failed"].any()
    assert done.results["n_defects"].tolist() == [[0]]
    assert done.loadings["n_atoms"].tolist() == [16]
