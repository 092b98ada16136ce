"""The live view of a run in the terminal, in its own process or another."""

from __future__ import annotations

import io
import math
import os
import re
import statistics
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Final, Protocol, TextIO, cast

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.live import Live
from rich.style import Style
from rich.text import Text

from labseq.analysis.statistics import jeffreys
from labseq.cli.show import chosen_run, shot_time_s, summary_lines
from labseq.console.output import (
    LASTING,
    UNICODE,
    Glyphs,
    LogLines,
    best_text,
    clock_time,
    columns,
    count_of,
    event_text,
    glyphs_for,
    percent,
    plural,
    say,
)
from labseq.errors import RecordingError
from labseq.files import whole_lines
from labseq.model import ImageRecord, Occupancy, RunRecord, ShotRecord, StageTiming, TargetPattern
from labseq.plain import parse_object
from labseq.recording import Run, Shot, open_run
from labseq.recording.folders import EVENTS_FILE, INDEX_FILE
from labseq.recording.reader import SCANNER, ChosenPoints
from labseq.recording.run_file import is_index_row, read_state
from labseq.recording.shot import load_content
from labseq.roles import RunObserver
from labseq.units import format_quantity

MIN_WIDTH: Final = 16
MIN_HEIGHT: Final = 4
"""Lines that a plot takes at least, its title and the line below it included."""
BAR: Final = 5
"""Most characters that the bar of a point is wide."""
LABEL: Final = 7
"""Characters of the numbers on the left."""
FILLING_RANGE: Final = 0.01
"""Least range of filling that is shown."""


@dataclass(slots=True)
class PointTally:
    """Shots of a point of a scan.

    Attributes:
        n_shots: How many are complete and have been judged.
        n_defect_free: How many of them met the target.
        filling: Sum of their filling fractions.
    """

    n_shots: int = 0
    n_defect_free: int = 0
    filling: float = 0.0

    def __iadd__(self, other: PointTally) -> PointTally:
        self.n_shots += other.n_shots
        self.n_defect_free += other.n_defect_free
        self.filling += other.filling
        return self


@dataclass(slots=True)
class ScanTally:
    """The points of a scan, while it goes on.

    Attributes:
        scan: What the run's record says of it.
    """

    scan: Mapping[str, Any]
    _points: dict[int, PointTally] = field(default_factory=dict[int, PointTally])
    _chosen: ChosenPoints | None = None

    def __post_init__(self) -> None:
        if SCANNER in self.scan:
            self._chosen = ChosenPoints(self.scan)

    def add(self, shot: ShotRecord) -> None:
        """Count a shot; one that was not judged, or of a point that is not known, does not count."""
        number = self._number(shot)
        if number is None or math.isnan(shot.filling_fraction):
            return
        point = self._points.setdefault(number, PointTally())
        point += PointTally(1, int(shot.success), shot.filling_fraction)

    def _number(self, shot: ShotRecord) -> int | None:
        if self._chosen is not None:
            try:
                return self._chosen.number(shot.parameters)
            except KeyError:  # `labseq watch` on a damaged index
                return None
        of_shot: Sequence[int] = self.scan.get("point_of_shot", ())
        return of_shot[shot.shot_index] if 0 <= shot.shot_index < len(of_shot) else None

    @property
    def name(self) -> str:
        """What is scanned."""
        addresses = cast("Sequence[str]", self.scan.get("addresses", ()))
        return ", ".join(addresses)

    def points(self) -> list[tuple[str, PointTally]]:
        """Each point as it is written, with its shots; by value where one number is scanned."""
        told = self._chosen
        written: Sequence[Sequence[str]] = self.scan.get("written", ()) if told is None else told.written
        values: Sequence[Sequence[Any]] = self.scan.get("points", ()) if told is None else told.points
        order = list(range(len(written)))
        if all(len(value) == 1 and isinstance(value[0], float | int) for value in values):
            order.sort(key=lambda i: values[i][0])
        return [(", ".join(written[i]), self._points.get(i, PointTally())) for i in order]


