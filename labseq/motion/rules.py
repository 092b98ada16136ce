"""The rules of a plan, and what to say where one is broken."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

RULES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "shape": "plan, occupancy, target and grid belong together, and no batch is empty",
        "grid": "atoms come from the grid, and go to a site of it or to an ejection slot",
        "straight": "an atom moves along one row or one column, and all atoms of a batch along the same axis",
        "linked": "a linked batch starts from exactly the goals of the batch before it, none of them outside",
        "source": "an atom that is moved is there, and is moved once in a batch",
        "goal": "a goal is free once the batch's own atoms are lifted, and no two atoms share one",
        "tones": "one trajectory per tone, and no more tones than an axis can play",
        "order": "the tones of an axis keep their order and at least one site of distance",
        "parallelism": "every crossing of a row tone and a column tone counts as a tweezer",
        "crossing": "a crossing that the plan does not name picks up no atom",
        "path": "no crossing, named or not, passes over or ends on an atom that stands",
        "ejection": "only the outermost atoms of a line are ejected",
    }
)
"""The rules of :func:`labseq.check_plan`: name -> meaning."""

FAULTS: Final[Mapping[str, tuple[str, str]]] = {
    "EMPTY_BATCH": ("shape", "it has no atom moves; leave it out"),
    "SOURCE_OUTSIDE": ("grid", "the source {site} lies outside of the grid of {n_rows} x {n_cols} sites"),
    "GOAL_OUTSIDE": ("grid", "the goal {site} is neither on the grid nor within {slots} site(s) of its edge"),
    "DIAGONAL": ("straight", "{source} -> {goal} changes row and column; split it into two linked batches"),
    "NO_LENGTH": ("straight", "{source} -> {goal} goes nowhere; only in linked batches may an atom wait"),
    "TWO_AXES": ("straight", "atom move {a} follows a row, {b} a column, so their crossing goes diagonally"),
    "LINKED_FIRST": ("linked", "the first batch has none before it to be linked to"),
    "LINKED_AFTER_EJECTION": ("linked", "the batch before it ejects, and tweezers ramp down there"),
    "LINKED_NUMBER": ("linked", "it moves {a} atoms while {b} are held from the batch before"),
    "LINKED_ELSEWHERE": ("linked", "its source {site} is not a goal of the batch before"),
    "NO_ATOM": ("source", "there is no atom on {site}"),
    "SOURCE_TWICE": ("source", "another atom move of the batch starts from {site} too"),
    "GOAL_TAKEN": ("goal", "{source} -> {goal} ends on an atom that stays there"),
    "GOAL_TWICE": ("goal", "another atom move of the batch ends on {site} too"),
    "ROW_TONE_SPLIT": ("tones", "{source} -> {goal}, but the tone of row {a} goes to row {b}"),
    "COLUMN_TONE_SPLIT": ("tones", "{source} -> {goal}, but the tone of column {a} goes to column {b}"),
    "ROW_TONES": ("tones", "it needs {a} row tones; the limit is {b}"),
    "COLUMN_TONES": ("tones", "it needs {a} column tones; the limit is {b}"),
    "ROW_ORDER": ("order", "the tones of rows {a} and {b} meet or pass each other"),
    "COLUMN_ORDER": ("order", "the tones of columns {a} and {b} meet or pass each other"),
    "TWEEZERS": (
        "parallelism",
        "{a} row x {b} column tones make {n_tweezers} tweezers; the limit is {limit}",
    ),
    "CROSSING_ON_ATOM": ("crossing", "its tones cross on the atom on {site} too, which it does not name"),
    "PATH_OVER_ATOM": ("path", "its tones cross the atom that stands on {site} on their way or at its end"),
    "INNER_EJECTION": ("ejection", "an atom would be ejected over the one on {site}; eject that one first"),
}
"""Faults of :mod:`labseq.kernels.plan_rules`: name -> rule, wording."""
