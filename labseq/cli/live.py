"""The live view of a run in the terminal, which adds up the run's events and draws the results."""

from __future__ import annotations

import math
import os
import statistics
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, Final, TextIO

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from labseq.analysis.scanned import shown_unit, title_of, value_text
from labseq.cli.live_fits import LiveFits
from labseq.console.arrays import Glyphs, draw_array, glyphs_for, scales
from labseq.console.events import LASTING, LogLines, best_text, event_text, scanned_names
from labseq.console.text import clock_time, count_of, plural
from labseq.data.points import ChosenPoints
from labseq.data.quantities import make_quantity, names_measured
from labseq.data.series import Series
from labseq.model import ImageRecord, RunRecord, StageTiming
from labseq.model.estimate import jeffreys
from labseq.recording.index import IndexRow
from labseq.recording.run_file import WRITTEN_UNITS
from labseq.units import format_quantity

REDRAW_S: Final = 0.25
"""Minimum time between two drawings of the view, in seconds."""


def observer_for(stream: TextIO, run_now: Callable[[], float] | None = None) -> LiveView | LogLines:
    """The live view if the stream is a terminal that can show it, else plain lines."""
    if stream.isatty() and os.environ.get("TERM", "") not in {"dumb", "unknown"}:
        return LiveView(Console(file=stream), run_now=run_now)
    return LogLines(stream)


class LiveView:
    """Implements ``RunObserver`` with a picture of the run that is redrawn in place.

    In the process of a run, the view is drawn when events arrive and never from a thread, so never during a
    device call. With real hardware it is drawn only between shots, because atoms are lost while the run waits
    for the terminal. `labseq watch` also draws it by :meth:`refresh`.

    Args:
        run_now: Clock of the run in seconds. Default ``now``.
    """

    def __init__(
        self,
        console: Console,
        now: Callable[[], float] = time.monotonic,
        run_now: Callable[[], float] | None = None,
    ) -> None:
        self._console = console
        self._now = now
        self._tally = Tally(run_now or now)
        self._recent: deque[str] = deque(maxlen=3)
        self.picture = Picture(self._tally, self._recent, glyphs_for(console.encoding))
        self._live = Live(self.picture, console=console, auto_refresh=False, vertical_overflow="crop")
        self._drawn_s = -math.inf

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Add an event to the numbers, and draw if the last drawing is old enough."""
        self._tally.add(name, values)
        text = event_text(name, values, self._tally.record)
        if text and name in LASTING:
            self._console.print(Text(text), soft_wrap=True)
        elif text:
            self._recent.append(text)
        if name == "run_starting":
            self._live.start()
            self._draw()
        elif name == "run_finished":
            self.close()
        elif self._may_draw(name):
            self._draw()

    def refresh(self) -> None:
        """Draw immediately, if the view is on."""
        if self._live.is_started:
            self._draw()

    def close(self) -> None:
        """Draw a last time and release the terminal. May be called several times."""
        if self._live.is_started:
            try:
                self._draw()
            finally:
                self._live.stop()

    def _may_draw(self, name: str) -> bool:
        run = self._tally.record
        is_between_shots = name in ("run_started", "leader_awaited", "shot_finished", "shot_repeated")
        if not (is_between_shots or (run is not None and run.simulated)):
            return False
        return self._live.is_started and self._now() - self._drawn_s >= REDRAW_S

    def _draw(self) -> None:
        self._drawn_s = self._now()
        self._tally.look()
        self._live.refresh()


STAGES: Final = ("arm", "expose", "read_out", "detect", "plan", "check", "prepare", "play", "move", "write")
"""The stages that are shown, in order. A shot may have others."""


_KEPT: Final = 200
"""Number of latest durations of a stage for its median."""


@dataclass(slots=True)
class StageTally:
    """The durations of one stage.

    Attributes:
        host_s: The latest durations, on this computer's clock.
        duration_s: The latest durations, on the session's clock.
        budget_s: The latest budget, or nan without one.
        n_over: Number of durations above the budget.
    """

    host_s: deque[float] = field(default_factory=lambda: deque[float](maxlen=_KEPT))
    duration_s: deque[float] = field(default_factory=lambda: deque[float](maxlen=_KEPT))
    budget_s: float = math.nan
    n_over: int = 0

    def add(self, timing: StageTiming) -> None:
        """Add one duration."""
        self.host_s.append(timing.host_s)
        self.duration_s.append(timing.duration_s)
        self.budget_s = timing.budget_s
        self.n_over += timing.over_budget

    def medians_s(self) -> tuple[float, float]:
        """Median on the clocks of this computer and of the session."""
        return statistics.median(self.host_s), statistics.median(self.duration_s)

    def p99_s(self) -> float:
        """The 99th percentile on this computer's clock, which is the second longest of 200."""
        longest = sorted(self.host_s)
        return longest[math.ceil(0.99 * len(longest)) - 1]


