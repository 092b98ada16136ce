"""The detector's thresholds: the two peaks of each site's signals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.calibrations import draw_thresholds
from labseq.errors import ConfigError, Problem
from labseq.imaging.peaks import FittedThresholds, fit_thresholds
from labseq.model import CalibrationKind
from labseq.roles import ReportsSignals
from labseq.session.calibrate.method import CalibrationData, AnalysisResult, from_runs_only, packaged
from labseq.session.choosing import ResolvedProfile

MAX_NAMED: Final = 8
"""Sites that are named; of more, only the number is told."""

_SEQUENCE: Final = packaged("thresholds")


@dataclass(frozen=True, slots=True)
class ThresholdsMethod:
    """Implements ``Method`` for the thresholds."""

    kind: CalibrationKind = "thresholds"
    sequence: Path = _SEQUENCE
    aside: tuple[CalibrationKind, ...] = ("thresholds",)
    is_blind: bool = True

    def analyse(self, evidence: CalibrationData) -> AnalysisResult:
        """Fit the signals that the profile's detector makes of the run's frames.

        Raises:
            DeviceError: The frames are of another size than the sites belong to, or too many sites
                show one peak only.
            LimitError: There are too few frames.
            ConfigError: The detector does not tell its signals, or the run has no frames.
        """
        detector = evidence.detector()
        if not isinstance(detector, ReportsSignals):
            name = evidence.bench.chosen["detector"].entry.name
            what = f"the detector '{name}' does not tell the signals that it compares"
            raise ConfigError(Problem(what, expected="'threshold', 'weighted', or another that does"))
        signals = np.stack([detector.signals(frame) for frame in evidence.frames()])
        fitted = fit_thresholds(signals)
        quality = {
            "error": fitted.error,
            "false_negative": float(fitted.false_negative.mean()),
            "false_positive": float(fitted.false_positive.mean()),
            "loading": float(fitted.loading.mean()),
            "n_one_peak": float((fitted.never_loaded | fitted.always_loaded).sum()),
        }
        unit = detector.signal_unit
        return AnalysisResult(
            {"thresholds": fitted.thresholds},
            quality,
            _summary_lines(fitted, len(signals), unit),
            {"unit": unit, "detector": evidence.bench.chosen["detector"].dump()},
            lambda: draw_thresholds(signals, fitted.thresholds, unit),
        )

    def read(self, path: Path, bench: ResolvedProfile) -> AnalysisResult:
        """Refuse: a file of thresholds is a setting of the detector."""
        del bench
        raise from_runs_only(self.kind, path)


def _summary_lines(fitted: FittedThresholds, n_frames: int, unit: str) -> tuple[str, ...]:
    low, high = fitted.thresholds.min(), fitted.thresholds.max()
    missed, imagined = fitted.false_negative.mean(), fitted.false_positive.mean()
    loading = f"{100 * fitted.loading.mean():.1f} % of the sites hold atoms"
    lines = [
        f"thresholds from {low:.4g} to {high:.4g} {unit}, of {n_frames} frames; {loading}",
        f"expected: {missed:.1e} of the atoms missed, {imagined:.1e} of the empty sites taken for full",
    ]
    for sites, what in ((fitted.never_loaded, "never"), (fitted.always_loaded, "always")):
        if sites.any():
            lines.append(f"warning: {_named(sites)} {what} loaded; the threshold is that of the others")
    return tuple(lines)


def _named(sites: NDArray[np.bool_]) -> str:
    places = [f"({row}, {col})" for row, col in np.argwhere(sites)]
    if len(places) > MAX_NAMED:
        return f"{len(places)} sites were"
    return f"site {places[0]} was" if len(places) == 1 else f"sites {', '.join(places)} were"
