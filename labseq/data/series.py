"""The values of a quantity for every line of a run's index, which grows during the run."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.data.quantities import Quantity
from labseq.data.shot import Shot
from labseq.errors import RecordingError
from labseq.model.estimate import Estimated, Rate, mean
from labseq.model.image_quantities import NO_VALUE, OF_IMAGES, parse_name
from labseq.recording.folders import split_result
from labseq.recording.index import IndexRow
from labseq.recording.results import Results, results_file

Lines = Sequence[int] | NDArray[np.int64]
"""Numbers of lines of an index, counted from 0, without damaged lines."""


class Series:
    """The values of a quantity in the lines of a run's index.

    Values that the index lacks are added later. Results of analyses come after their shots. Files of shots
    take 10 to 20 ms each to read, so only :meth:`read_files` reads them.
    """

    def __init__(self, quantity: Quantity, run_dir: Path) -> None:
        self.quantity = quantity
        self._run_dir = run_dir
        self._n, self._n_trials = array("d"), array("d")
        self._of_images = parse_name(quantity.name).kind in OF_IMAGES
        analysis, self._key = split_result(quantity.name) or ("", "")
        self._results = Results(results_file(run_dir, analysis)) if analysis else None
        self._waiting: dict[int, int] = {}

    def __len__(self) -> int:
        """Number of lines."""
        return len(self._n)

    @property
    def n_unread(self) -> int:
        """Number of shots whose files have not been read yet."""
        return 0 if self._results is not None else len(self._waiting)

    def add(self, row: IndexRow) -> None:
        """Add a line of the index."""
        shot = Shot(self._run_dir, row, _leave_unread)
        n, n_trials = self.quantity.events(shot) if row.counts else NO_VALUE
        in_file = self._of_images and bool(row.n_images) and self.quantity.name not in row.measured
        if row.counts and not n_trials and (in_file or self._results is not None):
            self._waiting[len(self)] = row.shot
        self._n.append(n)
        self._n_trials.append(n_trials)

    def read_results(self) -> None:
        """Add the results of analyses that have arrived.

        Raises:
            RecordingError: The results cannot be read.
        """
        if self._results is None or not self._waiting:
            return
        self._results.read()
        for line, shot in [*self._waiting.items()]:
            if shot in self._results.rows:
                value: Any = self._results.rows[shot].get(self._key)
                is_number = isinstance(value, bool | int | float)
                self._set(line, *((float(value), 1.0) if is_number else NO_VALUE))

    def read_files(self, shot_of: Callable[[int], Shot], seconds: float) -> None:
        """Add values from the files of shots.

        Args:
            shot_of: Line -> its shot.
            seconds: No more files are read after this time.
        """
        if self._results is not None:
            return
        end_s = time.monotonic() + seconds
        for line in [*self._waiting]:
            if time.monotonic() >= end_s:
                break
            try:
                self._set(line, *self.quantity.events(shot_of(line)))
            except RecordingError:  # the shot has no value then
                del self._waiting[line]

    def _set(self, line: int, n: float, n_trials: float) -> None:
        self._n[line], self._n_trials[line] = n, n_trials
        del self._waiting[line]

    def over(self, groups: Iterable[Lines]) -> list[Estimated]:
        """The mean over each group of lines, with its error."""
        n, n_trials = np.array(self._n), np.array(self._n_trials)
        known = ~np.isnan(n) & (n_trials > 0)
        means: list[Estimated] = []
        for group in groups:
            lines = np.asarray(group, np.int64)
            lines = lines[known[lines]]
            if self.quantity.is_rate:
                means.append(Rate(round(n[lines].sum()), round(n_trials[lines].sum())))
            else:
                means.append(mean(n[lines] / n_trials[lines]))
        return means

    @property
    def mean(self) -> Estimated:
        """The mean over all lines, with its error."""
        return self.over([range(len(self))])[0]

    def value(self, line: int) -> float:
        """The value of a line. nan if it is unknown."""
        return self._n[line] / self._n_trials[line] if self._n_trials[line] else math.nan

    def n_known(self, lines: Lines) -> int:
        """Number of these lines that have a value."""
        return sum(not math.isnan(self.value(line)) for line in lines)


def _leave_unread(path: Path) -> Any:
    raise RecordingError(path, "is read later", "")
