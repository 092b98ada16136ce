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
)
from labseq.motion.check import check_plan
from labseq.motion.render_comb import comb_sample_rate
from labseq.motion.rendering import Renderer, RenderPath, render, render_chunks
from labseq.motion.rules import RULES
from labseq.motion.timing import fitting_batches
from labseq.motion.tones import tone_program

__all__ = [
    "RULES",
    "AffineCalibration",
    "Calibration",
    "CombFit",
    "Drive",
    "RenderPath",
    "Renderer",
    "TableCalibration",
    "calibrated",
    "check_plan",
    "comb_sample_rate",
    "drive",
    "fit_comb",
    "fitting_batches",
    "render",
    "render_chunks",
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
