"""Checked plans, played as tone programs, do in the world what the check predicts."""

from __future__ import annotations

import numpy as np
import pytest
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.transport import Transport
from numpy.typing import NDArray

from labseq import Batch, MotionSpec, Plan, SiteGrid, check_plan, tone_program
from labseq.geometry import pattern
from labseq.model.motion import SpeedProfile
from labseq.testing.fakes import OneByOnePlanner

GRID = SiteGrid(5, 6)


PROFILES = pytest.mark.parametrize("profile", ["constant", "minimum_jerk", "constant_jerk"])


def carried(plan: Plan, occupied: NDArray[np.bool_], profile: SpeedProfile = "constant") -> NDArray[np.bool_]:
    program = tone_program(plan, grid=GRID, motion=MotionSpec(speed_profile=profile))
    result = occupied.copy()
    transport = Transport(GRID, MotionSpec(), SimulationSettings(transport_loss=0.0))
    transport.carry(result, program, program.n_segments, np.ones(GRID.shape), np.random.default_rng(0), 1.0)
    return result


@PROFILES
@pytest.mark.parametrize("seed", range(10))
def test_a_checked_plan_does_what_the_check_predicts(seed: int, profile: SpeedProfile) -> None:
    occupied = np.random.default_rng(seed).random(GRID.shape) < 0.6
    target = pattern(np.array([[1, 0, 1], [0, 1, 0], [1, 0, 1]], np.bool_), GRID)
    plan = OneByOnePlanner().plan(occupied, target)
    predicted = check_plan(plan, occupied, target, 1, grid=GRID).predicted
    assert plan.n_batches > 0
    np.testing.assert_array_equal(carried(plan, occupied, profile), predicted)


@PROFILES
def test_ejection_parallel_moves_and_linked_batches_do_what_the_check_predicts(profile: SpeedProfile) -> None:
    occupied = np.zeros(GRID.shape, np.bool_)
    for site in ((1, 0), (1, 1), (1, 2), (4, 4), (4, 5), (0, 3)):
        occupied[site] = True
    plan = Plan.from_batches(
        [
            Batch(np.array([(1, 0), (1, 1)], np.int16), np.array([(1, -1), (1, 0)], np.int16)),
            Batch(np.array([(4, 4)], np.int16), np.array([(4, 1)], np.int16)),
            Batch(np.array([(4, 1)], np.int16), np.array([(2, 1)], np.int16), linked=True),
        ]
    )
    target = pattern(np.ones((1, 1), np.bool_), GRID)
    predicted = check_plan(plan, occupied, target, 2, grid=GRID).predicted
    after_plan = carried(plan, occupied, profile)
    np.testing.assert_array_equal(after_plan, predicted)
    assert after_plan[2, 1]
    assert after_plan.sum() == 5