class ScanTally:
    """The points of a scan while it runs.

    Attributes:
        lines: Number of a point -> the shots taken there, by their places in a :class:`Series`.
    """

    def __init__(self, scan: Mapping[str, Any]) -> None:
        self._scan = scan
        self._chosen = ChosenPoints(scan) if WRITTEN_UNITS in scan else None
        self.lines = defaultdict[int, list[int]](list)

    @property
    def name(self) -> str:
        """The scanned settings, as text."""
        return ", ".join(scanned_names(self._scan))

    def add(self, row: IndexRow, line: int) -> None:
        """Add a shot to its point, unless that is unknown."""
        with suppress(KeyError, IndexError):  # `labseq watch` on a damaged index
            if self._chosen is not None:
                self.lines[self._chosen.number(row.parameters)].append(line)
            elif row.shot >= 0:
                self.lines[self._scan["point_of_shot"][row.shot]].append(line)

    def points(self) -> list[tuple[str, list[int]]]:
        """The value of each point as text, and its shots. Sorted by value if one number is scanned."""
        chosen = self._chosen
        written: list[list[str]] = self._scan.get("written", []) if chosen is None else chosen.written
        values: list[list[Any]] = self._scan.get("points", []) if chosen is None else chosen.points
        order = list(range(len(written)))
        if all(len(value) == 1 and isinstance(value[0], float | int) for value in values):
            order.sort(key=lambda i: values[i][0])
        return [(", ".join(written[i]), self.lines.get(i, [])) for i in order]


