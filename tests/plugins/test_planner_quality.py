"""How good the plans are: what each planner costs on fixed loadings, so that none gets worse unnoticed.

Every figure is the mean over loadings that never change, and plans have no randomness: what is measured here
is the same on every machine. docs/develop/planner-figures.md has larger samples of the same kind:
18.47(4) batches for ``psca``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from labseq.motion import predict_survival
from labseq.plugin import Context, MotionSpec, SiteGrid, TargetPattern
from labseq.plugin.planning import check_plan

from .planning import COMPACT, PLANNERS, VARIANTS, Bools, in_the_middle, loadings

WORSE = 1.03
"""A mean may exceed what was measured by this factor: less than the 10 % that would matter to a user, and
room for another choice between plans that are equally good."""


class Cost(NamedTuple):
    """Means over the loadings.

    Attributes:
        batches: Batches of a plan.
        way: Sum of all atoms' ways along rows and columns, in sites.
        time_ms: Ramps, transport and overheads of all batches, without that of the cycle.
        lost: Atoms that are expected to be lost until the next image.
    """

    batches: float
    way: float
    time_ms: float
    lost: float


ROWS, COLUMNS = np.indices((15, 15))
KAGOME = in_the_middle((ROWS % 2 == 0) | (COLUMNS % 2 == 0))
"""Unwanted atoms between the sites: they fill vacancies, or leave."""


def after_losses(n: int) -> Bools:
    """The compact target with 2 % of its atoms lost, and every other site of the reservoir filled."""
    return np.random.default_rng(2).random((n, 20, 20)) > np.where(COMPACT.fill, 0.02, 0.5)


CASES: dict[str, tuple[Bools, TargetPattern, int]] = {
    "compact": (loadings(20), COMPACT, 15),
    "kagome": (loadings(10), KAGOME, 15),
    "few defects": (after_losses(30), COMPACT, 7),
}

MEASURED: dict[tuple[str, str], Cost] = {
    ("psca", "compact"): Cost(18.8, 353.4, 3.95, 5.17),
    ("psca", "kagome"): Cost(20.5, 328.8, 4.27, 4.57),
    ("psca", "few defects"): Cost(7.37, 19.83, 1.036, 1.789),
    ("psca, as in the paper", "compact"): Cost(20.9, 377.5, 4.36, 5.54),
    ("psca, repair", "compact"): Cost(84.1, 267.2, 12.27, 4.05),
    ("grid", "compact"): Cost(16.1, 256.2, 5.60, 2.727),
    ("grid", "kagome"): Cost(17.5, 114.5, 4.73, 2.431),
    ("grid", "few defects"): Cost(3.37, 19.9, 1.023, 1.610),
    ("mta1", "compact"): Cost(191.1, 384.4, 31.2, 7.75),
    ("tetris", "compact"): Cost(31.6, 425.9, 6.05, 6.29),
    ("lsap", "compact"): Cost(177.9, 227.6, 28.1, 4.84),
    ("lsap_squared", "compact"): Cost(190.6, 237.3, 30.6, 5.21),
    ("compression", "compact"): Cost(161.6, 255.4, 26.3, 4.40),
    ("hca", "compact"): Cost(182.7, 398.5, 23.9, 3.24),
}
"""Planner and case: the means when this test was written (November 2026)."""


def mean_cost(name: str, arrays: Bools, target: TargetPattern, dop: int) -> Cost:
    grid, motion = SiteGrid(), MotionSpec()
    planner: Any = (PLANNERS | VARIANTS)[name](Context(grid=grid, motion=motion), dop)
    costs: list[Cost] = []
    for atoms in arrays:
        plan = planner.plan(atoms, target)
        report = check_plan(plan, atoms, target, planner.degree_of_parallelism, grid, motion)
        assert report.meets_target
        way = int(np.abs(plan.moves[:, 2:].astype(int) - plan.moves[:, :2]).sum())
        time_ms = 1e3 * (report.duration_s - motion.overhead_per_cycle_s)
        lost = predict_survival(plan, report, atoms, target, grid, motion).n_lost
        costs.append(Cost(plan.n_batches, way, time_ms, lost))
    return Cost(*np.mean(costs, axis=0).tolist())


@pytest.mark.parametrize(("name", "case"), MEASURED, ids=": ".join)
def test_plans_cost_no_more_than_they_did(name: str, case: str) -> None:
    found, measured = mean_cost(name, *CASES[case]), MEASURED[name, case]
    worse = {
        key: (value, before)
        for key, value, before in zip(Cost._fields, found, measured, strict=True)
        if value > WORSE * before
    }
    assert not worse, "what the plans cost now, and what they did"
