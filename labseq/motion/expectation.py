"""Predicts the result of a planner as the mean predicted survival over random loadings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labseq.model import MotionSpec, Occupancy, Plan, SiteGrid, TargetPattern
from labseq.motion.check import check_plan
from labseq.motion.survival import predict_survival
from labseq.motion.tones import fitting_batches


@dataclass(frozen=True, slots=True)
class Expected:
    """Means over loadings, on the image after the first cycle.

    Attributes:
        n_atoms: Number of target sites.
        n_defects: Number of target sites without an atom.
        p_defect_free: Probability that all target sites hold an atom.
    """

    n_atoms: int
    n_defects: float
    p_defect_free: float

    def __str__(self) -> str:
        filling, defect_free = 1 - self.n_defects / max(1, self.n_atoms), f"{self.p_defect_free:.2g}"
        percent = "below 0.01" if self.p_defect_free < 1e-4 else f"{100 * float(defect_free):g}"
        return f"filling {100 * filling:.2f} %, defect-free {percent} %"


def random_loadings(shape: tuple[int, int], loading: float, n: int) -> NDArray[np.bool_]:
    """Random loadings, the same at each call: bool (n, n_rows, n_cols)."""
    return np.random.default_rng(0).random((n, *shape)) < loading


def expect(
    plan_for: Callable[[Occupancy, TargetPattern], Plan],
    loadings: Iterable[Occupancy],
    target: TargetPattern,
    degree_of_parallelism: int,
    grid: SiteGrid,
    motion: MotionSpec,
    window_s: float = math.inf,
) -> Expected:
    """Plan for loadings, and predict what is left after the first cycle with the losses of the profile.

    Args:
        plan_for: The method ``plan`` of a planner.
        loadings: bool (n_rows, n_cols) each, at least one.
        degree_of_parallelism: Maximum number of tweezers on at once.
        motion: How the tweezers move, with the losses.
        window_s: Time from the start of the cycle. Batches that end later are not played.

    Raises:
        InvalidPlanError: A plan breaks a rule of the check.
    """
    found: list[tuple[float, float]] = []
    for atoms in loadings:
        plan = plan_for(atoms, target)
        report = check_plan(plan, atoms, target, degree_of_parallelism, grid, motion)
        if (n_fit := fitting_batches(report, plan, window_s)) < plan.n_batches:
            plan = plan.first(n_fit)
            report = check_plan(plan, atoms, target, degree_of_parallelism, grid, motion)
        of_plan = predict_survival(plan, report, atoms, target, grid, motion)
        found.append((of_plan.n_defects, of_plan.p_defect_free))
    n_defects, p_defect_free = np.mean(found, axis=0).tolist()
    return Expected(target.n_atoms, n_defects, p_defect_free)