class Tally:
    """Sums up a run's events. Unknown events are ignored.

    Attributes:
        record: The run, from "run_starting" on.
        n_before: Number of shots that were complete before the first event.
        n_done: Number of shots completed since the first event.
        n_judged: Number of completed shots that were judged on their last image.
        n_defect_free: Number of judged shots that met the target.
        n_seen: Number of completed shots that met the target in at least one image.
        n_repeated: Number of attempts that had to be repeated.
        image: The last image.
        image_shot: Index of the shot of the last image.
        shot: Index of the current shot.
        stages: Stage -> its durations.
        scan: The points of the scan, or None.
        measured: The quantities that the run measures, the most important first.
        fits: Fits of these quantities against the scanned value. None without a scan.
        best: The best point of an adaptive scan so far, as text, or "".
        status: Final status of the run, or "".
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._first_shot_s = math.nan
        self.record: RunRecord | None = None
        self.n_before = self.n_done = self.n_judged = self.n_defect_free = self.n_seen = self.n_repeated = 0
        self.image: ImageRecord | None = None
        self.image_shot = self.shot = 0
        self.stages = {name: StageTally() for name in STAGES}
        self.scan: ScanTally | None = None
        self.measured: list[Series] = []
        self.fits: LiveFits | None = None
        self.best = ""
        self.status = ""

    @property
    def n_shots(self) -> int:
        """Planned number of shots of the run."""
        return self.record.n_shots if self.record is not None else 0

    @property
    def time_left_s(self) -> float:
        """Expected time to the end of the run, from the shots so far. nan before the first complete shot."""
        if not self.n_done:
            return math.nan
        return (self._now() - self._first_shot_s) / self.n_done * (self.n_shots - self.n_before - self.n_done)

    def add(self, name: str, values: Mapping[str, Any]) -> None:
        """Add an event to the numbers."""
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
                self._count(values["row"])
            case "shot_repeated":
                self.n_repeated += 1
            case "run_starting":
                self._begin(values["record"], Path(values["run_dir"]), values.get("n_before", 0))
            case "scan_point":
                self.best = best_text(values)
            case "run_finished":
                self.status = values["status"]
            case _:
                pass

    def _begin(self, record: RunRecord, run_dir: Path, n_before: int) -> None:
        self.record, self.status = record, ""
        self.n_before = n_before - self.n_done  # `watch` has already counted the shots since then
        if self.scan is None and record.scan:  # the points of a resumed run are kept
            self.scan = ScanTally(record.scan)
        if not self.measured:
            names = names_measured(record.resolved, record.target)
            self.measured = [Series(make_quantity(name, record.target), run_dir) for name in names]
            self.fits = LiveFits(run_dir, record.resolved, self.measured) if record.scan else None

    def _count(self, row: IndexRow) -> None:
        if not row.counts:
            return
        if self.scan is not None:
            self.scan.add(row, len(self.measured[0]))
        self.n_done += 1
        self.n_judged += not math.isnan(row.filling_fraction)
        self.n_defect_free += bool(row.success)
        self.n_seen += row.was_defect_free
        for measured in self.measured:
            measured.add(row)

    def look(self) -> None:
        """Add new results of analyses, and fit the quantities that have points."""
        for measured in self.measured:
            measured.read_results()
        if self.fits is not None and self.scan is not None:
            self.fits.look(self.scan.lines, at_once=bool(self.status))


SIDE_WIDTH: Final = 48
_GAP: Final = 3


class Picture:
    """The view as rich prints it, with progress, array and numbers side by side, and the latest events.

    If there is no room, the array is drawn smaller, then dropped, and then the
    latest events are dropped.
    """

    def __init__(self, tally: Tally, recent: Sequence[str], glyphs: Glyphs) -> None:
        self._tally = tally
        self._recent = recent
        self._glyphs = glyphs

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width, height = options.size
        wide = options.update(width=max(width, SIDE_WIDTH), height=None)

        def lines_of(part: RenderableType) -> list[list[Segment]]:
            return console.render_lines(part, wide, pad=False)

        room = height - 2  # below the progress, above the cursor
        lines = [*lines_of(_progress(self._tally, width)), *lines_of(self._body(lines_of, width, room))]
        spare = height - 1 - len(lines)
        blank = list[Segment]()
        if spare > 2:
            lines.insert(1, blank)
        if spare > 3:
            lines.append(blank)
        recent = [line for text in self._recent for line in lines_of(Text(text, "dim"))]
        lines += recent[max(0, len(lines) + len(recent) - height + 1) :]
        for line in lines[: height - 1]:
            yield from Segment.adjust_line_length(line, width, pad=False)
            yield Segment.line()

    def _body(self, lines_of: Callable[[RenderableType], Sized], width: int, room: int) -> RenderableType:
        """The numbers, with the array on their left and the plot of a scan below if they fit."""
        tally, glyphs = self._tally, self._glyphs
        parts: list[RenderableType] = [_results(tally), Text(), _stages(tally), *_caption(tally)]
        if tally.scan is not None:
            free = room - len(lines_of(Group(*parts))) - 1
            # maximum number of lines of the plot of a scan
            plot = draw_scan(tally.scan, tally.measured, SIDE_WIDTH, min(free, 8), glyphs)
            parts += [Text(), *plot] if plot else []
        array = _array(tally, width - _GAP - SIDE_WIDTH, room, glyphs)
        if not array:
            return Group(*parts)
        body = Table.grid(padding=(0, _GAP, 0, 0))
        body.add_row(Group(*array), Group(*parts))
        return body


def _line(text: str, style: str = "") -> Text:
    return Text(text, style, no_wrap=True)


def _progress(tally: Tally, width: int) -> Table:
    text = f"{tally.n_before + tally.n_done}/{tally.n_shots} shots"
    if tally.status:
        text += f"  {tally.status}"
    elif not math.isnan(tally.time_left_s):
        text += f"  {clock_time(tally.time_left_s)} left"
    name = tally.record.name if tally.record is not None else ""
    bar = ProgressBar(
        max(1, tally.n_shots),
        tally.n_before + tally.n_done,
        width=min(60, max(1, width - len(name) - len(text) - 4)),
        complete_style="green",
        finished_style="green",
        style="dim",
    )
    line = Table.grid(padding=(0, 2, 0, 0))
    line.add_row(Text(name, "bold"), bar, text)
    return line


def _array(tally: Tally, width: int, height: int, glyphs: Glyphs) -> list[Text]:
    """The array of the last image as large as possible, or empty if there is no room."""
    if tally.image is None or tally.record is None:
        return []
    occupancy, shear = tally.image.occupancy, shear_of(tally.record)
    n_rows, n_cols = occupancy.shape
    for scale in scales(glyphs):
        array_width, array_height = scale.size(n_rows, n_cols, shear)
        if array_width <= width and array_height <= height:
            return draw_array(occupancy, tally.record.target, shear, scale, glyphs)
    return []


def shear_of(run: RunRecord) -> int:
    """+1 or -1 on the triangular lattice, 0 on the square one."""
    if run.lattice != "triangular":
        return 0
    return -1 if run.resolved.get("profile", {}).get("grid", {}).get("shear") == -1 else 1


def _results(tally: Tally) -> Table:
    """The measured quantities. With a target also the defect-free rate."""
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(no_wrap=True)
    if tally.n_judged:
        low, high = (100 * end for end in jeffreys(tally.n_defect_free, tally.n_judged))
        rate = count_of(tally.n_defect_free, tally.n_judged)
        table.add_row("defect-free", f"{rate}, {low:.0f}-{high:.0f} %")
        table.add_row("seen defect-free", count_of(tally.n_seen, tally.n_done))
    for measured in tally.measured:
        if measured.quantity.name != "defect_free":
            value = value_text(measured.mean, measured.quantity, short=True)
            table.add_row(title_of(measured.quantity), value)
        if tally.fits is not None and measured.quantity.name in tally.fits.results:
            table.add_row(*tally.fits.results[measured.quantity.name])
    if tally.best:
        table.add_row("best so far", Text(tally.best))
    if tally.n_repeated:
        table.add_row("repeated", Text(plural(tally.n_repeated, "attempt"), "yellow"))
    # a value that is too long is cut, never its name
    names = table.columns[0]
    names.min_width = max((len(str(name)) for name in names.cells), default=0)
    return table


def _stages(tally: Tally) -> Table:
    """A row per stage. On real hardware the session's clock is this computer's clock."""
    simulated = tally.record is None or tally.record.simulated
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    table.add_column("stage", no_wrap=True)
    for head in (*(("host", "p99", "modelled") if simulated else ("p50", "p99")), "budget", "over"):
        table.add_column(head, justify="right", no_wrap=True)
    for name, stage in tally.stages.items():
        if not stage.host_s:
            continue
        host_s, session_s = stage.medians_s()
        times_s = (host_s, stage.p99_s(), session_s) if simulated else (session_s, stage.p99_s())
        budget = "-" if math.isnan(stage.budget_s) else format_quantity(stage.budget_s, "time")
        table.add_row(
            name,
            *(format_quantity(time_s, "time") for time_s in times_s),
            budget,
            str(stage.n_over or ""),
            style="yellow" if stage.n_over else "",
        )
    return table


def _caption(tally: Tally) -> list[Text]:
    """The caption of the array."""
    if tally.image is None or tally.record is None:
        return []
    image, target = tally.image, tally.record.target
    which = f"cycle {image.cycle}" if image.cycle >= 0 else f"step {image.step}"
    head = [Text(), _line(f"shot {tally.image_shot}, image of {which}:")]
    n_atoms = plural(int(image.occupancy.sum()), "atom")
    if target.is_none:
        return [*head, _line(n_atoms)]
    n_defects, n_surplus = target.n_defects(image.occupancy), target.n_surplus(image.occupancy)
    found = plural(n_defects, "defect") if n_defects or n_surplus else "defect-free"
    style = "green" if found == "defect-free" else ""
    if n_surplus:
        found += f", {n_surplus} surplus"
    return [*head, _line(f"{n_atoms}, {found}", style)]


MIN_WIDTH: Final = 16
_LABEL: Final = 7
"""Width of the numbers on the left."""


def draw_scan(
    scan: ScanTally, measured: Sequence[Series], width: int, height: int, glyphs: Glyphs
) -> list[Text]:
    """Draw the first quantity that has values, at each point of a scan."""
    points = scan.points()
    # minimum number of lines of a plot, including its title and the line below it
    if not points or width < MIN_WIDTH or height < 4:
        return []
    shown = _merged([lines for _, lines in points], width - _LABEL)
    for series in measured:
        means = [mean.value for mean in series.over(shown)]
        if there := [value for value in means if not math.isnan(value)]:
            break
    else:
        return []
    quantity, values = series.quantity, [None if math.isnan(value) else value for value in means]
    unit, factor = shown_unit(quantity, there)
    high = max(there)
    # minimum range of the plot, as a fraction of the largest value
    low = 0.0 if quantity.is_rate else min(high - 0.01 * (abs(high) or 1.0), *there)
    # maximum width of the bar of a point
    bar = max(1, min(5, (width - _LABEL) // len(shown)))
    rows = _bars(values, low, high or 1.0, height - 2, bar, glyphs)
    ends = [f"{end / factor:.3g} {unit}".strip().rjust(_LABEL - 1) + " " for end in (high or 1.0, low)]
    margins = [ends[0], *[" " * _LABEL] * (len(rows) - 2), ends[1]]
    first, last = points[0][0], points[-1][0]
    below = first + last.rjust(bar * len(shown) - len(first))
    if len(points) == 1 or len(first) + len(last) + 1 > bar * len(shown):
        below = first if len(points) == 1 else f"{first} to {last}"
    return [
        _line(f"{title_of(quantity)} by {scan.name}", "bold"),
        *(Text.assemble((m, "dim"), (row, "cyan")) for m, row in zip(margins, rows, strict=True)),
        _line(" " * _LABEL + below, "dim"),
    ]


def _merged(points: Sequence[Sequence[int]], room: int) -> list[list[int]]:
    """The shots of the points. Neighbours are merged if there is no room for all."""
    n = min(len(points), max(1, room))
    ends = [round(i * len(points) / n) for i in range(n + 1)]
    return [list(chain.from_iterable(points[first:end])) for first, end in pairwise(ends)]


def _bars(
    values: Sequence[float | None], low: float, high: float, height: int, bar: int, glyphs: Glyphs
) -> list[str]:
    """Vertical bars, a line of text per row, the highest first. The lowest value is still a thin line."""
    steps = len(glyphs.levels)
    filled = [0 if v is None else max(1, round((v - low) / (high - low) * height * steps)) for v in values]
    gap = " " if bar > 1 else ""
    rows: list[str] = []
    for row in reversed(range(height)):
        cells = (min(steps, max(0, n - row * steps)) for n in filled)
        rows.append("".join((" " if not n else glyphs.levels[n - 1]) * (bar - len(gap)) + gap for n in cells))
    return rows
