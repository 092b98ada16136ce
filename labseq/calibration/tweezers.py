"""Amplitudes that make the static tweezers even, found in a closed loop."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.builtin.equalise import READINGS
from labseq.calibration.method import AnalysisResult, CalibrationData, from_runs_only, packaged
from labseq.calibration.pictures import draw_powers
from labseq.errors import ConfigError, Problem
from labseq.model import CalibrationKind
from labseq.recording import Run
from labseq.session.profile import ResolvedProfile

_SEQUENCE: Final = packaged("tweezers")


@dataclass(frozen=True, slots=True)
class TweezersMethod:
    """Implements ``Method`` for the static tweezers: the loop is a step of the run, the analysis reads it."""

    kind: CalibrationKind = "tweezers"
    sequence: Path = _SEQUENCE
    aside: tuple[CalibrationKind, ...] = ()
    is_blind: bool = True

    def analyse(self, evidence: CalibrationData) -> AnalysisResult:
        """Read what the loop found in the run's last shot.

        Raises:
            ConfigError: No shot of the run equalised the tweezers of such a grid.
        """
        found = _readings(evidence.run)
        rows, cols = (np.array(found[name], np.float64) for name in ("row_amplitudes", "column_amplitudes"))
        before, after = (np.array(found[name], np.float64) for name in ("power_before", "power_after"))
        grid = evidence.bench.grid
        if (len(rows), len(cols)) != grid.shape:
            raise _unfit(evidence.run, f"it equalised {len(rows)} x {len(cols)} tweezers")
        quality = {
            "separable_spread": float(found["separable_spread"]),
            "residual_spread": float(found["residual_spread"]),
            "noise": float(found["noise"]),
            "n_measured": float(found["n_measured"]),
        }
        n_rounds = len(found["spreads"])
        work = f"{n_rounds} round{'s' * (n_rounds > 1)}, {found['n_measured']} measurements"
        even = f"{quality['separable_spread']:.2%} (before: {found['spreads'][0]:.2%})"
        summary_lines = (
            f"{work}: rows and columns are even to {even}",
            f"what they cannot even out: {quality['residual_spread']:.1%} from site to site",
        )
        values: dict[str, NDArray[np.float64]] = {"row_amplitudes": rows, "column_amplitudes": cols}
        return AnalysisResult(
            values, quality, summary_lines, draw=lambda: draw_powers(before, after, rows, cols)
        )

    def read(self, path: Path, bench: ResolvedProfile) -> AnalysisResult:
        """Refuse: it must be measured."""
        del bench
        raise from_runs_only(self.kind, path)


def _readings(run: Run) -> dict[str, Any]:
    """What the loop left in the last shot that it finished in."""
    for shot in reversed(run.shots):
        found = {
            name.removeprefix(READINGS): value
            for name, value in shot.readings.items()
            if name.startswith(READINGS)
        }
        if found:
            return found
    raise _unfit(run, "no shot of it equalised the tweezers")


def _unfit(run: Run, what: str) -> ConfigError:
    return ConfigError(Problem(what, str(run.path), expected="a run with the step 'equalise', on this grid"))
