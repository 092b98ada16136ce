"""What the live view of a run shows, in numbers that are added up as its events come."""

from __future__ import annotations

import math
import statistics
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from labseq.console.events import best_text, scanned_names
from labseq.data.points import ChosenPoints
from labseq.data.quantities import make_quantity, names_measured
from labseq.data.series import Series
from labseq.model import ImageRecord, RunRecord, StageTiming
from labseq.recording.index import IndexRow
from labseq.recording.run_file import SCANNER

STAGES: Final = ("arm", "expose", "read_out", "detect", "plan", "check", "prepare", "play", "move", "write")
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


class ScanTally:
    """The points of a scan while it runs.

    Attributes:
        lines: Number of a point -> the shots taken there, by their places in a :class:`Series`.
    """

    def __init__(self, scan: Mapping[str, Any]) -> None:
        self._scan = scan
        self._chosen = ChosenPoints(scan) if SCANNER in scan else None
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
        """The value of each point as text, and its shots; sorted by value if one number is scanned."""
        chosen = self._chosen
        written: list[list[str]] = self._scan.get("written", []) if chosen is None else chosen.written
        values: list[list[Any]] = self._scan.get("points", []) if chosen is None else chosen.points
        order = list(range(len(written)))
        if all(len(value) == 1 and isinstance(value[0], float | int) for value in values):
            order.sort(key=lambda i: values[i][0])
        return [(", ".join(written[i]), self.lines.get(i, [])) for i in order]


class Tally:
    """Sums up a run's events; unknown events are ignored.

    Attributes:
        record: The run, from "run_starting" on.
        n_before: Number of shots that were complete before the first event.
        n_done: Number of shots completed since then.
        n_judged: Number of them that were judged on their last image.
        n_defect_free: Number of them that met the target.
        n_seen: Number of them that met it in at least one image.
        n_repeated: Number of attempts that had to be repeated.
        image: The last image.
        image_shot: Index of the shot of the last image.
        shot: Index of the current shot.
        stages: Stage -> its durations.
        scan: The points of the scan; None without one.
        measured: The quantities that the run measures, the most important first.
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
        self.best = ""
        self.status = ""

    @property
    def n_shots(self) -> int:
        """Planned number of shots of the run."""
        return self.record.n_shots if self.record is not None else 0

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
        self.n_before = n_before - self.n_done  # `watch` has counted them itself
        if self.scan is None and record.scan:  # the points of a resumed run are kept
            self.scan = ScanTally(record.scan)
        if not self.measured:
            names = names_measured(record.resolved, record.target)
            self.measured = [Series(make_quantity(name, record.target), run_dir) for name in names]

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
        """Add the results of analyses that have come."""
        for measured in self.measured:
            measured.read_results()
