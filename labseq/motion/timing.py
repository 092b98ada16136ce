"""How long moves take, and how many of them fit into a time window."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, get_args

import numpy as np

from labseq.errors import LimitError, one_of
from labseq.model import MotionSpec, Plan, PlanReport, SiteGrid
from labseq.model.motion import SpeedProfile

SPEED_PROFILES: Final[tuple[SpeedProfile, ...]] = get_args(SpeedProfile)
"""Every course of the speed; the index is the course's :class:`labseq.model.FrequencyCourse`."""

WINDOW_TOLERANCE_S = 1e-9
"""A batch may end later than its window by this much: what rounding of sums can do, and no more."""


def site_time_s(grid: SiteGrid, motion: MotionSpec) -> float:
    """Time to move an atom by one site, in seconds.

    With a course of the speed other than constant, that of the mean over the longest
    way of a batch, so that a batch takes the same time whatever the course.

    Raises:
        LimitError: The speed profile is none that exists.

    Example:
        >>> round(site_time_s(SiteGrid(), MotionSpec()), 9)
        3.4538e-05
    """
    if motion.speed_profile not in SPEED_PROFILES:
        raise LimitError("the speed profile", f"'{motion.speed_profile}'", one_of(SPEED_PROFILES))
    return grid.spacing_m / motion.speed_m_s


def fitting_batches(report: PlanReport, plan: Plan, window_s: float) -> int:
    """Count the leading batches that end within a time window.

    A chain of linked batches is never cut.

    Args:
        report: The checked plan's report.
        plan: The plan.
        window_s: Time from the start of the cycle, in seconds.

    Returns:
        How many batches can be played, for :meth:`Plan.first`.
    """
    in_time = report.batch_end_s <= window_s + WINDOW_TOLERANCE_S
    ends_chain = np.append(~plan.linked[1:], True)
    fitting = np.flatnonzero(in_time & ends_chain[: plan.n_batches])
    return int(fitting[-1]) + 1 if len(fitting) else 0


@lru_cache(maxsize=16)
def default_grid(n_rows: int, n_cols: int) -> SiteGrid:
    """A grid of the paper's spacing in any shape."""
    return SiteGrid(n_rows, n_cols)
