"""A run at a glance, and each part of that alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from types import MappingProxyType
from typing import Final

import numpy as np

from labseq.config.wording import clean
from labseq.drawing.charts import Chart, RunDrawing
from labseq.errors import ConfigError, Problem, RecordingError, one_of
from labseq.model import TargetPattern
from labseq.recording import Run, Shot
from labseq.recording.statistics import Statistics, statistics_of
from labseq.session.run_figures.losses import (
    causes_chart,
    defects_chart,
    lost_by_cycle,
    stages_chart,
    survival_charts,
)
from labseq.session.run_figures.measures import FILLING, SUCCESS, Measure, by_cycle, course
from labseq.session.run_figures.sampling import A_GLANCE, A_LOOK, spread
from labseq.session.run_figures.scan import Scanned, scan_charts, scanned
from labseq.session.run_figures.survival import Survival, steps_that_load
from labseq.session.run_figures.timing import RunTiming, StageTotals
from labseq.session.run_figures.words import note_of, unfit

Row = tuple[Chart, ...]


class _Sums:
    """What a run came to, worked out when it is asked for.

    Args:
        run: The run.
        most: Most shots whose files are read.
    """

    def __init__(self, run: Run, most: int) -> None:
        self.run = run
        self._most = most

    @cached_property
    def statistics(self) -> Statistics:
        """Of all shots, from the index."""
        return statistics_of(self.run.shots, self.run.target)

    @cached_property
    def scan(self) -> Scanned | None:
        """Of all shots, from the index; None without a scan."""
        return scanned(self.run)

    @cached_property
    def read(self) -> tuple[Survival, RunTiming]:
        """Of the shots whose files are read; those that cannot be are left out."""
        survival, watch = Survival.of_nothing(self.run.target.shape), StageTotals()
        loads = steps_that_load(self.run)
        for shot in spread(self.run.shots, self._most):
            with suppress(RecordingError):
                survival.add(shot, loads)
                watch.add(shot)  # the file is still in memory
        return survival, watch.sum_up(self.run)


def overview(run: Run) -> RunDrawing:
    """Everything of a run on one sheet.

    What needs the shots' files is worked out of some of them, which the panels say.

    Args:
        run: The run; it may be going on.

    Raises:
        ConfigError: It has no shots yet.
        RecordingError: It is damaged.
    """
    sums = _Sums(_with_shots(run), A_GLANCE)
    filling, success = (_against(sums, measure) for measure in (FILLING, SUCCESS))
    causes, defects = causes_chart(sums.statistics), defects_chart(run, sums.statistics)
    survival, timing = sums.read
    lost = causes or lost_by_cycle(run, survival)
    rows = [
        _there(*filling, defects),
        _there(*success, lost),
        _there(*survival_charts(run, survival), stages_chart(run, timing)),
    ]
    if sums.scan is not None and len(maps := scan_charts(sums.scan, SUCCESS)) > 1:
        rows.insert(2, maps)
    return _drawing(run, f"run {clean(run.name)}", rows)


def picture_of(run: Run, what: str) -> RunDrawing:
    """One part of the overview, alone.

    Args:
        run: The run; it may be going on.
        what: One of :data:`CHOICES`.

    Raises:
        ConfigError: There is no such part, or the run has nothing to show in it; says what it needs.
        RecordingError: It is damaged.
    """
    if what not in CHOICES:
        expected = one_of(sorted(CHOICES))
        raise ConfigError(
            Problem(f"there is no picture '{clean(what)}' of a run", "--what", expected=expected)
        )
    title, draw, expected = CHOICES[what]
    rows = draw(_Sums(_with_shots(run), A_LOOK))
    if not any(rows):
        raise unfit(run, f"there is nothing to show of {title}", expected, "picture")
    return _drawing(run, title, rows)


def _drawing(run: Run, title: str, rows: Sequence[Row]) -> RunDrawing:
    shown = tuple(row for row in rows if row)
    if not shown:
        raise unfit(run, "its shots hold neither images nor cycles", "shots with an 'image' step", "picture")
    return RunDrawing(title, note_of(run), shown)


def _with_shots(run: Run) -> Run:
    if run.shots:
        return run
    what = "it has no shots yet" if run.status == "running" else "it has no shots that count"
    raise unfit(run, what, "at least one complete shot", "picture")


def _against(sums: _Sums, measure: Measure) -> Row:
    """A measure against shot, cycle and scanned value, as far as each there is."""
    target = sums.run.target
    values = [_value(measure, shot, target) for shot in sums.run.shots]
    by_shot = course(sums.run, measure, values) if np.isfinite(values).any() else None
    maps = scan_charts(sums.scan, measure) if sums.scan is not None else ()
    return _there(by_shot, by_cycle(measure, sums.statistics), *(maps if len(maps) == 1 else ()))


def _value(measure: Measure, shot: Shot, target: TargetPattern) -> float:
    try:
        return measure.of_shot(shot, target)
    except RecordingError:  # an index before format 1.1, and the file is damaged
        return math.nan


def _there(*charts: Chart | None) -> Row:
    return tuple(chart for chart in charts if chart is not None)


def _filling(sums: _Sums) -> list[Row]:
    return [_against(sums, FILLING)]


def _success(sums: _Sums) -> list[Row]:
    return [_against(sums, SUCCESS)]


def _survival(sums: _Sums) -> list[Row]:
    return [survival_charts(sums.run, sums.read[0])]


def _defects(sums: _Sums) -> list[Row]:
    return [_there(defects_chart(sums.run, sums.statistics))]


def _timing(sums: _Sums) -> list[Row]:
    return [_there(stages_chart(sums.run, sums.read[1]))]


def _scan(sums: _Sums) -> list[Row]:
    if sums.scan is None:
        return []
    filling, success = (scan_charts(sums.scan, measure) for measure in (FILLING, SUCCESS))
    return [(*filling, *success)] if len(filling) == len(success) == 1 else [filling, success]


def _losses(sums: _Sums) -> list[Row]:
    return [_there(lost_by_cycle(sums.run, sums.read[0]), causes_chart(sums.statistics))]


CHOICES: Final[Mapping[str, tuple[str, Callable[[_Sums], list[Row]], str]]] = MappingProxyType(
    {
        "filling": ("filling", _filling, "shots with an 'image' step or a rearrangement"),
        "success": ("defect-free shots", _success, "shots with an 'image' step or a rearrangement"),
        "survival": ("survival by site", _survival, "readable shots with at least two images"),
        "defects": ("defects that are left", _defects, "shots with an 'image' step or a rearrangement"),
        "timing": ("the stages of a shot", _timing, "readable shots"),
        "scan": ("the scan", _scan, "a run of a sequence with 'scan:'"),
        "losses": ("lost atoms", _losses, "readable shots with a rearrangement"),
    }
)
"""Picture -> its title, what draws it, and what a run needs for it."""