def draw_scan(tally: ScanTally, width: int, height: int, glyphs: Glyphs) -> list[Text]:
    """Draw the share of defect-free shots at each point; the filling, as long as there are none.

    Args:
        tally: The scan.
        width: Characters per line.
        height: Lines, title and words below included.
        glyphs: The characters to draw with.

    Returns:
        Nothing if there is no room, or no shot yet.
    """
    points = tally.points()
    shown = _merged([point for _, point in points], width - LABEL)
    taken = [point for point in shown if point.n_shots]
    if not taken or width < MIN_WIDTH or height < MIN_HEIGHT:
        return []
    is_rate = any(point.n_defect_free for point in taken)
    values = [_value(point, is_rate=is_rate) for point in shown]
    known = [value for value in values if value is not None]
    high = max(known)
    low = 0.0 if is_rate else min(*known, high - FILLING_RANGE)
    bar = max(1, min(BAR, (width - LABEL) // len(shown)))
    rows = _bars(values, low, high, height - 2, bar, glyphs)
    ends = [f"{100 * end:.3g} %".rjust(LABEL - 1) + " " for end in (high, low)]
    margins = [ends[0], *[" " * LABEL] * (len(rows) - 2), ends[1]]
    what = "defect-free" if is_rate else "filling"
    lines = [Text(f"{what} by {tally.name}", "bold")]
    lines += [
        Text.assemble((margin, "dim"), (row, "cyan")) for margin, row in zip(margins, rows, strict=True)
    ]
    return [*lines, Text(" " * LABEL + _words([word for word, _ in points], bar * len(shown)), "dim")]


def _merged(points: Sequence[PointTally], room: int) -> list[PointTally]:
    """As many points as there is room for: neighbours are taken together if there are more."""
    n = min(len(points), max(1, room))
    cuts = [round(i * len(points) / n) for i in range(n + 1)] if n else []
    merged: list[PointTally] = []
    for first, end in pairwise(cuts):
        total = PointTally()
        for point in points[first:end]:
            total += point
        merged.append(total)
    return merged


def _value(point: PointTally, *, is_rate: bool) -> float | None:
    if not point.n_shots:
        return None
    return (point.n_defect_free if is_rate else point.filling) / point.n_shots


def _bars(
    values: Sequence[float | None], low: float, high: float, height: int, bar: int, glyphs: Glyphs
) -> list[str]:
    """Columns, a line of text per row, the highest first; the least value is still a thin line."""
    steps = len(glyphs.levels)
    full = height * steps
    filled = [0 if v is None else max(1, round((v - low) / (high - low) * full)) for v in values]
    gap = " " if bar > 1 else ""
    rows: list[str] = []
    for row in reversed(range(height)):
        cells = (min(steps, max(0, n - row * steps)) for n in filled)
        rows.append("".join((" " if not n else glyphs.levels[n - 1]) * (bar - len(gap)) + gap for n in cells))
    return rows


def _words(words: Sequence[str], width: int) -> str:
    """The first and the last value below the ends of the plot, as far as there is room."""
    first, last = words[0], words[-1]
    if len(words) == 1 or len(first) + len(last) + 1 > width:
        return first if len(words) == 1 else f"{first} to {last}"
    return first + last.rjust(width - len(first))


STAGES: Final = ("expose", "read_out", "detect", "plan", "check", "prepare", "play", "move", "write")
"""The stages that are shown; a shot has others."""

_KEPT: Final = 200
"""How many of the latest durations of a stage its median is taken of."""


@dataclass(slots=True)
class StageTally:
    """Durations of one stage.

    Attributes:
        host_s: On this computer's clock, the latest ones.
        duration_s: On the session's clock, the latest ones.
        budget_s: The latest budget; nan if it has none.
        n_over: How often it went over its budget.
    """

    host_s: deque[float] = field(default_factory=lambda: deque[float](maxlen=_KEPT))
    duration_s: deque[float] = field(default_factory=lambda: deque[float](maxlen=_KEPT))
    budget_s: float = math.nan
    n_over: int = 0

    def add(self, timing: StageTiming) -> None:
        """Count one more."""
        self.host_s.append(timing.host_s)
        self.duration_s.append(timing.duration_s)
        self.budget_s = timing.budget_s
        self.n_over += timing.over_budget

    def medians_s(self) -> tuple[float, float]:
        """Median on this computer's clock, and on the session's."""
        return statistics.median(self.host_s), statistics.median(self.duration_s)

    def p99_s(self) -> float:
        """The 99th percentile on this computer's clock: the second longest of 200."""
        longest = sorted(self.host_s)
        return longest[math.ceil(0.99 * len(longest)) - 1]


class Tally:
    """Sums up a run's events; unknown events are ignored.

    Args:
        now: Monotonic time in seconds.

    Attributes:
        record: The run, from "run_starting" on.
        run_dir: Its folder, or "".
        n_before: Shots that were complete when the run was resumed.
        n_done: Shots that are complete since then.
        n_defect_free: How many of them met the target.
        n_seen: How many of them met it in some image.
        n_filled: How many of them have a filling fraction.
        n_repeated: Attempts that had to be repeated.
        image: The last image.
        image_shot: The shot that it is of.
        shot: The shot that runs, or the last one.
        stages: Stage -> its durations.
        scan: The points of the scan; None without one.
        best: The best point of an adaptive scan so far, in words, or "".
        status: How the run ended, or "".
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._first_shot_s = math.nan
        self.record: RunRecord | None = None
        self.run_dir = ""
        self.n_before = 0
        self.n_done = 0
        self.n_defect_free = 0
        self.n_seen = 0
        self.n_filled = 0
        self._mean_filling = 0.0
        self._sum_squares = 0.0
        self.n_repeated = 0
        self.image: ImageRecord | None = None
        self.image_shot = 0
        self.shot = 0
        self.stages = {name: StageTally() for name in STAGES}
        self.scan: ScanTally | None = None
        self.best = ""
        self.status = ""

    @property
    def n_shots(self) -> int:
        """Shots asked for."""
        return self.record.n_shots if self.record is not None else 0

    def note(self, name: str, values: Mapping[str, Any]) -> None:
        """Take an event into account."""
        match name:
            case "stage":
                timing: StageTiming = values["timing"]
                if timing.stage in self.stages:
                    self.stages[timing.stage].add(timing)
            case "image":
                self.image, self.image_shot = values["image"], self.shot
            case "shot_started":
                self.shot = values["shot"]
                if math.isnan(self._first_shot_s):
                    self._first_shot_s = self._now()
            case "shot_finished":
                self._count(values["shot"])
            case "shot_repeated":
                self.n_repeated += 1
            case "run_starting":
                self.record, self.run_dir = values["record"], values["run_dir"]
                self.n_before = values.get("n_before", 0)
                self.status = ""
                if self.scan is None and values["record"].scan:  # a run that is resumed goes on with its own
                    self.scan = ScanTally(values["record"].scan)
            case "scan_point":
                self.best = best_text(values)
            case "run_finished":
                self.status = values["status"]
            case _:
                pass

    def _count(self, shot: ShotRecord) -> None:
        if shot.status != "complete":
            return
        self.n_done += 1
        self.n_defect_free += shot.success
        self.n_seen += shot.success or shot.seen_defect_free_cycle > 0
        if self.scan is not None:
            self.scan.add(shot)
        if not math.isnan(shot.filling_fraction):
            self._add_filling(shot.filling_fraction)

    def _add_filling(self, value: float) -> None:
        """Update mean and sum of squares without keeping the values (Welford, Technometrics 4, 419, 1962)."""
        self.n_filled += 1
        step = value - self._mean_filling
        self._mean_filling += step / self.n_filled
        self._sum_squares += step * (value - self._mean_filling)

    def filling(self) -> tuple[float, float]:
        """Mean filling fraction and its standard error; nan where there are too few shots."""
        n = self.n_filled
        mean = self._mean_filling if n else math.nan
        error = math.sqrt(self._sum_squares / (n - 1) / n) if n > 1 else math.nan
        return mean, error

    def time_left_s(self) -> float:
        """Expected time to the end of the run, by the shots so far; nan before the first is done."""
        if not self.n_done:
            return math.nan
        return (self._now() - self._first_shot_s) / self.n_done * (self.n_shots - self.n_before - self.n_done)


EMPTY, RESERVOIR, SURPLUS, ATOM, DEFECT = range(5)

_COLOURS: Final = ("default", "bright_black", "yellow", "green", "red")
_STYLES: Final = tuple(Style(color=colour, bold=i == DEFECT) for i, colour in enumerate(_COLOURS))
_HALVES: Final = {
    (upper, lower): Style(
        color=_COLOURS[upper or lower], bgcolor=_COLOURS[lower] if upper and lower else None
    )
    for upper in range(5)
    for lower in range(5)
}


def kinds(occupancy: Occupancy, target: TargetPattern) -> NDArray[np.int8]:
    """What there is on each site, int8 (n_rows, n_cols): EMPTY, RESERVOIR, SURPLUS, ATOM or DEFECT."""
    atoms = np.where(target.fill, ATOM, np.where(target.clear, SURPLUS, RESERVOIR))
    return np.where(occupancy, atoms, np.where(target.fill, DEFECT, EMPTY)).astype(np.int8)


@dataclass(frozen=True, slots=True)
class Scale:
    """How large the sites are drawn.

    Attributes:
        cell: Characters per site along a row.
        rows: Rows of sites per line.
    """

    cell: int
    rows: int

    def size(self, n_rows: int, n_cols: int, sheared: bool) -> tuple[int, int]:
        """Width and height of the drawing, in characters."""
        height = -(-n_rows // self.rows)
        return n_cols * self.cell + (self._shift(n_rows - 1) if sheared else 0), height

    def indent(self, row: int, n_rows: int, shear: int) -> int:
        """By how many characters a row is moved to the right: half a site per row."""
        if not shear:
            return 0
        return self._shift(row) if shear > 0 else self._shift(n_rows - 1) - self._shift(row)

    def _shift(self, row: int) -> int:
        return row * self.cell // 2


ROOMY: Final = Scale(cell=2, rows=1)
DENSE: Final = Scale(cell=1, rows=1)
HALF_BLOCKS: Final = Scale(cell=1, rows=2)


def scales(glyphs: Glyphs) -> tuple[Scale, ...]:
    """The scales that these characters allow, largest first."""
    return (ROOMY, DENSE, HALF_BLOCKS) if glyphs.upper else (ROOMY, DENSE)


def draw_array(
    occupancy: Occupancy, target: TargetPattern, shear: int, scale: Scale, glyphs: Glyphs
) -> list[Text]:
    """Draw an occupancy, a line of text per row of sites (or per two rows).

    Args:
        occupancy: bool (n_rows, n_cols).
        target: What the array shall look like.
        shear: +1 if rows shift to the right on the way down, -1 to the left, 0 on a square lattice.
        scale: How large.
        glyphs: The characters to draw with.
    """
    n_rows = len(occupancy)
    rows: list[list[int]] = kinds(occupancy, target).tolist()
    if scale.rows == 1:
        lines = [_glyph_line(row, scale.cell, glyphs) for row in rows]
    else:
        blank = [EMPTY] * len(rows[0])
        lines = [_block_line(a, b, glyphs) for a, b in zip(rows[::2], [*rows[1::2], blank], strict=False)]
    for i, line in enumerate(lines):
        line.pad_left(scale.indent(i * scale.rows, n_rows, shear))
    return lines


def _glyph_line(row: list[int], cell: int, glyphs: Glyphs) -> Text:
    characters = (" ", glyphs.reservoir, glyphs.surplus, glyphs.atom, glyphs.defect)
    line = Text()
    for kind, run in groupby(row):
        line.append(characters[kind].ljust(cell) * len(list(run)), _STYLES[kind])
    return line


def _block_line(upper: list[int], lower: list[int], glyphs: Glyphs) -> Text:
    line = Text()
    for (a, b), run in groupby(zip(upper, lower, strict=True)):
        block = glyphs.both if a == b != EMPTY else glyphs.upper if a else glyphs.lower if b else " "
        line.append(block * len(list(run)), _HALVES[a, b])
    return line


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


REDRAW_S: Final = 0.25
"""The view is drawn at most this often."""

_BETWEEN_SHOTS: Final = frozenset(
    {"run_started", "leader_awaited", "shot_finished", "shot_repeated", "run_finished"}
)


class ClosableObserver(RunObserver, Protocol):
    """An observer that must be told when the run is over, in whatever way."""

    def refresh(self) -> None:
        """Show what has been told so far."""
        ...

    def close(self) -> None:
        """Leave the screen in order."""
        ...


def observer_for(stream: TextIO, run_now: Callable[[], float] | None = None) -> ClosableObserver:
    """The live view if the stream is a terminal that can show it, else plain lines.

    Args:
        stream: Where it is shown.
        run_now: Time of the run in seconds, where that is not the time of this process.
    """
    if stream.isatty() and os.environ.get("TERM", "") not in {"dumb", "unknown"}:
        return LiveView(Console(file=stream), run_now=run_now)
    return LogLines(stream)


class LiveView:
    """Implements ``RunObserver`` with a picture of the run that is drawn again and again.

    It is drawn from events only, never by a thread of its own, so never while a
    device is called; and with real hardware only between shots, since atoms are
    lost while the loop waits for a screen.

    Args:
        console: The terminal.
        now: Monotonic time in seconds.
        run_now: Time of the run in seconds; by default the same.
    """

    def __init__(
        self,
        console: Console,
        now: Callable[[], float] = time.monotonic,
        run_now: Callable[[], float] | None = None,
    ) -> None:
        self._console = console
        self._now = now
        self._glyphs = glyphs_for(console.encoding)
        self._tally = Tally(run_now or now)
        self._recent: deque[str] = deque(maxlen=3)
        self._live = Live(console=console, auto_refresh=False, vertical_overflow="crop")
        self._drawn_s = -math.inf

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Take an event into account and draw if it is time."""
        self._tally.note(name, values)
        text = event_text(name, values, self._tally.record)
        if text and name in LASTING:
            self._print(text)
        elif text:
            self._recent.append(text)
        if name == "run_starting":
            self._live.start()
            self._draw()
        elif name == "run_finished":
            self.close()
        elif self._is_time(name):
            self._draw()

    def refresh(self) -> None:
        """Draw now, as far as the view is on."""
        if self._live.is_started:
            self._draw()

    def close(self) -> None:
        """Draw a last time and give the terminal back; any number of times."""
        if self._live.is_started:
            try:
                self._draw()
            finally:
                self._live.stop()

    def export_svg(self, path: Path, width: int = 110, height: int = 27) -> None:
        """Write the present view as a picture that needs no fonts from elsewhere.

        Args:
            path: The SVG file.
            width: Columns of the terminal that is shown.
            height: Lines of it.
        """
        console = Console(
            record=True, file=io.StringIO(), width=width, height=height, color_system="truecolor"
        )
        console.print(draw(self._tally, list(self._recent), width, height, UNICODE))
        svg = console.export_svg(title="labseq run")
        path.write_text(re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL), "utf-8")

    def _is_time(self, name: str) -> bool:
        run = self._tally.record
        may_draw = name in _BETWEEN_SHOTS or (run is not None and run.simulated)
        return self._live.is_started and may_draw and self._now() - self._drawn_s >= REDRAW_S

    def _draw(self) -> None:
        self._drawn_s = self._now()
        width, height = self._console.size
        picture = draw(self._tally, list(self._recent), width, height, self._glyphs)
        self._live.update(picture, refresh=True)

    def _print(self, text: str) -> None:
        self._console.print(Text(text), soft_wrap=True)


Event = tuple[str, Mapping[str, Any]]

FILES: Final = 20
"""Shots at most, the latest, whose files are read for their stages, each time."""
_OF_SHOTS: Final = frozenset({"shot_finished", "shot_repeated"})


class Tail:
    """The whole lines that come to a file of JSON lines.

    Args:
        path: The file; it may not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = 0

    def read(self) -> list[dict[str, Any]]:
        """The lines since the last time, without damaged ones.

        Raises:
            RecordingError: The file cannot be read.
        """
        try:
            with self._path.open("rb") as file:
                file.seek(self._at)
                data = whole_lines(file.read())
        except FileNotFoundError:
            return []
        except OSError as error:
            raise RecordingError(self._path, f"cannot be read: {error.strerror}; check the disk") from error
        self._at += len(data)
        rows = (parse_object(line) for line in data.splitlines())
        return [row for row in rows if row is not None]


class Follower:
    """Tells a run's events as its own process told them to its live view, as far as they are on the disk.

    Args:
        run: The run, when it was opened first.
        clock: Seconds since 1970.
    """

    def __init__(self, run: Run, clock: Callable[[], float] = time.time) -> None:
        self._folder = run.path
        self._clock = clock
        self._events, self._index = Tail(run.path / EVENTS_FILE), Tail(run.path / INDEX_FILE)
        self._record = record_of(run)
        self._shots: dict[tuple[int, int], Shot] = {}
        self._told_s = math.nan

    def now(self) -> float:
        """Time of the run: that of the event that is being told, else that of the clock."""
        return self._clock() if math.isnan(self._told_s) else self._told_s

    def is_over(self) -> bool:
        """Whether the run has ended, or its process is gone."""
        return read_state(self._folder)[0] != "running"

    def read(self) -> Iterator[Event]:
        """What has come since the last time.

        Raises:
            RecordingError: The run cannot be read any more.
        """
        lines = self._events.read()
        for row in filter(is_index_row, self._index.read()):  # a shot is in the index before it is told
            self._shots[row["shot"], row["attempt"]] = Shot(self._folder / row["file"], row, load_content)
        finished = [i for i, line in enumerate(lines) if line.get("event") in _OF_SHOTS]
        to_open = frozenset(finished[-FILES:])
        for i, line in enumerate(lines):
            with suppress(KeyError, TypeError, ValueError, AttributeError):  # a damaged line
                self._told_s = datetime.fromisoformat(line["t_utc"]).timestamp()
                yield from self._forward(line["event"], line["values"], whole=i in to_open)
        self._told_s = math.nan

    def _forward(self, name: str, values: dict[str, Any], *, whole: bool) -> Iterator[Event]:
        if name == "run_starting":
            yield name, values | {"record": self._record}
        elif name in _OF_SHOTS:
            told = values["shot"]
            shot = self._shots.pop((told["shot_index"], told["attempt"]), None)
            if shot is not None and whole:
                yield from stages_and_image(shot)
            yield name, {"shot": _shot_record(told, shot)}
        else:
            yield name, values


def record_of(run: Run) -> RunRecord:
    """The record of a run, as far as a view needs it, of run.json."""
    told = run.record
    return RunRecord(
        name=run.name,
        n_shots=run.n_shots,
        seed=run.seed,
        simulated=run.simulated,
        t_start_utc=str(told.get("t_start_utc", "")),
        target=run.target,
        sequence_text="",
        profile_text="",
        sequence_path=str(told.get("sequence_path", "")),
        profile_path=str(told.get("profile_path", "")),
        resolved=told.get("resolved") or {},
        overrides={},
        devices={},
        plugins=(),
        provenance={},
        record_frames="none",
        grid_spacing_m=math.nan,
        lattice=str(told.get("lattice", "")),
        scan=told.get("scan") or {},
    )


def stages_and_image(shot: Shot) -> Iterator[Event]:
    """The stages of a shot, and its last image; nothing if its file cannot be read."""
    with suppress(RecordingError):
        timing = shot.timing
        for one in timing:
            yield "stage", {"timing": one}
        images = shot.summary.images
        steps = [one.step for one in timing if one.stage == "expose"]
        if len(images) and steps:
            image = ImageRecord(
                frame=None,
                occupancy=shot.occupancies[-1],
                confidence=shot.confidences[-1],
                step=steps[-1],
                cycle=images.cycle[-1],
                t_start_s=images.t_start_s[-1],
                exposure_s=images.exposure_s[-1],
            )
            yield "shot_started", {"shot": shot.index, "attempt": shot.attempt}
            yield "image", {"image": image, "filling_fraction": shot.filling_fraction}


def _shot_record(told: Mapping[str, Any], shot: Shot | None) -> ShotRecord:
    """A shot as its line of the event log and of the index have it."""
    row: Mapping[str, Any] = {} if shot is None else shot.row
    filling: float | None = told["filling_fraction"]
    time_s = math.nan if shot is None else shot_time_s(shot)
    timing = [] if math.isnan(time_s) else [StageTiming("shot", 0, 0, 0.0, time_s, math.nan)]
    return ShotRecord(
        shot_index=told["shot_index"],
        attempt=told["attempt"],
        seed=0,
        t_start_utc=str(row.get("t_start_utc", "")),
        status=told["status"],
        error=told["error"],
        timing=timing,
        seen_defect_free_cycle=int(row.get("seen_defect_free_cycle") or 0),
        success=bool(told["success"]),
        filling_fraction=math.nan if filling is None else float(filling),
        n_missing_atoms=int(row.get("n_missing_atoms") or 0),
        parameters=row.get("parameters") or {},
    )


POLL_S: Final = 0.5
"""How often the run's files are looked at."""


def watch_run(
    path: Path | None, stream: TextIO | None = None, wait: Callable[[float], None] = time.sleep
) -> None:
    """Show a run until it ends, then its summary; only its files are read.

    Args:
        path: The run's folder or any file in it; None for the newest run.
        stream: Where it is shown; stdout by default.
        wait: Waits for so many seconds.

    Raises:
        ConfigError: There is no such run.
        RecordingError: It is damaged.
    """
    run = chosen_run(path)
    follower = Follower(run)
    shown = stream or sys.stdout
    view = observer_for(shown, follower.now)
    try:
        follow(follower, view, wait)
    except KeyboardInterrupt:
        view.close()
        say(f"no longer watched; {run.path} goes on", stream=shown)
    else:
        view.close()
        say(*summary_lines(open_run(run.path)), stream=shown)
    finally:
        view.close()


def follow(follower: Follower, view: ClosableObserver, wait: Callable[[float], None]) -> None:
    """Tell a view what comes, until the run is over.

    Args:
        follower: Reads the run.
        view: Is told its events.
        wait: Waits for so many seconds.

    Raises:
        RecordingError: The run cannot be read any more.
    """
    while True:
        over = follower.is_over()  # before the last events are read
        for name, values in follower.read():
            with suppress(KeyError, TypeError, ValueError):  # an event of another version of labseq
                view.event(name, values)
        view.refresh()
        if over:
            return
        wait(POLL_S)
