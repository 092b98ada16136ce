"""Checks values of the last shots against their limits, between two shots."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from labseq.config.sequence import CheckSettings
from labseq.data.shot import CachingLoader, Shot
from labseq.errors import CheckFailedError
from labseq.model import TargetPattern
from labseq.recording.folders import RESULT_PREFIX
from labseq.recording.index import IndexRow

if TYPE_CHECKING:
    from labseq.data.quantities import Quantity


class Analyses:
    """The interface of :class:`AnalysisProcesses`, for a run without analyses.

    Attributes:
        values: Quantity -> shot -> value, or None for a shot without a value.
    """

    def __init__(self) -> None:
        self.values: dict[str, dict[int, float | None]] = {}

    def start(self, run_dir: Path) -> None:
        """Start the analyses, from which all results are taken from now on."""

    def look(self) -> None:
        """Warn once about each analysis that has failed. Fast enough to call between shots."""

    def finish(self) -> None:
        """Give each analysis time for the remaining shots after the run, then report missing results."""

    def await_shots(self, name: str, shots: Sequence[int]) -> None:
        """Wait until the values of a quantity are known, if it is a result.

        Raises:
            DeviceError: The analysis has ended, and the run cannot continue without it.
            RecordingError: Its results cannot be read.
            StopRequested: The run was asked to stop.
        """


class Checks:
    """Checks the quantities of the most recent shots against their limits, between two shots.

    Args:
        run_dir: The run's folder.
        rows: The rows of earlier shots of a resumed run, in order.
        target: The target of the run.
        analyses: The analyses whose results are checked.
        warn: Receives the messages of checks that only warn.

    Attributes:
        left_open: The last of the earlier shots, and why a check would skip the rest of its point, or "".
    """

    def __init__(
        self,
        checks: Sequence[CheckSettings],
        run_dir: Path,
        rows: Iterable[IndexRow],
        target: TargetPattern,
        analyses: Analyses,
        warn: Callable[[str], None],
    ) -> None:
        self._checks = [
            (check, _quantity(check, target, analyses), deque[float](maxlen=check.shots)) for check in checks
        ]
        self._run_dir = run_dir
        self._analyses = analyses
        self._warn = warn
        self._load = CachingLoader()
        self._unseen = {check.value for check in checks if not check.value.startswith(RESULT_PREFIX)}
        self.left_open = -1, ""
        for row in rows:  # as if this process had taken them, so that means continue where they were
            self._unseen.clear()  # the warning was given then
            skipping = [message for check, message in self._look(row) if check.then == "skip_point"]
            self.left_open = row.shot, skipping[0] if skipping else ""  # earlier skips are recorded

    def after(self, row: IndexRow) -> str:
        """Check a shot that was taken.

        Args:
            row: The shot as the index lists it.

        Returns:
            Why to skip the rest of its point, or "".

        Raises:
            CheckFailedError: A check that stops the run failed.
        """
        skipped = ""
        for check, message in self._look(row):
            if check.then == "stop":
                raise CheckFailedError(message, check.value)
            if check.then == "skip_point":
                skipped = skipped or message
            else:
                self._warn(f"shot {row.shot}: {message}")
        return skipped

    def _look(self, row: IndexRow) -> list[tuple[CheckSettings, str]]:
        """The checks that fail after a shot, each with a message."""
        broken: list[tuple[CheckSettings, str]] = []
        shot = Shot(self._run_dir, row, self._load)
        for check, quantity, values in self._checks:
            self._analyses.await_shots(quantity.name, [shot.index])
            value = quantity.of_shot(shot)
            if math.isnan(value) and check.value in self._unseen:  # its name may be misspelt
                self._unseen.discard(check.value)
                self._warn(_missing(check, row))
            values.append(value)
            if message := _failure(check, values):
                broken.append((check, message))
                values.clear()  # the next message comes after as many shots again
        self._unseen.clear()
        return broken


def _quantity(check: CheckSettings, target: TargetPattern, analyses: Analyses) -> Quantity:
    from labseq.data.quantities import make_quantity  # a run without checks does not need it

    return make_quantity(check.value, target, analyses.values)


def _missing(check: CheckSettings, row: IndexRow) -> str:
    from labseq.assembly.quantities import missing_quantity
    from labseq.data.columns import quantities_in

    return missing_quantity(row.shot, check.value, "to check", quantities_in(row))


def _failure(check: CheckSettings, values: deque[float]) -> str:
    """The message if the mean of the last values is out of range, or "". Missing values are skipped."""
    known = [value for value in values if not np.isnan(value)]
    if len(values) < check.shots or not known:
        return ""
    mean = float(np.mean(known))
    of = "" if check.shots == 1 else f" on the mean of the last {check.shots} shots"
    if check.at_least is not None and mean < check.at_least:
        return f"{check.value} is {mean:.6g}{of}; it should be at least {check.at_least:g}"
    if check.at_most is not None and mean > check.at_most:
        return f"{check.value} is {mean:.6g}{of}; it should be at most {check.at_most:g}"
    return ""
