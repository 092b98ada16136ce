"""From a plan to the tones and samples of the mobile tweezers.

Importing this package imports no numba: the kernels come with the first call, or
with :func:`warm` and :func:`warm_rendering`.
"""

import importlib

from labseq.model.calibration import correct_overlay
from labseq.motion.axes import (
    CombFit,
    Drive,
    drive,
    fit_comb,
)
from labseq.motion.check import RULES, check_plan
from labseq.motion.rendering import Renderer, RenderPath, comb_sample_rate, render, render_address
from labseq.motion.survival import Survival, choose_plan, predict_survival
from labseq.motion.tones import fitting_batches, tone_program

__all__ = [
    "RULES",
    "CombFit",
    "Drive",
    "RenderPath",
    "Renderer",
    "Survival",
    "check_plan",
    "choose_plan",
    "comb_sample_rate",
    "correct_overlay",
    "drive",
    "fit_comb",
    "fitting_batches",
    "predict_survival",
    "render",
    "render_address",
    "tone_program",
    "warm",
    "warm_rendering",
]


def warm() -> None:
    """Compile the kernels of checks and tone programs, or load them from the cache."""
    _load("check_kernels", "survival_kernels", "tone_kernels")


def warm_rendering() -> None:
    """Compile or load the kernels of rendering, for drivers that play samples."""
    _load("render_direct_kernels", "render_comb_kernels")


def _load(*kernels: str) -> None:
    for module in kernels:
        importlib.import_module(f"labseq.motion.{module}")
