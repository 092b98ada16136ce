"""The index of a run as columns of numbers, which grow while the run writes it."""

from __future__ import annotations

import itertools
import math
from array import array
from collections.abc import Callable, Generator, Mapping
from datetime import datetime
from pathlib import Path
from threading import Lock
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.analysis.statistics import LOST
from labseq.data.follower import Follower
from labseq.data.series import Series
from labseq.errors import RecordingError
from labseq.files import lines_in
from labseq.model.estimate import Estimate, Rate, mean
from labseq.plain import parse_object
from labseq.recording.folders import INDEX_FILE
from labseq.recording.index import IndexRow, row_of_line
from labseq.web.series import about_quantity, finite, interval_of, mean_values

_NUMBERS: Final[Mapping[str, Callable[[IndexRow], float]]] = {
    "success": lambda row: math.nan if row.success is None else row.success,
    "filling": lambda row: row.filling_fraction,
    "seen": lambda row: row.seen_defect_free_cycle,
    "n_cycles": lambda row: row.n_cycles,
    "n_batches": lambda row: row.n_batches,
    "n_atom_moves": lambda row: row.n_atom_moves,
    "duration_s": lambda row: row.duration_s,
    "t_s": lambda row: _seconds(row.t_start_utc),
}
"""Column -> function that takes its number from a row of the index."""


class RunHistory:
    """The lines of a run's index as columns of numbers. 20,000 shots take 3 MB instead of 100 MB.

    All methods may be called from several threads.

    Args:
        follower: Reads lines that are added to the index.
        series_of: Makes the series of the quantities that the page of the run shows.
    """

    def __init__(self, run_dir: Path, follower: Follower, series_of: Callable[[], list[Series]]) -> None:
        self._path = run_dir / INDEX_FILE
        self._follower = follower
        self._series_of = series_of
        self._series: list[Series] | None = None
        self._lock = Lock()
        self._shot, self._attempt, self._start = array("q"), array("q"), array("q")
        self._numbers = {name: array("d") for name in _NUMBERS}
        self._counts = array("b")
        self._lost: dict[str, array[float]] = {}
        self._line_of: dict[int, int] = {}
        self.n_damaged = 0

    def update(self) -> None:
        """Read the lines that were added.

        Raises:
            RecordingError: The index or run.json cannot be read.
        """
        with self._lock:
            if self._series is None:
                self._series = self._series_of()
            for start, row in self._follower.lines():
                if row is None:
                    self.n_damaged += 1
                else:
                    self._add(row, start)
            for series in self._series:
                series.read_results()

    def _add(self, row: IndexRow, start: int) -> None:
        n = len(self._shot)
        if row.counts:  # the last line counts if a shot was written twice
            if (older := self._line_of.get(row.shot)) is not None:
                self._counts[older] = 0
            self._line_of[row.shot] = n
        for series in self._series or ():
            series.add(row)
        self._counts.append(row.counts)
        self._shot.append(row.shot)
        self._attempt.append(row.attempt)
        self._start.append(start)
        for name, number_of in _NUMBERS.items():
            self._numbers[name].append(number_of(row))
        lost = {
            name.removeprefix(LOST): value for name, value in row.simulation.items() if name.startswith(LOST)
        }
        for name in lost.keys() - self._lost.keys():
            self._lost[name] = array("d", [math.nan]) * n
        for name, column in self._lost.items():
            column.append(lost.get(name, math.nan))

    def __len__(self) -> int:
        """Number of readable lines, for shots and for attempts that do not count."""
        return len(self._shot)

    @property
    def n_shots(self) -> int:
        """Number of shots that count."""
        return len(self._line_of)

    def row(self, line: int) -> IndexRow:
        """A row of the index, read from the file.

        Raises:
            RecordingError: The row cannot be read.
        """
        with self._lock:
            row = _row_of(next(lines_in(self._path, self._start[line]), b""))
        if row is None:
            raise RecordingError(self._path, "has a damaged line", "`labseq doctor` reports them")
        return row

    def rows(self, first: int) -> Generator[IndexRow]:
        """The rows of the index from a given line, read from the file.

        Raises:
            RecordingError: The index cannot be read.
        """
        if first < len(self):
            readable = (row for text in lines_in(self._path, self._start[first]) if (row := _row_of(text)))
            yield from itertools.islice(readable, len(self) - first)

    def line_of(self, shot: int, attempt: int | None = None) -> int | None:
        """The line of a complete shot, or of one attempt. None if there is no such line."""
        if attempt is None:
            return self._line_of.get(shot)
        for line in range(len(self._shot) - 1, -1, -1):
            if (self._shot[line], self._attempt[line]) == (shot, attempt):
                return line
        return None

    def columns(self) -> Columns:
        """The columns as they are now."""
        with self._lock:
            return Columns(
                np.array(self._shot, np.int64),
                np.array(self._attempt, np.int64),
                np.array(self._counts, np.bool_),
                {name: np.array(column) for name, column in self._numbers.items()},
                {name: np.array(column) for name, column in self._lost.items()},
                tuple(self._series or ()),
            )


