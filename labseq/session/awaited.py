"""Results of analyses that decide what a run does next: the run waits for them between two shots."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from labseq.errors import DeviceError
from labseq.guard import StopFlag
from labseq.messages import clean, did_you_mean, listing
from labseq.recording import Run
from labseq.recording.results import ERROR, PREFIX, SHOT
from labseq.session.observers import FINISH_WITHIN, USE, AnalysisProcesses, Observers
from labseq.units import format_quantity

_USED: Final = "results_used"
"""Event that records the results that were used, None for a shot without one."""


class AwaitedResults:
    """The results of analyses that an adaptive scan or a check of the run needs.

    The results that were used are in the event log. A resumed run takes them from there: it decides as
    before, even if a result came too late or was computed again since.

    Args:
        needed: Quantity -> what for, if the run cannot go on without it, else "".
        analyses: The analyses of the sequence.
        observers: Receive warnings and the results that are used.

    Attributes:
        values: Quantity -> shot -> value; None for a shot without one.
    """

    def __init__(
        self,
        needed: Mapping[str, str],
        analyses: Sequence[Mapping[str, Any]],
        observers: Observers,
        stop: StopFlag,
        run: Run | None = None,
    ) -> None:
        self._needed = {name: why for name, why in needed.items() if name.startswith(PREFIX)}
        self._analysis = {name: _analysis_of(name, analyses) for name in self._needed}
        self._observers = observers
        self._stop = stop
        self._run = run
        self._processes: AnalysisProcesses | None = None
        self._unwritten: list[Mapping[str, Any]] = []
        self._warned: set[tuple[str, str]] = set()
        self.values: dict[str, dict[int, float | None]] = {name: {} for name in self._needed}
        for event in run.events if run is not None and self._needed else ():
            used = event["values"] if event["event"] == _USED else {}
            if used.get("quantity") in self.values:
                self.values[used["quantity"]].update(zip(used["shots"], used["values"], strict=True))

    def follow(self, processes: AnalysisProcesses) -> None:
        """Take results from the analyses that run beside the run, from now on."""
        self._processes = processes
        for used in self._unwritten:
            self._observers.event(_USED, used)
        self._unwritten = []

    def await_shots(self, name: str, shots: Sequence[int]) -> None:
        """Wait until the values of a quantity are known, if it is a result.

        Raises:
            DeviceError: The analysis has ended, and the run cannot go on without it.
            RecordingError: Its results cannot be read.
            StopRequested: The run was asked to stop.
        """
        if name not in self.values:
            return
        missing = [shot for shot in shots if shot not in self.values[name]]
        if missing:
            rows, is_running = self._rows(self._analysis[name], missing)
            if self._needed[name] and not is_running and len(rows) < len(missing):
                raise self._ended(name)
            found = {shot: self._value(name, shot, rows.get(shot)) for shot in missing}
            self.values[name].update(found)
            self._write({"quantity": name, "shots": missing, "values": [*found.values()]})

    def _rows(
        self, analysis: Mapping[str, Any], shots: Sequence[int]
    ) -> tuple[Mapping[int, Mapping[str, Any]], bool]:
        name = str(analysis[USE])
        if self._processes is not None:
            return self._processes.wait_for(name, shots, self._stop)
        assert self._run is not None  # it died before it had read the results of its last point
        processes = AnalysisProcesses(self._run.path, [analysis], self._observers.warn)
        try:
            return processes.wait_for(name, shots, self._stop)
        finally:
            processes.finish()

    def _value(self, name: str, shot: int, row: Mapping[str, Any] | None) -> float | None:
        """The value in a row of the results; None, with a warning, if it has none."""
        analysis = self._analysis[name]
        prefix = f"{PREFIX}{analysis[USE]}."
        value = None if row is None else row.get(name.removeprefix(prefix))
        if isinstance(value, bool | int | float) and math.isfinite(value):
            return value
        if row is None:
            why = f"the analysis gave no result within {format_quantity(analysis[FINISH_WITHIN], 'time')}"
        elif ERROR in row:
            why = f"the analysis failed: {row[ERROR]}"
        else:
            others = [f"{prefix}{other}" for other in row if other != SHOT]
            why = did_you_mean(name, others) or f"as a number; the analysis gave {listing(others)}"
        if (kind := (name, why.partition(":")[0])) not in self._warned:
            self._warned.add(kind)
            self._observers.warn(f"shot {shot} has no '{clean(name)}': {why}")
        return None

    def _ended(self, name: str) -> DeviceError:
        use = self._analysis[name][USE]
        what = f"it has ended, and the run needs '{clean(name)}' {self._needed[name]}"
        return DeviceError(f"analysis '{use}'", f"{what}; see analysis/{use}.log in the run's folder")

    def _write(self, used: Mapping[str, Any]) -> None:
        if self._processes is None:  # the event log is not open yet
            self._unwritten.append(used)
        else:
            self._observers.event(_USED, used)


def _analysis_of(name: str, analyses: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """The analysis whose results a quantity is one of; names may contain dots."""
    found = [one for one in analyses if name.startswith(f"{PREFIX}{one[USE]}.")]
    return max(found, key=lambda one: len(str(one[USE])))
