from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.model import Plan, PlanReport
from labseq.motion import fitting_batches
from labseq.motion.tones import default_grid


def report(ends: list[float]) -> PlanReport:
    return PlanReport(np.zeros((1, 1), np.bool_), np.array(ends), np.ones(len(ends), np.int32), 0, 0)


def plan(linked: list[bool]) -> Plan:
    n = len(linked)
    return Plan(np.zeros((n, 4), np.int16), np.arange(n + 1, dtype=np.int32), np.array(linked, np.bool_))


@pytest.mark.parametrize(
    ("window_s", "expected"), [(0.0, 0), (0.9, 0), (1.0, 1), (2.5, 2), (3.0, 3), (9.0, 3)]
)
def test_batches_that_end_within_the_window(window_s: float, expected: int) -> None:
    assert fitting_batches(report([1.0, 2.0, 3.0]), plan([False] * 3), window_s) == expected


@pytest.mark.parametrize(("window_s", "expected"), [(1.0, 1), (2.0, 1), (3.0, 1), (4.0, 4), (5.0, 5)])
def test_a_chain_is_never_cut(window_s: float, expected: int) -> None:
    linked = [False, False, True, True, False]
    assert fitting_batches(report([1.0, 2.0, 3.0, 4.0, 5.0]), plan(linked), window_s) == expected


def test_rounding_of_sums_does_not_cost_a_batch() -> None:
    assert fitting_batches(report([0.1 + 0.2]), plan([False]), 0.3) == 1


def test_an_empty_plan() -> None:
    assert fitting_batches(report([]), plan([]), 1.0) == 0


@given(st.lists(st.booleans(), max_size=8), st.floats(0, 10))
def test_as_many_as_possible(linked: list[bool], window_s: float) -> None:
    linked = [False, *linked]
    ends = [float(i + 1) for i in range(len(linked))]
    n = fitting_batches(report(ends), plan(linked), window_s)
    cuts = [k for k in range(1, len(linked) + 1) if k == len(linked) or not linked[k]]
    assert n == max([0, *(k for k in cuts if ends[k - 1] <= window_s)])


def test_default_grids_have_the_papers_spacing() -> None:
    grid = default_grid(3, 5)
    assert grid.shape == (3, 5)
    assert grid.spacing_m == 4.49e-6
    assert default_grid(3, 5) is grid