class Columns:
    """The columns of a run's index at one time, in the order of its lines.

    Args:
        shot: int64 (n_lines,), index of the shot.
        attempt: int64 (n_lines,), index of the attempt.
        counts: bool (n_lines,), whether the attempt completed the shot.
        numbers: Name -> float64 (n_lines,), nan where it is unknown.
        lost: Cause -> float64 (n_lines,), number of atoms that a simulation lost.
        series: The quantities that the page of the run shows, the most important first.
    """

    def __init__(
        self,
        shot: NDArray[np.int64],
        attempt: NDArray[np.int64],
        counts: NDArray[np.bool_],
        numbers: dict[str, NDArray[np.float64]],
        lost: dict[str, NDArray[np.float64]],
        series: tuple[Series, ...] = (),
    ) -> None:
        self.series = series
        self.shot, self.attempt, self.counts, self.numbers, self._lost = shot, attempt, counts, numbers, lost
        self.counted = np.flatnonzero(counts)[np.argsort(shot[counts], kind="stable")]

    def of_shots(self, name: str) -> NDArray[np.float64]:
        """A column of the shots that count, in order of shot index."""
        return self.numbers[name][self.counted]

    @property
    def filling(self) -> Estimate:
        """Mean filling of the judged shots."""
        filling = self.of_shots("filling")
        return mean(filling[~np.isnan(filling)])

    @property
    def defect_free(self) -> Rate:
        """Judged shots that met the target."""
        return rate_of(self.of_shots("success")[~np.isnan(self.of_shots("filling"))])

    @property
    def losses(self) -> dict[str, Estimate]:
        """Cause -> atoms lost in a shot."""
        losses = {name: column[self.counted] for name, column in sorted(self._lost.items())}
        return {name: mean(column[~np.isnan(column)]) for name, column in losses.items()}

    def shown(self, n_bins: int) -> list[dict[str, Any]]:
        """The quantities that the page shows, each with its mean over all shots and its trend, for JSON."""
        return [self._quantity(series, n_bins) for series in self.series]

    def means(self) -> list[dict[str, Any]]:
        """The quantities with their means but without trends."""
        return [self._quantity(series, 0) for series in self.series]

    def _quantity(self, series: Series, n_bins: int) -> dict[str, Any]:
        bins = self._bins(n_bins)
        total, *means = series.over([self.counted, *bins])
        trend = [
            {
                "shot": float(self.shot[lines].mean()),
                "n": series.n_known(lines),
                **mean_values(value),
            }
            for lines, value in zip(bins, means, strict=True)
        ]
        return {**about_quantity(series.quantity, [total.value]), **mean_values(total), "trend": trend}

    def _bins(self, n_most: int, min_shots: int = 5) -> list[NDArray[np.int64]]:
        """The lines of successive shots.

        Args:
            n_most: Maximum number of bins.
            min_shots: Minimum number of shots in a bin. With fewer than twice as many shots, each is a bin.
        """
        n = len(self.counted)
        n_bins = min(n_most, n // min_shots if n >= 2 * min_shots else n)
        return np.array_split(self.counted, n_bins) if n_bins else []


def _row_of(text: bytes) -> IndexRow | None:
    values = parse_object(text)
    return None if values is None else row_of_line(values)


def rate_of(success: NDArray[np.float64]) -> Rate:
    """The fraction of ones among zeros and ones."""
    return Rate(int(success.sum()), len(success))


def judged_values(filling: Estimate, rate: Rate) -> dict[str, Any]:
    """Filling and defect-free fraction with their 68 % intervals, for JSON."""
    return {
        "filling": finite(filling.value),
        "filling_interval": interval_of(filling),
        "defect_free": finite(rate.value),
        "defect_free_interval": interval_of(rate),
    }


def _seconds(t_utc: str) -> float:
    """ISO 8601 as seconds since 1970. nan if it is damaged."""
    try:
        return datetime.fromisoformat(t_utc).timestamp()
    except (ValueError, OverflowError):
        return math.nan
