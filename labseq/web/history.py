"""The shots of a run in columns, which grow as the run writes its index."""

from __future__ import annotations

import itertools
import math
import re
from array import array
from datetime import datetime
from pathlib import Path
from threading import Lock
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.files import lines_in, open_ordinary
from labseq.model.estimate import Estimate, Rate, mean
from labseq.model.records import STEP
from labseq.plain import parse_object
from labseq.recording.folders import INDEX_FILE
from labseq.recording.run_file import is_index_row

_BIN: Final = 5
"""Minimum number of shots of a point of a trend, once there are enough."""
_NUMBERS: Final = ("success", "filling", "seen", "n_cycles", "n_batches", "n_atom_moves", "duration_s", "t_s")
_LINE: Final = re.compile(
    rb'\{"shot": (\d{1,15}), "attempt": (\d{1,9}), "status": "(\w+)", "error": "(?:[^"\\]|\\.)*+", '
    rb'"t_start_utc": "([^"]{,40})", "t_end_utc": "[^"]{,40}", "success": (true|false|null), '
    rb'"filling_fraction": (null|[-+.\deE]{1,30}), "seen_defect_free_cycle": (-?\d{1,9}), "n_images": \d+, '
    rb'"n_cycles": (\d{1,9}), "n_batches": (\d{1,9}), "n_atom_moves": (\d{1,15}), '
    rb'(?:"\w{1,40}": [-+.\w]{1,30}, )*?"counts": (true|false), .*\}\n',
    re.DOTALL,
)
"""A line as `labseq.recording` writes it, up to "counts"; matching takes a tenth of the time of JSON."""
_STEP: Final = re.compile(rb'"' + STEP.encode() + rb'\w{1,80}": ([.\deE+-]{1,30})')
_LOST: Final = re.compile(rb'"lost\.(\w{1,40})": ([.\deE+-]{1,30})')
_TRUTH: Final = {b"true": 1.0, b"false": 0.0, b"null": math.nan}


class RunHistory:
    """The lines of a run's index as columns of numbers: 20,000 shots take 3 MB, not 100 MB.

    All methods may be called from several threads.

    Args:
        run_dir: The run's folder.
    """

    def __init__(self, run_dir: Path) -> None:
        self._path = run_dir / INDEX_FILE
        self._lock = Lock()
        self._clear()

    def _clear(self) -> None:
        self._read_to = self._inode = 0
        self._shot, self._attempt, self._start = array("q"), array("q"), array("q")
        self._numbers = {name: array("d") for name in _NUMBERS}
        self._counts = array("b")
        self._lost: dict[str, array[float]] = {}
        self._line_of: dict[int, int] = {}
        self.n_damaged = 0

    def update(self) -> bool:
        """Read the lines that were added; all of them again if the file was replaced or shortened.

        Returns:
            Whether anything has changed.

        Raises:
            RecordingError: The file cannot be read.
        """
        with self._lock:
            try:
                about = self._path.stat()
            except OSError:
                has_lines = bool(self._shot)
                self._clear()
                return has_lines
            is_other = about.st_ino != self._inode or about.st_size < self._read_to
            if is_other:
                self._clear()
                self._inode = about.st_ino
            if about.st_size == self._read_to:
                return is_other
            at = before = self._read_to
            for line in lines_in(self._path, at):
                if line.endswith(b"\n"):
                    self._add(line, at)
                    at += len(line)
            self._read_to = at
            return is_other or at > before

    def _add(self, line: bytes, at: int) -> None:
        found = _LINE.fullmatch(line)
        if found is None:
            self._add_parsed(line, at)
            return
        shot, attempt, _, t_start, success, filling, *counts, counted = found.groups()
        steps_s = math.fsum(map(float, _STEP.findall(line)))
        judged = math.nan if filling == b"null" else float(filling)
        numbers = (_TRUTH[success], judged, *map(float, counts), steps_s, _seconds(t_start.decode()))
        lost = {name.decode(): float(value) for name, value in _LOST.findall(line)}
        self._append((int(shot), int(attempt), at), numbers, lost, is_counted=counted == b"true")

    def _add_parsed(self, line: bytes, at: int) -> None:
        """Add a line that another version of labseq wrote; or count it as damaged."""
        row = parse_object(line)
        if row is None or not is_index_row(row):
            self.n_damaged += 1
            return
        filling, success = row["filling_fraction"], row["success"]
        numbers = (
            math.nan if success is None else float(success),
            math.nan if filling is None else float(filling),
            *(float(row.get(name) or 0) for name in ("seen_defect_free_cycle", *_NUMBERS[3:6])),
            math.fsum(s or 0.0 for name, s in row["stage_s"].items() if name.startswith(STEP)),
            _seconds(str(row.get("t_start_utc"))),
        )
        lost = {
            name.removeprefix("lost."): float(value)
            for name, value in row["simulation"].items()
            if name.startswith("lost.")
        }
        self._append((row["shot"], row["attempt"], at), numbers, lost, is_counted=row["counts"])

    def _append(
        self,
        place: tuple[int, int, int],
        numbers: tuple[float, ...],
        lost: dict[str, float],
        *,
        is_counted: bool,
    ) -> None:
        shot, attempt, at = place
        n = len(self._shot)
        if is_counted:  # the last line counts if a shot was written twice
            if (older := self._line_of.get(shot)) is not None:
                self._counts[older] = 0
            self._line_of[shot] = n
        self._counts.append(is_counted)
        self._shot.append(shot)
        self._attempt.append(attempt)
        self._start.append(at)
        for column, number in zip(self._numbers.values(), numbers, strict=True):
            column.append(number)
        for name in lost.keys() - self._lost.keys():
            self._lost[name] = array("d", [math.nan]) * n
        for name, column in self._lost.items():
            column.append(lost.get(name, math.nan))

    def __len__(self) -> int:
        """Number of lines that can be read: shots, and attempts that do not count."""
        return len(self._shot)

    @property
    def n_shots(self) -> int:
        """Number of shots that count."""
        return len(self._line_of)

    def row(self, line: int) -> dict[str, Any]:
        """A line of the index, read from the file.

        Raises:
            RecordingError: It cannot be read.
        """
        with self._lock:
            start = self._start[line]
        try:
            with open_ordinary(self._path) as file:
                file.seek(start)
                row = parse_object(file.readline(1 << 24))
        except OSError as error:
            raise RecordingError(self._path, f"cannot be read: {error.strerror}", "check the disk") from error
        if row is None or not is_index_row(row):
            raise RecordingError(self._path, "has a damaged line", "`labseq doctor` reports them")
        return row

    def line_of(self, shot: int, attempt: int | None = None) -> int | None:
        """The line of a shot that counts, or of one attempt; None if there is none."""
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
            )


