"""When one calibration is worse than another."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from labseq.model import CalibrationEntry, same_grid

WORSE_FACTOR: Final = 1.5
"""How much larger the deciding figure may be: less is the chance of a measurement."""

_COUNT: Final = "n_sites_found"


@dataclass(frozen=True, slots=True)
class QualityFigure:
    """The figure by which calibrations of a kind are compared; the lower the better.

    Attributes:
        figure: Its name among the quality figures.
        matters: What it may be, however good another calibration was.
        words: What it is, for people.
    """

    figure: str
    matters: float
    words: str


DECIDING: Final[Mapping[str, QualityFigure]] = {
    # A tenth of a pixel is what sites must be known to: beyond it the region of interest loses light.
    "sites": QualityFigure("residual_px", 0.1, "residual"),
    # Twice the paper's mean detection infidelity of 0.054 %.
    "thresholds": QualityFigure("error", 1e-3, "expected error"),
    # The equalising's own goal.
    "tweezers": QualityFigure("separable_spread", 5e-3, "separable spread"),
    # A twentieth of the mobile tweezers' waist: what is lost by it cannot be seen.
    "frequencies": QualityFigure("error_m", 50e-9, "error"),
    "overlay": QualityFigure("error_m", 50e-9, "error"),
}
"""Kind -> what decides."""


def figure_of(entry: CalibrationEntry) -> float:
    """The deciding figure of an entry; nan if it has none."""
    return entry.quality.get(DECIDING[entry.kind].figure, math.nan)


def why_worse(new: CalibrationEntry, old: CalibrationEntry | None) -> str:
    """Why a calibration must not take the place of another one of its kind; "" if it may.

    It is worse if its deciding figure is more than :data:`WORSE_FACTOR` times the other's and more
    than what matters, if it has no such figure and the other has, or if it found fewer sites.

    One that has a figure is never worse than one that has none, unless it found fewer sites.

    Args:
        new: The one that is to be used.
        old: The one in use; None for none. One of another grid counts for nothing.
    """
    if old is None or not same_grid(new.grid, old.grid):
        return ""
    deciding, now, before = DECIDING[new.kind], figure_of(new), figure_of(old)
    if math.isnan(now) and not math.isnan(before):
        return f"it does not say how good it is (no {deciding.figure}), and the one in use does"
    if not math.isnan(before) and now > max(deciding.matters, WORSE_FACTOR * before):
        return f"its {deciding.figure} is {now:.3g}, that of the one in use {before:.3g}"
    found, found_before = (entry.quality.get(_COUNT, math.nan) for entry in (new, old))
    if found < found_before:
        return f"it found {found:.0f} sites, the one in use {found_before:.0f}"
    return ""
