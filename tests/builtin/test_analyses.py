"""Survival from image to image follows the moves that were played."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from hypothesis.extra.numpy import arrays

from labseq.builtin.analyses import SurvivalAnalysis, SurvivalSettings
from labseq.model import CycleRecord, ImageRecord, Plan, PlanReport, follow_atoms
from labseq.roles import Context
from labseq.testing import AnalysisContract

SHAPE = (1, 5)


class TestSurvival(AnalysisContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SurvivalAnalysis]:
        return partial(SurvivalAnalysis, SurvivalSettings())


def image(row: str, step: int, cycle: int = 0) -> ImageRecord:
    sites = np.array([[site == "1" for site in row]])
    return ImageRecord(None, sites, np.ones(sites.shape, np.float32), step, cycle, 0.0, 0.045)


def cycle_of(plan: Plan, cycle: int, n_played: int | None = None) -> CycleRecord:
    n_batches = plan.n_batches
    report = PlanReport(np.zeros(SHAPE, np.bool_), np.ones(n_batches), np.ones(n_batches, np.int32), 0, 0)
    return CycleRecord(2, cycle, plan, report, n_batches if n_played is None else n_played, 0.06, 0.0, 0.0)


def analysed(images: list[ImageRecord], cycles: list[CycleRecord], atoms: str = "all") -> dict[str, Any]:
    settings: Any = SimpleNamespace(atoms=atoms)
    shot: Any = SimpleNamespace(images=images, cycles=cycles)
    context: Any = None
    return SurvivalAnalysis(settings, context).shot(shot)


STEP_RIGHT = Plan.from_batches([([(0, 0), (0, 1)], [(0, 1), (0, 2)])])
EJECT_THEN_MOVE = Plan.from_batches([([(0, 4)], [(0, 5)]), ([(0, 0)], [(0, 3)])])


def test_atoms_that_stay_count_where_they_are():
    found = analysed([image("11010", 1), image("10010", 3)], [])
    assert found["survival"] == pytest.approx(2 / 3)
    assert (found["n_expected"], found["n_survived"]) == ([3], [2])
    assert found["expected"].tolist() == [[1, 1, 0, 1, 0]]
    assert found["survived"].tolist() == [[1, 0, 0, 1, 0]]


@pytest.mark.parametrize(
    ("atoms", "expected"), [("all", [0, 1, 1, 1, 0]), ("moved", [0, 1, 1, 0, 0]), ("held", [0, 0, 0, 1, 0])]
)
def test_atoms_that_are_moved_count_where_they_are_put(atoms, expected):
    found = analysed([image("11010", 1), image("01100", 2, 1)], [cycle_of(STEP_RIGHT, 1)], atoms)
    assert found["expected"].tolist() == [expected]
    assert found["survived"].tolist() == [[e and s for e, s in zip(expected, [0, 1, 1, 0, 0], strict=True)]]


def test_atoms_that_are_ejected_do_not_count():
    found = analysed([image("10001", 1), image("00010", 2, 1)], [cycle_of(EJECT_THEN_MOVE, 1)])
    assert (found["n_expected"], found["n_survived"]) == ([1], [1])


def test_batches_that_were_not_played_move_nothing():
    cycle = cycle_of(EJECT_THEN_MOVE, 1, n_played=1)
    assert analysed([image("10001", 1), image("10000", 2, 1)], [cycle])["survival"] == 1.0


def test_each_pair_of_images_has_its_own_moves():
    images = [image("11000", 1), image("01100", 2, 1), image("00110", 2, 2), image("00110", 3)]
    cycles = [cycle_of(STEP_RIGHT, 1), cycle_of(Plan.from_batches([([(0, 1)], [(0, 3)])]), 2)]
    found = analysed(images, cycles)
    assert (found["n_expected"], found["n_survived"]) == ([2, 2, 2], [2, 2, 2])


@pytest.mark.parametrize("images", [[], [image("11000", 1)], [image("00000", 1), image("10000", 2)]])
def test_without_atoms_to_follow_there_is_no_survival(images):
    assert math.isnan(analysed(images, [])["survival"])


@given(arrays(np.bool_, SHAPE), st.permutations(range(5)), st.integers(0, 5))
def test_a_legal_batch_keeps_the_number_of_atoms(atoms, goals, n_moves):
    stays = atoms.copy()
    stays[0, :n_moves] = False
    assume(not stays[0, goals[:n_moves]].any())
    plan = Plan.from_batches([([(0, c) for c in range(n_moves)], [(0, c) for c in goals[:n_moves]])])
    moved, held = follow_atoms(atoms, [cycle_of(plan, 0)])
    assert (held == stays).all()
    assert np.count_nonzero(held | moved) == np.count_nonzero(held) + np.count_nonzero(moved) == atoms.sum()
