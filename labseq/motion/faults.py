"""Raises the errors for the faults that the checks of a plan and of its tones find."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NoReturn

from labseq.errors import InvalidPlanError, LimitError
from labseq.model import MotionSpec, Plan, RfSpec, SiteGrid
from labseq.motion import check_kernels, path_kernels
from labseq.motion.axes import AXES, AxisIndex
from labseq.motion.tone_kernels import AMPLITUDES, BAND, SPACING
from labseq.motion.tones import path_geometry
from labseq.units import format_quantity

FAULTS: Final[Mapping[str, tuple[str, str]]] = {
    "EMPTY_BATCH": ("shape", "it has no atom moves; leave it out"),
    "SOURCE_OUTSIDE": ("grid", "the source {site} is outside the grid of {n_rows} x {n_cols} sites"),
    "GOAL_OUTSIDE": ("grid", "the goal {site} is neither on the grid nor within {slots} site(s) of its edge"),
    "DIAGONAL": ("straight", "{source} -> {goal} changes row and column; split it into two linked batches"),
    "NO_LENGTH": ("straight", "{source} -> {goal} goes nowhere; an atom may wait only in linked batches"),
    "TWO_AXES": ("straight", "atom move {a} follows a row, {b} a column, so their crossing goes diagonally"),
    "LINKED_FIRST": ("linked", "the first batch has no batch before it to link to"),
    "LINKED_AFTER_EJECTION": (
        "linked",
        "the batch before it ejects atoms, so its tweezers ramp down at the end",
    ),
    "LINKED_NUMBER": ("linked", "it moves {a} atoms but the batch before holds {b}"),
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
    "CROSSING_ON_ATOM": ("crossing", "its tones also cross on the atom on {site}, which it does not name"),
    "PATH_OVER_ATOM": ("path", "its tones cross the atom on {site} on their way or at its end"),
    "LINKED_AFTER_PATHS": (
        "linked",
        "it or the batch before has paths of tones; only line batches can be linked",
    ),
    "PATH_SHAPE": ("tones", "its paths have fewer than two knots, or an axis has no tone"),
    "PATH_POSITION": ("tones", "a position of {axis} tone {b} is not finite"),
    "PATH_OFF": (
        "tones",
        "{axis} tones go off at knots from 1 to the last, at least one at the last, but tone {b} does not",
    ),
    "PATH_OUTSIDE": ("grid", "{axis} tone {b} goes more than {slots} site(s) beyond the grid's edge"),
    "PATH_ORDER": (
        "order",
        "{axis} tone {b} comes closer than {least} sites to the one before, or passes it",
    ),
    "PATH_NO_TONE": ("tones", "no {axis} tone starts at {source}"),
    "PATH_END": (
        "tones",
        "{source} -> {goal}, but its {axis} tone is elsewhere at knot {b}, where the atom is dropped",
    ),
    "PATH_PICKS_UP": (
        "crossing",
        "a tweezer that it does not name switches on at the atom on {site} or too near to it",
    ),
    "PATH_NEAR_ATOM": ("path", "a tweezer comes closer than {clearance} to the atom on {site}"),
    "PATH_LANDS": (
        "path",
        "an empty tweezer ends on the atom on {site}, but empty_tweezers_may_land is off",
    ),
    "INNER_EJECTION": ("ejection", "an atom would be ejected over the one on {site}; eject that one first"),
}
"""Rule and wording of each fault of :mod:`labseq.motion.check_kernels`, by name."""
_AT_A_SITE: Final = {"INNER_EJECTION", *(name for name, (_, text) in FAULTS.items() if "{site}" in text)}
"""Faults that give a site as their two numbers."""


def raise_plan_error(
    fault: int,
    fault_place: list[int],
    plan: Plan,
    grid: SiteGrid,
    max_tweezers: int,
    motion: MotionSpec,
    planner: str,
) -> NoReturn:
    """Raise the error for a fault.

    Args:
        fault: Number of the fault, from the kernels of the check.
        fault_place: Its batch, its atom move or -1, and two numbers whose meaning depends on the fault.
        max_tweezers: Most tweezers on at once.
        motion: How the tweezers move.
        planner: Name of the planner, or "".
    """
    batch, move, a, b = (int(number) for number in fault_place)
    name = next(name for name in FAULTS if (vars(path_kernels) | vars(check_kernels)).get(name) == fault)
    rule, wording = FAULTS[name]
    row = col = to_row = to_col = -1  # only used in messages about an atom move
    if move >= 0:
        row, col, to_row, to_col = plan.moves[plan.batch_offsets[batch] + move].tolist()
    detail = wording.format(
        source=(row, col),
        goal=(to_row, to_col),
        site=(a, b),
        a=a,
        b=b,
        n_tweezers=a * b,
        limit=max_tweezers,
        n_rows=grid.n_rows,
        n_cols=grid.n_cols,
        slots=motion.eject_slots,
        axis=AXES[a] if a in (0, 1) else "",
        least=f"{path_geometry(grid, motion)[2]:.3g}",
        clearance=format_quantity(motion.clearance_m, "length"),
    )
    site = (a, b) if name in _AT_A_SITE else None
    raise InvalidPlanError(rule, detail, batch=batch, move=move, planner=planner, site=site)


def raise_limit_error(
    fault: int, value: float, axis: AxisIndex, tone: int, n_tones: int, batch: int, rf: RfSpec
) -> NoReturn:
    """Raise the error for an exceeded limit.

    Args:
        fault: Number of the limit, from ``first_excess`` of the kernels.
        value: The excessive value, which is a frequency or distance in Hz, or a sum of amplitudes or squares.
        axis: 0 for the rows' tones, 1 for the columns'.
        tone: The tone, from 0 in its segment.
        n_tones: Number of tones of the segment.
        batch: Its batch.
        rf: The limits, as the profile states them.
    """
    name = AXES[axis]
    frequency, rf_settings = ("grid", f"{name}_frequency"), ("mobile_tweezers", "rf")
    in_batch = f"in batch {batch}"
    all_tones = f"{name} tones 0 to {n_tones - 1} {in_batch}" if n_tones > 1 else f"{name} tone 0 {in_batch}"
    if fault == BAND:
        low, high = (f"{hz / 1e6:.6g}" for hz in (rf.row_band_hz, rf.column_band_hz)[axis])
        quantity = f"the frequency of {name} tone {tone} {in_batch}"
        limit = f"the band of {low} to {high} MHz"
        raise LimitError(quantity, f"{value / 1e6:.6g} MHz", limit, setting=frequency)
    if fault == SPACING:
        quantity = f"the distance of {name} tones {tone - 1} and {tone} {in_batch}"
        least = format_quantity(rf.min_spacing_hz, "frequency")
        raise LimitError(
            quantity,
            f"{value / 1e6:.6g} MHz",
            f"{least} at least, in the order of the sites",
            setting=frequency,
        )
    if fault == AMPLITUDES and rf.full_scale_v > rf.max_peak_v:
        quantity = f"the peak voltage of {all_tones}"
        amount = format_quantity(value * rf.full_scale_v, "voltage")
        limit = f"{format_quantity(rf.max_peak_v, 'voltage')}, because more ruins the amplifier"
        raise LimitError(quantity, amount, limit, setting=rf_settings)
    if fault == AMPLITUDES:
        quantity = f"the sum of the amplitudes of {all_tones}"
        raise LimitError(
            quantity, f"{value:.6g} of full scale", "1, because the output would clip", setting=rf_settings
        )
    power_w = value * rf.full_scale_power_w
    limit = f"{format_quantity(rf.max_mean_power_w, 'power')} at the AOD"
    quantity = f"the mean RF power of {all_tones}"
    raise LimitError(quantity, format_quantity(power_w, "power"), limit, setting=rf_settings)
