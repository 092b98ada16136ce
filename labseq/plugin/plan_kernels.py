"""Kernels that grow a plan: atom moves, batches, the batches of a line."""

from __future__ import annotations

from labseq.motion.plan_kernels import (
    FINISHED_PLAN,
    GROWING_PLAN,
    FinishedPlan,
    GrowingPlan,
    Line,
    add_line,
    add_move,
    add_turns,
    as_plan,
    column_sums,
    count_moves,
    empty_plan,
    end_batch,
    finished,
    move_alone,
    sites_of,
    take_turns,
    unlock_row,
)

__all__ = [
    "FINISHED_PLAN",
    "GROWING_PLAN",
    "FinishedPlan",
    "GrowingPlan",
    "Line",
    "add_line",
    "add_move",
    "add_turns",
    "as_plan",
    "column_sums",
    "count_moves",
    "empty_plan",
    "end_batch",
    "finished",
    "move_alone",
    "sites_of",
    "take_turns",
    "unlock_row",
]
