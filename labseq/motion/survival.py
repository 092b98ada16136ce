"""Predicts how many atoms a plan loses, and the probability of an array without defects."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.model import (
    Batch,
    LossSpec,
    MotionSpec,
    Occupancy,
    Plan,
    PlanReport,
    SiteGrid,
    TargetPattern,
    TonePaths,
)
from labseq.motion.check import check_plan

Floats = NDArray[np.float64]

NODES: Final = 24
"""Points of the Gauss-Hermite rule over the spread of the losses. 48 change no probability by 1e-6."""


@dataclass(frozen=True, slots=True)
class Survival:
    """Prediction for a plan.

    Attributes:
        p_defect_free: Probability that every target site holds an atom on the next image.
        n_defects: Expected number of target sites without an atom on it.
        n_lost: Expected number of atoms lost until then, over the whole grid.
        n_lost_moved: Atoms of these lost by moves.
        n_lost_landing: Atoms of these lost because an empty tweezer was ramped down on them.
        n_lost_passing: Atoms of these lost because a tweezer passed them, or because it took such an atom
            along.
        n_landings: Empty tweezers that are ramped down on an atom.
        n_passes: How often a tweezer passes a standing atom in a lane.
    """

    p_defect_free: float
    n_defects: float
    n_lost: float
    n_lost_moved: float
    n_lost_landing: float
    n_lost_passing: float
    n_landings: int
    n_passes: int


def predict_survival(
    plan: Plan,
    report: PlanReport,
    occupancy: ArrayLike,
    target: TargetPattern,
    grid: SiteGrid,
    motion: MotionSpec,
    wait_s: float = 0.0,
) -> Survival:
    """Predict what a checked plan costs, by the losses of the profile.

    Each loss p counts as the hazard -ln(1 - p), and an atom with the sum of hazards h survives with
    probability exp(-f h). The factor f is common to all atoms of a shot. It is log-normal with mean 1 and the
    spread of the losses, and the prediction averages over it. Vacuum and image act on all atoms, without f.

    Args:
        plan: The plan.
        report: The report of its check.
        occupancy: bool (n_rows, n_cols), before the plan.
        target: The target.
        grid: The grid of sites.
        motion: How the tweezers move, with the losses.
        wait_s: Time in vacuum in addition to the plan's duration.

    Returns:
        The prediction. ``p_defect_free`` is 0 for a plan that leaves defects.

    Example:
        >>> target = TargetPattern(fill=[[False, True]], clear=[[False, False]])
        >>> plan = Plan.from_batches([([(0, 0)], [(0, 1)])])
        >>> from labseq.motion import check_plan
        >>> motion, grid = MotionSpec(losses=LossSpec(move=0.1, spread=0, image=0)), SiteGrid(1, 2)
        >>> report = check_plan(plan, [[True, False]], target, 1, grid, motion)
        >>> round(predict_survival(plan, report, [[True, False]], target, grid, motion).p_defect_free, 3)
        0.9
    """
    losses = motion.losses
    hazards, n_landings, n_passes = _hazards(plan, np.asarray(occupancy, np.bool_), grid, motion)
    duration_s = report.duration_s + wait_s
    standing = duration_s / losses.lifetime_s - math.log1p(-losses.image)
    factors, weights = _factors(losses.spread)
    total = hazards.sum(axis=0)
    by_cause = [_n_lost(cause[report.predicted], factors, weights) for cause in hazards]
    lost_by_moves = max(by_cause)  # with one cause this is the whole sum, which need not be made twice
    if np.count_nonzero(by_cause) > 1:
        lost_by_moves = _n_lost(total[report.predicted], factors, weights)
    n_atoms = np.count_nonzero(report.predicted)
    filled = target.fill & report.predicted
    kept = math.exp(-standing) * (np.count_nonzero(filled) - _n_lost(total[filled], factors, weights))
    chance = weights @ np.exp(-factors * total[target.fill].sum())
    chance *= math.exp(-standing * target.n_atoms)
    return Survival(
        float(chance) if report.n_defects == 0 else 0.0,
        target.n_atoms - kept,
        -n_atoms * math.expm1(-standing) + math.exp(-standing) * lost_by_moves,
        *by_cause,
        n_landings=n_landings,
        n_passes=n_passes,
    )


def _n_lost(hazards: Floats, factors: Floats, weights: Floats) -> float:
    """Expected number of atoms lost by hazards, mean over the factors."""
    hazards = hazards[hazards > 0.0]  # in most plans only few atoms have one
    if not len(hazards):
        return 0.0
    return float(weights @ -np.expm1(-np.multiply.outer(factors, hazards)).sum(axis=1))


@lru_cache(maxsize=8)
def _factors(spread: float) -> tuple[Floats, Floats]:
    """Values of the factor on the losses, and their weights."""
    if spread == 0:
        return np.ones(1), np.ones(1)
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    return np.exp(spread * nodes - spread**2 / 2), weights / weights.sum()


def choose_plan(
    plans: Iterable[Plan],
    occupancy: ArrayLike,
    target: TargetPattern,
    degree_of_parallelism: int,
    grid: SiteGrid,
    motion: MotionSpec,
) -> Plan:
    """Choose the plan that leaves the fewest defects, then has the highest chance of a complete target.

    :func:`check_plan` counts the defects, and :func:`predict_survival` gives the chance. Among equal chances
    the plan wins that loses the fewest atoms.

    Args:
        plans: The candidates, at least one.
        occupancy: bool (n_rows, n_cols), before the plan.
        target: The target.
        degree_of_parallelism: Maximum number of tweezers on at once.
        grid: The grid of sites.
        motion: How the tweezers move, with the losses.

    Raises:
        InvalidPlanError: A candidate breaks a rule of the check.
    """

    def rank(plan: Plan) -> tuple[int, float, float]:
        report = check_plan(plan, occupancy, target, degree_of_parallelism, grid, motion)
        expected = predict_survival(plan, report, occupancy, target, grid, motion)
        return report.n_defects, -expected.p_defect_free, expected.n_lost

    return min(plans, key=rank)


# Fitted to simulated flights of whole plans. From 1.944 um, a straight lane of the paper's lattice, to 2.4 um
# # the barrier between a static tweezer of 300 uK and a tweezer of 2.1 mK rises by 290 to 310 uK per um, and
# # the loss falls by a factor e for each 36 uK. A shallower tweezer lowers the barrier less.
PASSED_M: Final = 1.944e-6
PASS_DECAY_M: Final = 0.12e-6


def pass_hazard(motion: MotionSpec, distance_m: float = PASSED_M) -> float:
    """Hazard of an atom that a tweezer passes at a distance in metres, and of the tweezer's own atom."""
    hazard = -math.log1p(-motion.losses.passing) * motion.path_depth**2.2
    return hazard * math.exp((PASSED_M - distance_m) / PASS_DECAY_M)


