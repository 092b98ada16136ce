"""Checking, comparing and following plans, and predictions for planners."""

from __future__ import annotations

from labseq.model import PlanReport, follow_atoms
from labseq.motion import check_plan, choose_plan, fitting_batches, pass_hazard
from labseq.motion.expectation import Expected, expect, random_loadings
from labseq.roles import loading_of

__all__ = [
    "Expected",
    "PlanReport",
    "check_plan",
    "choose_plan",
    "expect",
    "fitting_batches",
    "follow_atoms",
    "loading_of",
    "pass_hazard",
    "random_loadings",
]
