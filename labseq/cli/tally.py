"""What is known of a run while it goes on, summed up from its events."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from labseq.cli.scan_plot import ScanTally
from labseq.cli.telling import best_text
from labseq.model import ImageRecord, RunRecord, ShotRecord, StageTiming

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
