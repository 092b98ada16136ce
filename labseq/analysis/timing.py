"""Durations of the stages of a run's shots, compared with their budgets."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.data.reader import Run
from labseq.data.shot import Shot
from labseq.errors import RecordingError
from labseq.model import StageTiming
from labseq.model.records import OVERSHOOT_S, STEP

ORDER: Final = (
    *("load", "arm", "expose", "read_out", "detect", "plan", "check"),
    *("tones", "render", "upload", "prepare", "start", "light", "rest", "play", "move", "write"),
)
"""The stages of a shot in order. Unknown stages come last."""
WRITE: Final = "write"
"""Stage of encoding a shot, and writing its file and its line in the index."""


@dataclass(frozen=True, slots=True)
class Quantiles:
    """Median and 99th percentile. NaN without values."""

    p50: float
    p99: float


@dataclass(frozen=True, slots=True)
class StageStatistics:
    """Durations of a stage over many shots.

    Attributes:
        stage: Name of the stage, such as "expose", "plan" or "write", or "step_2_rearrange" for a whole step.
        n: Number of times that it was recorded.
        n_per_shot: Mean number of times in a shot.
        budget_s: Median budget. For "play" this is the length of each program. NaN without a budget.
        session_s: Median and 99th percentile on the session's clock, which is modelled in a simulated run.
        host_s: Median and 99th percentile on this computer's clock.
        share: Its share of the time of a shot, on the session's clock. Writing is in addition to this time.
        n_over: Number of times that it exceeded its budget.
    """

    stage: str
    n: int
    n_per_shot: float
    budget_s: float
    session_s: Quantiles
    host_s: Quantiles
    share: float
    n_over: int


@dataclass(frozen=True, slots=True)
class RunTiming:
    """The stages of a run's shots.

    Attributes:
        n_shots: Number of shots of the run.
        simulated: Whether the run was simulated. The session's clock then runs on modelled time.
        n_read: Number of shots whose files were read.
        shot_s: Median and 99th percentile of the steps of a shot together, on the session's clock.
        stages: The stages in the order of a shot, with whole steps last.
    """

    n_shots: int
    simulated: bool
    n_read: int
    shot_s: Quantiles
    stages: tuple[StageStatistics, ...]


@dataclass(slots=True)
class StageTotals:
    """Adds up the stages of shots."""

    _timings: dict[str, list[StageTiming]] = field(default_factory=dict[str, list[StageTiming]])
    _shot_s: list[float] = field(default_factory=list[float])

    def add(self, shot: Shot) -> None:
        """Add the stages of a shot.

        Raises:
            RecordingError: The file cannot be read.
        """
        self.add_timing(shot.timing)

    def add_timing(self, timing: Sequence[StageTiming]) -> None:
        """Add the stages of a shot that has been read."""
        for stage in timing:
            self._timings.setdefault(stage.stage, []).append(stage)
        # whole steps only, because stages are within steps, and some overlap with others
        self._shot_s.append(math.fsum(stage.duration_s for stage in timing if stage.stage.startswith(STEP)))

    def stages(self) -> list[StageStatistics]:
        """The statistics of all stages added so far, without the stage of writing."""
        n_read, total_s = len(self._shot_s), math.fsum(self._shot_s)
        names = sorted(self._timings, key=_place)
        return [_sum_up(name, self._timings[name], n_read, total_s) for name in names]

    def sum_up(self, run: Run) -> RunTiming:
        """The statistics of all stages added so far."""
        n_read, total_s = len(self._shot_s), math.fsum(self._shot_s)
        stages = self.stages()
        writing = _writing(run, total_s / n_read if n_read else math.nan)
        n_stages = sum(not stage.stage.startswith(STEP) for stage in stages)
        return RunTiming(
            n_shots=len(run.shots),
            simulated=run.simulated,
            n_read=n_read,
            shot_s=quantiles(self._shot_s),
            stages=(*stages[:n_stages], *writing, *stages[n_stages:]),
        )


def timing_of(run: Run, shots: Iterable[Shot]) -> RunTiming:
    """Durations of the stages of the given shots. Shots whose files cannot be read are left out."""
    totals = StageTotals()
    for shot in shots:
        with suppress(RecordingError):
            totals.add(shot)
    return totals.sum_up(run)


def _place(name: str) -> tuple[bool, int, str]:
    """Sorting key: known stages in their order, then others, then whole steps."""
    # plugins may report their own stages
    return name.startswith(STEP), ORDER.index(name) if name in ORDER else len(ORDER), name


def _sum_up(name: str, timings: Sequence[StageTiming], n_shots: int, total_s: float) -> StageStatistics:
    session_s = [timing.duration_s for timing in timings]
    budgets_s = [timing.budget_s for timing in timings if not math.isnan(timing.budget_s)]
    return StageStatistics(
        stage=name,
        n=len(timings),
        n_per_shot=len(timings) / n_shots,
        budget_s=float(np.median(budgets_s)) if budgets_s else math.nan,
        session_s=quantiles(session_s),
        host_s=quantiles([timing.host_s for timing in timings]),
        share=math.fsum(session_s) / total_s if total_s else math.nan,
        n_over=sum(timing.over_budget for timing in timings),
    )


def _writing(run: Run, shot_s: float) -> list[StageStatistics]:
    times_s = writing_s(run)
    if not times_s:
        return []
    host_s = quantiles(times_s)
    session_s = Quantiles(math.nan, math.nan) if run.simulated else host_s  # models have no disk
    share = float(np.mean(times_s)) / shot_s if shot_s and not run.simulated else math.nan
    budget_s = _writing_budget_s(run)
    n_over = 0 if run.simulated else sum(time_s > budget_s + OVERSHOOT_S for time_s in times_s)
    return [StageStatistics(WRITE, len(times_s), 1.0, budget_s, session_s, host_s, share, n_over)]


def _writing_budget_s(run: Run) -> float:
    try:
        return float(run.record["resolved"]["profile"]["budgets"][WRITE])
    except (LookupError, TypeError, ValueError):  # a run from before this was recorded
        return math.nan


def writing_s(run: Run) -> list[float]:
    """The time to write each attempt at a shot that is in the event log, in seconds."""
    times_s: list[float] = []
    for event in run.events:
        with suppress(KeyError, TypeError, ValueError, OverflowError):  # another event, or a damaged line
            times_s.append(float(event["values"]["write_s"]))
    return times_s


def quantiles(values: Sequence[float] | NDArray[np.float64]) -> Quantiles:
    """Median and 99th percentile, interpolated. NaN without values.

    Example:
        >>> quantiles([1.0, 2.0, 3.0]).p50
        2.0
    """
    if not len(values):
        return Quantiles(math.nan, math.nan)
    p50, p99 = np.quantile(values, (0.5, 0.99))
    return Quantiles(float(p50), float(p99))
