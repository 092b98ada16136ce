"""The fits that a sequence asks for, made again while its shots arrive."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from labseq.data.fit_models import MODELS
from labseq.data.fits import Fit
from labseq.data.points import planned_points
from labseq.data.precision import follows
from labseq.data.reader import Run, open_run
from labseq.data.results import own_fits, reported
from labseq.data.scanned import on_axes
from labseq.data.series import Series
from labseq.errors import RecordingError
from labseq.recording.run_file import WRITTEN_UNITS

PAUSE: Final = 100.0
"""Minimum time between two fits, in durations of the last fit, so that fits delay shots by 1 % at most."""


class LiveFits:
    """The fitted parameters of the measured quantities, for the live view.

    Only labseq's own models are fitted, in milliseconds, because this process takes the shots and a
    model of a plugin may hang. Adaptive scans and scans of several values are left to the summary.

    Args:
        run_dir: The run's folder.
        resolved: Its settings.
        measured: The quantities that the run measures.

    Attributes:
        results: Quantity -> name and value of the fitted parameter, for fits that have succeeded.
    """

    def __init__(self, run_dir: Path, resolved: Mapping[str, Any], measured: Sequence[Series]) -> None:
        models = {one["value"]: one.get("fit") for one in resolved.get("measure") or ()}
        self.results: dict[str, tuple[str, str]] = {}
        self._run_dir = run_dir
        self._run: Run | None = None
        self._series = [one for one in measured if models.get(one.quantity.name) in MODELS]
        self._n_fitted = 0
        self._next_s = -math.inf

    def look(self, lines: Mapping[int, Sequence[int]], *, at_once: bool) -> None:
        """Fit the points if there are more shots than the last time, and the pause is over.

        Args:
            lines: Number of a point -> its shots, by their places in the series.
            at_once: Do not wait for the end of the pause, because the run is over.
        """
        n_shots = sum(map(len, lines.values()))
        is_early = time.monotonic() < self._next_s and not at_once
        if not self._series or n_shots == self._n_fitted or is_early:
            return
        began_s, self._n_fitted = time.monotonic(), n_shots
        try:
            self._fit(lines)
        except RecordingError:  # run.json cannot be read: the summary reports why
            self._series = []
        ended_s = time.monotonic()
        # maximum time between two fits, in seconds. The first fit takes longer, because it imports modules
        self._next_s = ended_s + min(PAUSE * (ended_s - began_s), 20.0)

    def _fit(self, lines: Mapping[int, Sequence[int]]) -> None:
        run = self._run = self._run or open_run(self._run_dir)
        scan = None if WRITTEN_UNITS in run.scan else on_axes(run.scan, planned_points(run.scan))
        if scan is None or len(scan.axes) != 1:
            self._series = []
            return
        for series in self._series:
            means = series.over([lines.get(i, ()) for i in range(len(scan.points))])
            fits = own_fits(run, scan, series.quantity, means)
            result = reported(run, series.quantity, fits[0]) if fits else None
            if result is None:
                self.results.pop(series.quantity.name, None)
            else:
                self.results[series.quantity.name] = result.name, f"{result.value}{_doubt(fits[0].fit)}"


def _doubt(fit: Fit | None) -> str:
    """A warning that the points do not follow the model, which the error of the value does not show."""
    if fit is None or follows(fit) or math.isnan(fit.reduced_chi_square):
        return ""
    return f", chi-square {fit.reduced_chi_square:.2g}"
