"""Checking, comparing and following plans, and what planners are expected to give."""

from __future__ import annotations

from labseq.model import PlanReport, follow_atoms
from labseq.model.grid import PAPERS_LOADING
from labseq.motion import check_plan, choose_plan, fitting_batches
from labseq.motion.expectation import Expected, expect, random_loadings

__all__ = [
    "PAPERS_LOADING",
    "Expected",
    "PlanReport",
    "check_plan",
    "choose_plan",
    "expect",
    "fitting_batches",
    "follow_atoms",
    "random_loadings",
]