MOVED, LANDED, PASSED = range(3)
"""Causes of the hazards."""


def _hazards(plan: Plan, occupied: Occupancy, grid: SiteGrid, motion: MotionSpec) -> tuple[Floats, int, int]:
    """Hazards of the atom that ends on each site, float64 (3, n_rows, n_cols), with landings and passes."""
    losses = motion.losses
    hazard = pass_hazard(motion)
    hazards = np.zeros((3, *grid.shape))
    if not len(plan.path_shapes):
        from labseq.motion.survival_kernels import line_hazards

        moved = losses.move, losses.tone, losses.distance_per_m
        arrays = plan.moves, plan.batch_offsets, plan.linked
        hazards[MOVED] = line_hazards(*arrays, *grid.shape, moved, grid.axes)
        return hazards, 0, 0
    atoms, n_landings, n_passes = occupied.copy(), 0, 0
    for batch in plan.batches:
        row, col = batch.from_sites.T
        before = hazards[:, row, col]
        before[MOVED] += _batch_hazard(batch, grid, losses)
        atoms[row, col] = False
        hazards[:, row, col] = 0.0
        if batch.tones is not None:
            for at in landings(batch, batch.tones, atoms):
                hazards[LANDED][at] -= math.log1p(-losses.landing)
                n_landings += 1
            if losses.passing > 0:
                tones = batch.tones.tones_of(batch.from_sites)
                of_site, of_tweezer, n = _passes(batch.tones, atoms, grid)
                hazards[PASSED] += hazard * of_site
                before[PASSED] += hazard * of_tweezer[tones[:, 0], tones[:, 1]]
                n_passes += n
        to_row, to_col = batch.to_sites.T
        stays = (to_row >= 0) & (to_row < grid.n_rows) & (to_col >= 0) & (to_col < grid.n_cols)
        goal = to_row[stays], to_col[stays]
        atoms[goal] = True
        hazards[:, *goal] = before[:, stays]
    return hazards, n_landings, n_passes


