"""From a plan to what the mobile tweezers play.

Importing this package imports no numba: the kernels come with the first call, or
with :func:`warm` and :func:`warm_rendering`.
"""

import importlib

from labseq.motion.axes import Drive, drive
from labseq.motion.calibration import (
    AffineCalibration,
    Calibration,
    CombFit,
    TableCalibration,
    calibrated,
    fit_comb,
    standing_on_sites,
)
from labseq.motion.check import check_plan
from labseq.motion.fast_overlay import FastOffset, fast_offset, group_counts
from labseq.motion.frequencies import FrequenciesFit, fit_frequencies
from labseq.motion.holding import cross_offsets_m, hold_program, hold_time_s
from labseq.motion.overlay import OverlayFit, fit_overlay, overlay_offset
from labseq.motion.render_comb import comb_sample_rate
from labseq.motion.rendering import Renderer, RenderPath, render, render_chunks
from labseq.motion.rules import RULES
from labseq.motion.survival import SurvivalShape
from labseq.motion.timing import fitting_batches
from labseq.motion.tones import tone_program

__all__ = [
    "RULES",
    "AffineCalibration",
    "Calibration",
    "CombFit",
    "Drive",
    "FastOffset",
    "FrequenciesFit",
    "OverlayFit",
    "RenderPath",
    "Renderer",
    "SurvivalShape",
    "TableCalibration",
    "calibrated",
    "check_plan",
    "comb_sample_rate",
    "cross_offsets_m",
    "drive",
    "fast_offset",
    "fit_comb",
    "fit_frequencies",
    "fit_overlay",
    "fitting_batches",
    "group_counts",
    "hold_program",
    "hold_time_s",
    "overlay_offset",
    "render",
    "render_chunks",
    "standing_on_sites",
    "tone_program",
    "warm",
    "warm_rendering",
]


def warm() -> None:
    """Compile the kernels of checks and tone programs, or load them from the cache."""
    _load("plan_check", "tone_build", "tone_limits")


def warm_rendering() -> None:
    """The same for those of rendering, which only drivers need that play samples."""
    _load("render_axis", "render_paths", "render_teeth", "render_tones")


def _load(*kernels: str) -> None:
    for module in kernels:
        importlib.import_module(f"labseq.kernels.{module}")
