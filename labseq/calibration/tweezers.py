"""Calibration of the tone amplitudes at which all static tweezers have equal power, from a closed loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from labseq.builtin.equalise import READINGS
from labseq.calibration.method import AnalysisResult, CalibrationData
from labseq.calibration.pictures import draw_powers
from labseq.errors import ConfigError, Problem
from labseq.recording import Run


def analyse_tweezers(data: CalibrationData) -> AnalysisResult:
    """Read the amplitudes that the step ``equalise`` found in the run's last shot.

    Raises:
        ConfigError: No shot of the run equalised the tweezers of this grid.
    """
    found = _readings(data.run)
    rows, cols, before, after = (
        np.array(found[name], np.float64)
        for name in ("row_amplitudes", "column_amplitudes", "power_before", "power_after")
    )
    if (len(rows), len(cols)) != data.hardware.grid.shape:
        raise _wrong_run(data.run, f"it equalised {len(rows)} x {len(cols)} tweezers")
    names = ("separable_spread", "residual_spread", "noise", "n_measured")
    quality = {name: float(found[name]) for name in names}
    n_rounds = len(found["spreads"])
    work = f"{n_rounds} round{'s' * (n_rounds > 1)}, {found['n_measured']} measurements"
    spread = f"{quality['separable_spread']:.2%} (before: {found['spreads'][0]:.2%})"
    return AnalysisResult(
        {"row_amplitudes": rows, "column_amplitudes": cols},
        quality,
        (
            f"{work}: rows and columns are equal to {spread}",
            f"left from site to site, which the tones cannot change: {quality['residual_spread']:.1%}",
        ),
        draw=lambda: draw_powers(before, after, rows, cols),
    )


def _readings(run: Run) -> dict[str, Any]:
    """The readings of ``equalise`` in the last shot that has them."""
    for shot in reversed(run.shots):
        found = {k.removeprefix(READINGS): v for k, v in shot.readings.items() if k.startswith(READINGS)}
        if found:
            return found
    raise _wrong_run(run, "no shot of it equalised the tweezers")


def _wrong_run(run: Run, what: str) -> ConfigError:
    return ConfigError(Problem(what, str(run.path), expected="a run with the step 'equalise', on this grid"))