def _batch_hazard(batch: Batch, grid: SiteGrid, losses: LossSpec) -> Floats:
    """Hazard of each atom that a batch moves. A chain of linked batches counts its ramps at its start."""
    a1, a2 = grid.axes
    if batch.tones is None:
        n_tones = [
            max(len(np.unique(sites[:, axis])) for sites in (batch.from_sites, batch.to_sites))
            for axis in (0, 1)
        ]
        steps = (batch.to_sites - batch.from_sites)[None].astype(np.float64)
    else:
        n_tones = list(batch.tones.shape[1:])
        tones = batch.tones.tones_of(batch.from_sites)
        rows, columns = np.diff(batch.tones.row, axis=0), np.diff(batch.tones.column, axis=0)
        steps = np.stack([rows[:, tones[:, 0]], columns[:, tones[:, 1]]], axis=2)
    way_m = np.linalg.norm(steps[..., :1] * a2 + steps[..., 1:] * a1, axis=2).sum(axis=0)
    ramps = 0.0 if batch.linked else losses.move + losses.tone * (sum(n_tones) - 2)
    loss: Floats = np.minimum(ramps + losses.distance_per_m * way_m, 1.0 - 1e-9)
    return -np.log1p(-loss)


def landings(batch: Batch, paths: TonePaths, atoms: Occupancy) -> list[tuple[int, int]]:
    """Sites of atoms on which an empty tweezer of a batch is ramped down."""
    landings: list[tuple[int, int]] = []
    carried = {(int(i), int(j)) for i, j in paths.tones_of(batch.from_sites)}
    for i, row_off in enumerate(paths.row_off.tolist()):
        for j, column_off in enumerate(paths.column_off.tolist()):
            end = min(row_off, column_off)
            row, col = paths.row[end, i], paths.column[end, j]
            inside = 0 <= row < atoms.shape[0] and 0 <= col < atoms.shape[1]
            if (i, j) in carried or not inside or row % 1 or col % 1:
                continue
            if atoms[int(row), int(col)]:
                landings.append((int(row), int(col)))
    return landings


BESIDE: Final = 0.6
"""A tweezer closer than this fraction of the spacing passes an atom. Lanes are at most 0.5 away."""


def _passes(paths: TonePaths, atoms: Occupancy, grid: SiteGrid) -> tuple[Floats, Floats, int]:
    """Weighted passes of tweezers by standing atoms, for each site and each tweezer, and their number."""
    from labseq.motion.path_kernels import add_passes

    of_site, of_tweezer = np.zeros(grid.shape), np.zeros(paths.shape[1:])
    positions = np.concatenate([paths.row.ravel(), paths.column.ravel()])
    off = np.concatenate([paths.row_off, paths.column_off]).astype(np.int32)
    a1, a2 = grid.axes / grid.spacing_m
    distances = BESIDE, PASSED_M / grid.spacing_m, PASS_DECAY_M / grid.spacing_m
    n = add_passes(positions, off, paths.shape, atoms, float(a1 @ a2), distances, of_site, of_tweezer)
    return of_site, of_tweezer, n
