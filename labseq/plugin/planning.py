"""Checking, comparing and following plans."""

from __future__ import annotations

from labseq.model import PlanReport, follow_atoms
from labseq.motion import check_plan, choose_plan, fitting_batches

__all__ = [
    "PlanReport",
    "check_plan",
    "choose_plan",
    "fitting_batches",
    "follow_atoms",
]
