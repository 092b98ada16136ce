"""The overlay of mobile and static tweezers, measured by a run of probes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from labseq.calibration.method import (
    AnalysisResult,
    CalibrationData,
    ProbeCounts,
    from_runs_only,
    packaged,
    read_probed,
)
from labseq.calibration.pictures import draw_survival
from labseq.model import CalibrationKind
from labseq.motion import OverlayFit, fit_overlay, overlay_offset
from labseq.motion.overlay import distance_m, unit_axes
from labseq.session.profile import ResolvedProfile
from labseq.units import format_quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SEQUENCE: Final = packaged("overlay")


@dataclass(frozen=True, slots=True)
class OverlayMethod:
    """Implements ``Method`` for the overlay."""

    kind: CalibrationKind = "overlay"
    sequence: Path = _SEQUENCE
    aside: tuple[CalibrationKind, ...] = ()
    is_blind: bool = False

    def analyse(self, evidence: CalibrationData) -> AnalysisResult:
        """Find the offset at which most atoms survive.

        Raises:
            DeviceError: There is no such offset; says why, and where to look.
            ConfigError: The run is no scan of a probe's offset.
        """
        probed = read_probed(evidence.run)
        fit = fit_overlay(probed.offset_m, probed.n_before, probed.n_survived, probed.grid)
        offset_m = overlay_offset(fit.centre_m, probed.in_use_m)
        shape = fit.shape.values()
        quality = {
            "error_m": float(fit.error_m.max()),
            "dispersion": fit.dispersion,
            "n_atoms": float(fit.n_atoms),
            **shape,
        }
        return AnalysisResult(
            {"offset_m": offset_m, **{name: np.array(value) for name, value in shape.items()}},
            quality,
            (f"{offset_text(fit, probed)}, known to {format_quantity(float(fit.error_m.max()), 'length')}",),
            {"calibrations": probed.calibrations},
            lambda: draw_fit(probed, fit),
        )

    def read(self, path: Path, bench: ResolvedProfile) -> AnalysisResult:
        """Refuse: it must be measured."""
        del bench
        raise from_runs_only(self.kind, path)


def offset_text(fit: OverlayFit, probed: ProbeCounts) -> str:
    """Where the mobile tweezers stood in the run, in words."""
    along, across = (format_quantity(float(-centre), "length") for centre in fit.centre_m)
    use = "" if not np.any(probed.in_use_m) else " beyond what the overlay in use made up for"
    where = f"{along} along a row and {across} from row to row beside the sites{use}"
    return f"{fit.n_atoms} atoms: the mobile tweezers stood {where}"


def draw_fit(probed: ProbeCounts, fit: OverlayFit) -> Figure:
    """Draw survival along both axes, and what was fitted."""
    axes = unit_axes(probed.grid)
    n = probed.n_before.sum(axis=(1, 2))
    k = probed.n_survived.sum(axis=(1, 2))
    return draw_survival(
        probed.offset_m, n, k, lambda offset_m: fit.shape.survival(distance_m(offset_m - fit.centre_m, axes))
    )
