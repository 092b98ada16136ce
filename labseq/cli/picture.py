"""Draws the whole live view as text of a given size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from rich.text import Text

from labseq.cli.array import Scale, draw_array, scales
from labseq.cli.glyphs import Glyphs
from labseq.cli.output import columns
from labseq.cli.scan_plot import draw_scan
from labseq.cli.tally import StageTally, Tally
from labseq.cli.words import clock_time, count_of, percent, plural
from labseq.model import RunRecord
from labseq.recording.rates import jeffreys
from labseq.units import format_quantity

SIDE_WIDTH: Final = 48
GAP: Final = 3
SCAN_HEIGHT: Final = 8
"""Most lines of the plot of a scan."""


def draw(tally: Tally, recent: Sequence[str], width: int, height: int, glyphs: Glyphs) -> Text:
    """Draw the view.

    What does not fit is left out: first the array becomes smaller, then it goes,
    then the latest events and the table of stages.

    Args:
        tally: What is known of the run.
        recent: The latest events, oldest first.
        width: Columns of the terminal.
        height: Lines of the terminal.
        glyphs: The characters to draw with.
    """
    room = height - 1  # the cursor's line
    lines = [_progress(tally, width, glyphs)]
    side = _side(tally, glyphs, room - 1)
    body = _beside(_array(tally, width, room - 1, glyphs), side)
    spare = room - len(body) - 4
    lines += [Text()] * (spare > 0) + body[: max(0, room - 1)] + [Text()] * (spare > 1)
    n_recent = min(len(recent), max(0, room - len(lines)))
    lines += [Text(text, style="dim") for text in recent[len(recent) - n_recent :]]
    for line in lines:
        line.truncate(width)
    return Text("\n", no_wrap=True, end="").join(lines)


def _progress(tally: Tally, width: int, glyphs: Glyphs) -> Text:
    left_s = tally.time_left_s()
    n_on_disk = tally.n_before + tally.n_done
    text = f"  {n_on_disk}/{tally.n_shots} shots"
    if tally.status:
        text += f"  {tally.status}"
    elif not math.isnan(left_s):
        text += f"  {clock_time(left_s)} left"
    name = tally.record.name if tally.record is not None else ""
    bar = min(60, max(0, width - len(name) - len(text) - 2))
    n_done = min(bar, round(bar * n_on_disk / max(1, tally.n_shots)))
    return Text.assemble(
        (f"{name}  ", "bold"), (glyphs.done * n_done, "green"), (glyphs.left * (bar - n_done), "dim"), text
    )


def _array(tally: Tally, width: int, room: int, glyphs: Glyphs) -> list[Text]:
    """The array of the last image, as large as it fits beside the numbers; nothing if it does not."""
    if tally.image is None or tally.record is None:
        return []
    occupancy, shear = tally.image.occupancy, shear_of(tally.record)
    free = width - GAP - SIDE_WIDTH
    fitting: Scale | None = None
    for scale in scales(glyphs):
        array_width, array_height = scale.size(*occupancy.shape, sheared=shear != 0)
        if array_width <= free and array_height <= room:
            fitting = scale
            break
    if fitting is None:
        return []
    lines = draw_array(occupancy, tally.record.target, shear, fitting, glyphs)
    array_width, _ = fitting.size(*occupancy.shape, sheared=shear != 0)
    for line in lines:
        line.pad_right(array_width - line.cell_len)
    return lines


def shear_of(run: RunRecord) -> int:
    """+1 or -1 on the triangular lattice, 0 on the square one."""
    if run.lattice != "triangular":
        return 0
    return -1 if run.resolved.get("profile", {}).get("grid", {}).get("shear") == -1 else 1


def _beside(array: list[Text], side: list[Text]) -> list[Text]:
    """The numbers, or the array with the numbers to its right."""
    if not array:
        return side
    blank = " " * array[0].cell_len
    lines: list[Text] = []
    for i in range(max(len(array), len(side))):
        left = array[i] if i < len(array) else Text(blank)
        right = side[i] if i < len(side) else Text()
        lines.append(Text.assemble(left, " " * GAP, right))
    return lines


def _side(tally: Tally, glyphs: Glyphs, room: int) -> list[Text]:
    lines = [*_rates(tally, glyphs), Text(), *_stages(tally)]
    caption = _caption(tally)
    if caption:
        lines += [Text(), *caption]
    free = room - len(lines) - 1
    plot = [] if tally.scan is None else draw_scan(tally.scan, SIDE_WIDTH, min(free, SCAN_HEIGHT), glyphs)
    return [*lines, Text(), *plot] if plot else lines


def _rates(tally: Tally, glyphs: Glyphs) -> list[Text]:
    rate = count_of(tally.n_defect_free, tally.n_done)
    if tally.n_done:
        low, high = (100 * end for end in jeffreys(tally.n_defect_free, tally.n_done))
        rate += f", {low:.0f}{glyphs.to}{high:.0f} %"
    mean, error = tally.filling()
    filling = percent(mean, 2)
    if not math.isnan(error):
        filling = f"{100 * mean:.2f} {glyphs.plus_minus} {100 * error:.2f} %"
    lines = [
        Text.assemble(("defect-free       ", "bold"), rate),
        Text.assemble(("seen defect-free  ", "bold"), count_of(tally.n_seen, tally.n_done)),
        Text.assemble(("filling           ", "bold"), filling),
    ]
    if tally.best:
        lines.append(Text.assemble(("best so far       ", "bold"), tally.best))
    if tally.n_repeated:
        lines.append(
            Text.assemble(("repeated          ", "bold"), (plural(tally.n_repeated, "attempt"), "yellow"))
        )
    return lines


def _stages(tally: Tally) -> list[Text]:
    simulated = tally.record is None or tally.record.simulated
    seen = [(name, stage) for name, stage in tally.stages.items() if stage.host_s]
    heads = ("host", "p99", "modelled") if simulated else ("p50", "p99")
    table = [("stage", *heads, "budget", "over")]
    table += [_stage_row(name, stage, simulated=simulated) for name, stage in seen]
    header, *rows = columns(table, right=range(1, len(heads) + 3))
    styles = ["yellow" if stage.n_over else "" for _, stage in seen]
    return [Text(header, "bold"), *(Text(row, style) for row, style in zip(rows, styles, strict=True))]


def _stage_row(name: str, stage: StageTally, *, simulated: bool) -> tuple[str, ...]:
    """On real hardware both clocks are the same."""
    host_s, session_s = stage.medians_s()
    times_s = (host_s, stage.p99_s(), session_s) if simulated else (session_s, stage.p99_s())
    budget = "-" if math.isnan(stage.budget_s) else format_quantity(stage.budget_s, "time")
    over = str(stage.n_over) if stage.n_over else ""
    return name, *(format_quantity(time_s, "time") for time_s in times_s), budget, over


def _caption(tally: Tally) -> list[Text]:
    if tally.image is None or tally.record is None:
        return []
    image, target = tally.image, tally.record.target
    which = f"cycle {image.cycle}" if image.cycle else f"step {image.step}"
    n_defects, n_surplus = target.n_defects(image.occupancy), target.n_surplus(image.occupancy)
    found = "defect-free" if not n_defects and not n_surplus else plural(n_defects, "defect")
    if n_surplus:
        found += f", {n_surplus} surplus"
    atoms = f"{int(image.occupancy.sum())} atoms, {found}"
    return [
        Text(f"shot {tally.image_shot + 1}, image of {which}:"),
        Text(atoms, "green" if found == "defect-free" else ""),
    ]
