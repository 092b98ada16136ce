"""The numbers of a run that the live view shows, summed up from its events."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from labseq.console.events import best_text
from labseq.model import ImageRecord, RunRecord, ShotRecord, StageTiming
from labseq.model.estimate import Estimate, mean
from labseq.recording.points import SCANNER, ChosenPoints

STAGES: Final = ("expose", "read_out", "detect", "plan", "check", "prepare", "play", "move", "write")
"""The stages that are shown, in order; a shot may have others."""
_KEPT: Final = 200
"""Number of latest durations of a stage for its median."""


@dataclass(slots=True)
class StageTally:
    """The durations of one stage.

    Attributes:
        host_s: The latest durations, on this computer's clock.
        duration_s: The latest durations, on the session's clock.
        budget_s: The latest budget; nan if it has none.
        n_over: Number of times that it exceeded its budget.
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
        """Median on this computer's clock, and on the session's."""
        return statistics.median(self.host_s), statistics.median(self.duration_s)

    def p99_s(self) -> float:
        """The 99th percentile on this computer's clock: the second longest of 200."""
        longest = sorted(self.host_s)
        return longest[math.ceil(0.99 * len(longest)) - 1]


@dataclass(slots=True)
class PointTally:
    """The shots of one point of a scan.

    Attributes:
        n_shots: Number of shots that are complete and judged.
        n_defect_free: Number of them that met the target.
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


class ScanTally:
    """The points of a scan while it runs.

    Args:
        scan: The scan as the run's record describes it.
    """

    def __init__(self, scan: Mapping[str, Any]) -> None:
        self._scan = scan
        self._chosen = ChosenPoints(scan) if SCANNER in scan else None
        self._points: dict[int, PointTally] = {}

    @property
    def name(self) -> str:
        """The scanned addresses, as text."""
        return ", ".join(self._scan.get("addresses", ()))

    def add(self, shot: ShotRecord) -> None:
        """Count a shot, unless it was not judged or its point is unknown."""
        number = self._number(shot)
        if number is not None and not math.isnan(shot.filling_fraction):
            point = self._points.setdefault(number, PointTally())
            point += PointTally(1, int(shot.success), shot.filling_fraction)

    def _number(self, shot: ShotRecord) -> int | None:
        try:
            if self._chosen is not None:
                return self._chosen.number(shot.parameters)
            return self._scan["point_of_shot"][shot.shot_index] if shot.shot_index >= 0 else None
        except (KeyError, IndexError):  # `labseq watch` on a damaged index
            return None

    def points(self) -> list[tuple[str, PointTally]]:
        """The value of each point as text, and its shots; sorted by value if one number is scanned."""
        chosen = self._chosen
        written: list[list[str]] = self._scan.get("written", []) if chosen is None else chosen.written
        values: list[list[Any]] = self._scan.get("points", []) if chosen is None else chosen.points
        order = list(range(len(written)))
        if all(len(value) == 1 and isinstance(value[0], float | int) for value in values):
            order.sort(key=lambda i: values[i][0])
        return [(", ".join(written[i]), self._points.get(i, PointTally())) for i in order]


class Tally:
    """Sums up a run's events; unknown events are ignored.

    Args:
        now: Monotonic time in seconds.

    Attributes:
        record: The run, from "run_starting" on.
        n_before: Number of shots that were complete when the run was resumed.
        n_done: Number of shots completed since then.
        n_defect_free: Number of them that met the target.
        n_seen: Number of them that met it in at least one image.
        n_repeated: Number of attempts that had to be repeated.
        image: The last image.
        image_shot: The shot of the last image, counted from 0.
        shot: The current shot, counted from 0.
        stages: Stage -> its durations.
        scan: The points of the scan; None without one.
        best: The best point of an adaptive scan so far, as text, or "".
        status: Final status of the run, or "".
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._first_shot_s = math.nan
        self._fillings: list[float] = []
        self.record: RunRecord | None = None
        self.n_before = self.n_done = self.n_defect_free = self.n_seen = self.n_repeated = 0
        self.image: ImageRecord | None = None
        self.image_shot = self.shot = 0
        self.stages = {name: StageTally() for name in STAGES}
        self.scan: ScanTally | None = None
        self.best = ""
        self.status = ""

    @property
    def n_shots(self) -> int:
        """Planned number of shots of the run."""
        return self.record.n_shots if self.record is not None else 0

    @property
    def filling(self) -> Estimate:
        """Mean filling fraction with its standard error."""
        return mean(self._fillings)

    @property
    def time_left_s(self) -> float:
        """Expected time to the end of the run, from the shots so far; nan before the first complete shot."""
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
                self._count(values["shot"])
            case "shot_repeated":
                self.n_repeated += 1
            case "run_starting":
                self.record, self.n_before = values["record"], values.get("n_before", 0)
                self.status = ""
                if self.scan is None and values["record"].scan:  # the points of a resumed run are kept
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
            self._fillings.append(shot.filling_fraction)
