"""Turns a plan into the tones of the mobile tweezers. :mod:`labseq.motion.rendering` makes samples of them.

Importing this package imports no numba. The kernels come with the first call, or with :func:`warm`.
"""

import importlib

from labseq.model.calibration import correct_overlay
from labseq.motion.axes import CombFit, Drive, drive, fit_comb
from labseq.motion.check import RULES, check_plan
from labseq.motion.survival import Survival, choose_plan, pass_hazard, predict_survival
from labseq.motion.tones import fitting_batches, tone_program

__all__ = [
    "RULES",
    "CombFit",
    "Drive",
    "Survival",
    "check_plan",
    "choose_plan",
    "correct_overlay",
    "drive",
    "fit_comb",
    "fitting_batches",
    "pass_hazard",
    "predict_survival",
    "tone_program",
    "warm",
]


def warm() -> None:
    """Compile the kernels of checks and tone programs, or load them from the cache."""
    for kernels in ("check_kernels", "survival_kernels", "tone_kernels"):
        importlib.import_module(f"labseq.motion.{kernels}")