class Columns:
    """The columns of a run's index at one time, in the order of its lines.

    Args:
        shot: int64 (n_lines,), index of the shot.
        attempt: int64 (n_lines,), index of the attempt.
        counts: bool (n_lines,), whether it completed the shot.
        numbers: Name -> float64 (n_lines,), nan where it is unknown.
        lost: Cause -> float64 (n_lines,), atoms that a simulation lost.
    """

    def __init__(
        self,
        shot: NDArray[np.int64],
        attempt: NDArray[np.int64],
        counts: NDArray[np.bool_],
        numbers: dict[str, NDArray[np.float64]],
        lost: dict[str, NDArray[np.float64]],
    ) -> None:
        self.shot, self.attempt, self.counts, self.numbers, self._lost = shot, attempt, counts, numbers, lost
        self.counted = np.flatnonzero(counts)[np.argsort(shot[counts], kind="stable")]

    def of_shots(self, name: str) -> NDArray[np.float64]:
        """A column of the shots that count, by their index."""
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
        found = {name: column[self.counted] for name, column in sorted(self._lost.items())}
        return {name: mean(column[~np.isnan(column)]) for name, column in found.items()}

    def trend(self, n_most: int) -> list[dict[str, Any]]:
        """Filling and defect-free fraction of successive shots, in at most so many bins of five or more."""
        shot, filling, success = self.shot[self.counted], self.of_shots("filling"), self.of_shots("success")
        n_bins = min(n_most, len(shot) // _BIN if len(shot) >= 2 * _BIN else len(shot))
        edges = np.linspace(0, len(shot), n_bins + 1).round().astype(int) if n_bins else np.zeros(1, int)
        bins = list[dict[str, Any]]()
        for first, end in itertools.pairwise(edges):
            judged = ~np.isnan(filling[first:end])
            average, rate = mean(filling[first:end][judged]), rate_of(success[first:end][judged])
            bins.append(
                {
                    "shot": float(shot[first:end].mean()),
                    "n": int(judged.sum()),
                    **judged_values(average, rate),
                }
            )
        return bins


def rate_of(success: NDArray[np.float64]) -> Rate:
    """The rate of ones among zeros and ones."""
    return Rate(int(success.sum()), len(success))


def judged_values(filling: Estimate, rate: Rate) -> dict[str, Any]:
    """Filling and defect-free fraction with their 68 % intervals, for JSON."""
    return {
        "filling": finite(filling.value),
        "filling_interval": interval_of(filling),
        "defect_free": finite(rate.value),
        "defect_free_interval": interval_of(rate),
    }


def finite(value: float) -> float | None:
    """A number for JSON: None instead of nan or infinity."""
    return float(value) if math.isfinite(value) else None


def interval_of(value: Estimate | Rate) -> list[float | None]:
    """The 68 % interval for JSON."""
    return [finite(end) for end in value.interval]


def _seconds(t_utc: str) -> float:
    """ISO 8601 as seconds since 1970; nan if it is damaged."""
    try:
        return datetime.fromisoformat(t_utc).timestamp()
    except (ValueError, OverflowError):
        return math.nan
