"""The tone of each row and column, by the survival of pick-up, hold and drop on its own sites."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from labseq.drawing.survival import draw_tone_offsets
from labseq.model import CalibrationKind
from labseq.motion import fit_frequencies
from labseq.session.calibrate.method import CalibrationData, AnalysisResult, from_runs_only, packaged
from labseq.session.calibrate.overlay import offset_text
from labseq.session.calibrate.probing import read_probed
from labseq.session.choosing import ResolvedProfile
from labseq.units import format_quantity

_SEQUENCE: Final = packaged("frequencies")


@dataclass(frozen=True, slots=True)
class FrequenciesMethod:
    """Implements ``Method`` for the tones of the mobile tweezers."""

    kind: CalibrationKind = "frequencies"
    sequence: Path = _SEQUENCE
    aside: tuple[CalibrationKind, ...] = ()
    is_blind: bool = False

    def analyse(self, evidence: CalibrationData) -> AnalysisResult:
        """Find the tones that put the tweezers of each row and column onto the sites.

        What an overlay makes up for is in them.

        Raises:
            DeviceError: There are too few atoms, or no offset at which most survive; says why.
            ConfigError: The run is no scan of a probe's offset.
        """
        probed = read_probed(evidence.run)
        counts = probed.n_before, probed.n_survived
        fit = fit_frequencies(probed.offset_m, *counts, probed.grid, probed.motion)
        row_m, column_m = fit.row_offset_m, fit.column_offset_m
        worst_m = float(np.abs(np.concatenate([row_m - row_m.mean(), column_m - column_m.mean()])).max())
        quality = {
            "error_m": fit.error_m,
            "spread_m": float(np.sqrt((row_m.var() + column_m.var()) / 2)),
            "n_atoms": float(fit.overlay.n_atoms),
        }
        worst, error = (format_quantity(value, "length") for value in (worst_m, fit.error_m))
        summary_lines = (
            offset_text(fit.overlay, probed),
            f"single rows and columns stood up to {worst} beside that, known to {error} r.m.s.",
        )
        return AnalysisResult(
            {"row_hz": fit.row_hz, "column_hz": fit.column_hz},
            quality,
            summary_lines,
            {"calibrations": probed.calibrations},
            lambda: draw_tone_offsets((row_m, fit.row_error_m), (column_m, fit.column_error_m)),
        )

    def read(self, path: Path, bench: ResolvedProfile) -> AnalysisResult:
        """Refuse: they must be measured; known ones stand in the profile's ``grid``."""
        del bench
        raise from_runs_only(self.kind, path)
