"""Losses predicted from a plan, against atoms drawn one by one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from labseq.model import Batch, LossSpec, MotionSpec, Plan, SiteGrid, TargetPattern, TonePaths
from labseq.motion import check_plan
from labseq.motion.survival import Survival, predict_survival
from labseq.settings import MAX_DURATION_S

NO_LOSS = LossSpec(move=0.0, landing=0.0, passing=0.0, spread=0.0, image=0.0, lifetime_s=MAX_DURATION_S)
GRID = SiteGrid(3, 4)
ATOMS = np.array([[1, 0, 1, 0], [0, 0, 0, 0], [1, 0, 1, 1]], np.bool_)
FILL = np.array([[0, 1, 0, 1], [0, 0, 0, 0], [1, 0, 1, 1]], np.bool_)
TARGET = TargetPattern(FILL, np.zeros_like(FILL))
LINE = Plan.from_batches([([(0, 0)], [(0, 1)]), ([(0, 2)], [(0, 3)])])
"""One atom after the other moves by one site."""
LANDING = Plan.from_batches(
    [
        Batch(
            np.array([(0, 0), (0, 2)], np.int16),
            np.array([(0, 1), (0, 3)], np.int16),
            tones=TonePaths(
                row=np.array([[0, 1], [0.5, 1.5], [0.5, 1.5], [0, 2]]),
                column=np.array([[0, 2], [0.5, 2.5], [0.5, 2.5], [1, 3]]),
            ),
        )
    ]
)
"""Both at once, in a second row of tones whose last tweezer, without an atom, ends on the atom at (2, 3)."""


def predict(plan: Plan, wait_s: float = 0.0, **losses: float) -> Survival:
    motion = MotionSpec(losses=replace(NO_LOSS, **losses), empty_tweezers_may_land=True)
    report = check_plan(plan, ATOMS, TARGET, 4, GRID, motion)
    return predict_survival(plan, report, ATOMS, TARGET, GRID, motion, wait_s)


@pytest.mark.parametrize(
    ("losses", "plan", "survives", "lost"),
    [
        ({"move": 0.1}, LINE, 0.9**2, 0.2),
        ({"move": 0.1}, LANDING, 0.9**2, 0.2),
        ({"move": 0.1, "tone": 0.05}, LINE, 0.9**2, 0.2),
        ({"tone": 0.05}, LANDING, 0.9**2, 0.2),
        ({"distance_per_m": 1e4}, LINE, (1 - 0.0449) ** 2, 2 * 0.0449),
        ({"landing": 0.3}, LANDING, 0.7, 0.3),
        ({"image": 0.1}, LINE, 0.9**5, 0.5),
        ({"move": 0.1, "image": 0.2}, LINE, 0.9**2 * 0.8**5, 3 * 0.2 + 2 * (1 - 0.9 * 0.8)),
        ({"lifetime_s": 50.0, "wait_s": 50 * math.log(2)}, LINE, 0.5**5, 2.5),
    ],
)
def test_losses_alone_and_together(
    losses: dict[str, float], plan: Plan, survives: float, lost: float
) -> None:
    predicted = predict(plan, **losses)
    assert predicted.p_defect_free == pytest.approx(survives, rel=2e-3)
    assert predicted.n_lost == pytest.approx(lost, rel=2e-3)
    assert predicted.n_landings == (1 if plan is LANDING else 0)


def test_losses_that_vary_from_shot_to_shot() -> None:
    """Against the mean over drawn factors: a spread helps, because losses come together."""
    rng = np.random.default_rng(1)
    factor = np.exp(0.8 * rng.standard_normal(400_000) - 0.32)
    predicted = predict(LINE, move=0.3, spread=0.8)
    assert predicted.p_defect_free == pytest.approx(float((0.7**factor).__pow__(2).mean()), rel=0.01)
    assert predicted.p_defect_free > 0.7**2
    assert predicted.n_lost == pytest.approx(predicted.n_lost_moved)
    assert predicted.n_lost == pytest.approx(2 * (1 - 0.7**factor).mean(), rel=0.01)


@pytest.mark.parametrize("depth", [1.0, 0.7])
def test_atoms_beside_a_lane_may_be_taken_along_with_the_atom_that_passes(depth: float) -> None:
    """An atom goes along a lane between two rows of three sites: past (0, 1) and (1, 1)."""
    grid, atoms = SiteGrid(2, 3, lattice="square"), np.array([[1, 1, 0], [0, 1, 1]], np.bool_)
    paths = TonePaths(np.array([[0.0], [0.5], [0.5], [0.0]]), np.array([[0.0], [0.5], [1.5], [2.0]]))
    plan = Plan.from_batches([Batch(np.array([(0, 0)]), np.array([(0, 2)]), tones=paths)])
    target = TargetPattern(np.array([[0, 1, 1], [0, 0, 0]], np.bool_), np.zeros((2, 3), np.bool_))
    motion = MotionSpec(losses=replace(NO_LOSS, passing=0.01), path_depth=depth)
    report = check_plan(plan, atoms, target, 1, grid, motion)
    predicted = predict_survival(plan, report, atoms, target, grid, motion)
    wider = math.exp((1.944 - grid.spacing_m * 1e6 / 2) / 0.12)  # than the paper's lane
    kept = 0.99 ** (wider * depth**2.2)
    assert predicted.n_passes == 2
    assert predicted.n_lost == pytest.approx(2 * (1 - kept) + 1 - kept**2, rel=1e-4)  # and of old age
    assert predicted.n_lost_passing == pytest.approx(predicted.n_lost, rel=1e-4)
    assert predicted.p_defect_free == pytest.approx(kept**3)


def test_an_atom_that_moves_twice_is_at_risk_twice_unless_the_tweezers_stay_on() -> None:
    there, on = ([(0, 2)], [(1, 2)]), ([(1, 2)], [(1, 3)])
    fill = np.zeros((3, 4), np.bool_)
    fill[1, 3] = True
    target, motion = TargetPattern(fill, ~fill & False), MotionSpec(losses=replace(NO_LOSS, move=0.2))
    chances: list[float] = []
    for linked in (False, True):
        plan = Plan.from_batches([there, Batch(np.array(on[0]), np.array(on[1]), linked=linked)])
        report = check_plan(plan, ATOMS, target, 1, GRID, motion)
        chances.append(predict_survival(plan, report, ATOMS, target, GRID, motion).p_defect_free)
    assert chances == pytest.approx([0.64, 0.8], rel=1e-3)


def test_a_plan_that_leaves_defects_has_no_chance() -> None:
    assert predict(LINE.first(1)).p_defect_free == 0.0


@pytest.mark.parametrize("wrong", [{"move": 1.0}, {"spread": -1.0}, {"lifetime_s": 0.0}])
def test_losses_that_mean_nothing_are_refused(wrong: dict[str, float]) -> None:
    (setting,) = wrong
    with pytest.raises(ValueError, match=rf"{setting}\n  Input should be"):
        LossSpec(**wrong)


def test_line_batches_count_the_same_beside_paths_of_tones() -> None:
    """Plans of lines alone are followed by a kernel, others by plain Python."""
    target = TargetPattern(np.array([[True] * 3, [False] * 3]), np.zeros((2, 3), np.bool_))
    atoms, grid = np.array([[1, 0, 0], [0, 1, 1]], np.bool_), SiteGrid(2, 3)
    motion = MotionSpec(losses=LossSpec(move=0.1, tone=0.02, distance_per_m=2000.0, passing=0.0))
    first = [([(0, 0)], [(0, 1)]), ([(0, 1)], [(0, 0)])]
    source, goal = np.array([(1, 1), (1, 2)], np.int16), np.array([(0, 1), (0, 2)], np.int16)
    way = TonePaths(np.array([[1.0], [0.0]]), np.array([[1.0, 2.0], [1.0, 2.0]]))
    plans = [Plan.from_batches([*first, Batch(source, goal, tones=tones)]) for tones in (None, way)]
    found = [
        predict_survival(plan, check_plan(plan, atoms, target, 4, grid, motion), atoms, target, grid, motion)
        for plan in plans
    ]
    assert found[0].n_lost_moved == pytest.approx(found[1].n_lost_moved)
    assert found[0].p_defect_free == pytest.approx(found[1].p_defect_free)
