"""Judges whether a calibration is worse than another of its kind and must not replace it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from labseq.calibration_store import Store, Stored, check_grid
from labseq.errors import ConfigError, Problem
from labseq.model import CalibrationEntry, SiteGrid, same_grid

WORSE_FACTOR: Final = 1.5
"""Quality figures whose ratio is below this factor may differ by chance."""


@dataclass(frozen=True, slots=True)
class QualityFigure:
    """The figure by which calibrations of a kind are compared. Lower is better.

    Attributes:
        figure: Its name in ``quality``.
        good_enough: An entry with this figure or less is never worse.
        label: Its name for the user.
    """

    figure: str
    good_enough: float
    label: str


DECIDING: Final[Mapping[str, QualityFigure]] = {
    # If sites are less accurate than a tenth of a pixel, the region of interest loses light.
    "sites": QualityFigure("residual_px", 0.1, "residual"),
    # Twice the paper's mean detection infidelity of 0.054 %.
    "thresholds": QualityFigure("error", 1e-3, "expected error"),
    # The goal of the step `equalise`.
    "tweezers": QualityFigure("separable_spread", 5e-3, "separable spread"),
    "amplitudes": QualityFigure("separable_spread", 5e-3, "separable spread"),
    # A twentieth of the mobile tweezers' waist, which causes too few losses to measure.
    "frequencies": QualityFigure("error_m", 50e-9, "error"),
    "overlay": QualityFigure("error_m", 50e-9, "error"),
    # Ten times the goal for a card that streams.
    "timing": QualityFigure("p99_s", 25e-3, "99th percentile"),
}
"""Kind -> the quality figure by which its calibrations are compared."""


def figure_of(entry: CalibrationEntry) -> float:
    """The deciding figure of an entry, or nan if it has none."""
    return entry.quality.get(DECIDING[entry.kind].figure, math.nan)


def why_worse(new: CalibrationEntry, old: CalibrationEntry | None) -> str:
    """The reason why a calibration is worse than another of its kind, or "" if it may replace it.

    It is worse if its deciding figure is more than :data:`WORSE_FACTOR` times the other's and above the
    good-enough level, if only the other has such a figure, or if it found fewer sites. Thresholds with more
    sites than before that take a peak from their neighbours are refused even if none are in use.

    Args:
        new: The new calibration.
        old: The calibration in use, or None. For another grid it may always be replaced.
    """
    old = old if old is not None and same_grid(new.grid, old.grid) else None
    n_one_peak = new.quality.get("n_one_peak", 0.0)
    if n_one_peak > (old.quality.get("n_one_peak", 0.0) if old is not None else 0.0):
        sites = "at 1 site" if n_one_peak == 1 else f"at {n_one_peak:.0f} sites"
        return f"{sites} only one peak was found, so the thresholds there would come from neighbours"
    if old is None:
        return ""
    deciding, now, before = DECIDING[new.kind], figure_of(new), figure_of(old)
    if math.isnan(now) and not math.isnan(before):
        return f"it has no quality figure ({deciding.figure}), but the calibration in use has one"
    if not math.isnan(before) and now > max(deciding.good_enough, WORSE_FACTOR * before):
        return f"its {deciding.figure} is {now:.3g}, but {before:.3g} for the calibration in use"
    n_found, n_found_before = (entry.quality.get("n_sites_found", math.nan) for entry in (new, old))
    if n_found < n_found_before:
        return f"it found {n_found:.0f} sites, but the calibration in use found {n_found_before:.0f}"
    return ""


def why_worse_than_in_use(store: Store, entry: CalibrationEntry) -> str:
    """Why an entry must not replace the entry in use, or "". A damaged entry is always replaced."""
    try:
        stored = store.entry_in_use(entry.kind)
    except ConfigError:
        return ""
    return why_worse(entry, None if stored is None else stored.entry)


def use_if_not_worse(store: Store, stored: Stored, grid: SiteGrid) -> None:
    """Use an entry, unless the entry in use is better.

    Raises:
        ConfigError: The entry is for another grid or worse, or the folder cannot be written to.
    """
    entry = stored.entry
    check_grid(entry, grid, str(stored.path))
    if reason := why_worse_than_in_use(store, entry):
        message = f"{entry.kind} {entry.id} is worse than the calibration in use: {reason}"
        raise ConfigError(Problem(message, hint="use it anyway with --force"))
    store.use(stored, grid)
