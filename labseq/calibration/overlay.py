"""Calibration of the overlay of mobile and static tweezers, from a run of probes."""

from __future__ import annotations

import numpy as np

from labseq.calibration.method import AnalysisResult, CalibrationData, ProbeCounts, count_probed
from labseq.calibration.pictures import draw_survival
from labseq.motion import OverlayFit, fit_overlay, overlay_offset
from labseq.motion.overlay import distance_m, unit_axes
from labseq.units import format_quantity


def analyse_overlay(data: CalibrationData) -> AnalysisResult:
    """Find the offset at which most atoms survive.

    Raises:
        DeviceError: There is no such offset; says why, and where to look.
        ConfigError: The run is not a scan of a probe's offset.
    """
    probed = count_probed(data.run)
    fit = fit_overlay(probed.offset_m, probed.n_before, probed.n_survived, probed.grid)
    shape, error_m = fit.shape.values(), float(fit.error_m.max())
    n_before, n_survived = (counts.sum(axis=(1, 2)) for counts in (probed.n_before, probed.n_survived))
    axes = unit_axes(probed.grid)
    return AnalysisResult(
        {"offset_m": overlay_offset(fit.centre_m, probed.in_use_m), **shape},
        {"error_m": error_m, "dispersion": fit.dispersion, "n_atoms": float(fit.n_atoms), **shape},
        (f"{offset_text(fit, probed)}, known to {format_quantity(error_m, 'length')}",),
        {"calibrations": probed.calibrations},
        lambda: draw_survival(
            probed.offset_m,
            n_before,
            n_survived,
            lambda offset_m: fit.shape.survival(distance_m(offset_m - fit.centre_m, axes)),
        ),
    )


def offset_text(fit: OverlayFit, probed: ProbeCounts) -> str:
    """The position of the mobile tweezers in the run, as text."""
    along, across = (format_quantity(float(-centre), "length") for centre in fit.centre_m)
    use = " beyond the correction of the overlay in use" if np.any(probed.in_use_m) else ""
    where = f"{along} along a row and {across} from row to row away from the sites{use}"
    return f"{fit.n_atoms} atoms: the mobile tweezers were {where}"
