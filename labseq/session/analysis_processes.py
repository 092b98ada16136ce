"""Runs each analysis in its own process, and waits for the results that the run depends on."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from labseq.data.reader import Run, open_run
from labseq.errors import DeviceError, LabseqError
from labseq.files import check_ordinary, make_folder, share_with_group
from labseq.guard import StopFlag
from labseq.messages import clean, did_you_mean, listing
from labseq.recording.folders import RESULT_PREFIX, split_result
from labseq.recording.results import (
    ERROR,
    SHOT,
    Results,
    read_results,
    results_file,
    shots_with_result,
)
from labseq.roles import RunObserver
from labseq.session.checks import Analyses
from labseq.units import format_quantity

USE: Final = "use"
FINISH_WITHIN: Final = "finish_within"
"""Keys of the core in the settings of an analysis."""
FAILED: Final = "failed: "
"""Lines of an analysis's log with this prefix are shown as warnings of the run."""
GRACE_S: Final = 2.0
"""Extra time for a process to exit before it is killed, in seconds."""
LOOK_S: Final = 0.02
"""Interval between two readings of results that the run waits for, in seconds."""
MAX_READ: Final = 1 << 16
"""Number of bytes that are read from the end of a log."""
_MODULE: Final = "labseq.session.analyses"

_USED: Final = "results_used"
"""Event that records the results that were used, None for a shot without one."""

Rows = Mapping[int, Mapping[str, Any]]
"""Index of a shot -> its row in the results of an analysis."""


class AnalysisProcesses(Analyses):
    """The analyses of a run's shots, which neither stop nor slow the run unless it needs their results.

    If an adaptive scan or a check needs a result, the run waits for it between two shots. The results that
    were used are in the event log. A resumed run takes them from there, so that it decides as before, even if
    a result came too late or was computed again since.

    Args:
        analyses: "use" and "finish_within" of each analysis of the sequence.
        needed: Quantity of an analysis -> its purpose if the run cannot continue without it, else "".
        observer: Receives warnings and the results that are used.
        stop: The request to stop, which ends a wait.
        run: The run, if it is resumed.
    """

    def __init__(
        self,
        analyses: Sequence[Mapping[str, Any]],
        needed: Mapping[str, str],
        observer: RunObserver,
        stop: StopFlag,
        run: Run | None = None,
    ) -> None:
        super().__init__()
        self._analyses = analyses
        self._needed = {name: why for name, why in needed.items() if name.startswith(RESULT_PREFIX)}
        self._analysis = {name: _analysis_of(name, analyses) for name in self._needed}
        self._observer = observer
        self._stop = stop
        self._run = run
        self._run_dir: Path | None = None
        self._processes: dict[str, _AnalysisProcess] = {}
        self._unwritten: list[Mapping[str, Any]] = []
        self._warned: set[tuple[str, str]] = set()
        self.values = {name: {} for name in self._needed}
        for event in run.events if run is not None and self._needed else ():
            used = event["values"] if event["event"] == _USED else {}
            if used.get("quantity") in self.values:
                self.values[used["quantity"]].update(zip(used["shots"], used["values"], strict=True))

    def start(self, run_dir: Path) -> None:
        """Start their processes, from which all results are taken from now on."""
        self._run_dir = run_dir
        for analysis in self._analyses:
            if (process := self._started(run_dir, analysis)) is not None:
                self._processes[process.name] = process
        for used in self._unwritten:
            self._observer.event(_USED, used)

    def look(self) -> None:
        """Warn once about each analysis that has failed. Fast enough to call between shots."""
        for process in self._processes.values():
            process.look(self._warn)

    def finish(self) -> None:
        """Give each analysis time for the remaining shots after the run, then report missing results."""
        # first ask all of them to end, so that they work through their last shots at the same time
        for process in self._processes.values():
            process.end_of_run()
        end_s = time.monotonic()
        for process in self._processes.values():
            process.wait(end_s, self._warn)
            self._report_missing(process.name)
        self._processes = {}

    def await_shots(self, name: str, shots: Sequence[int]) -> None:
        """Wait until the values of a quantity are known, if it is a result.

        Raises:
            DeviceError: The analysis has ended, and the run cannot continue without it.
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
            used = {"quantity": name, "shots": missing, "values": [*found.values()]}
            if self._run_dir is None:  # the event log is not open yet
                self._unwritten.append(used)
            else:
                self._observer.event(_USED, used)

    def _rows(self, analysis: Mapping[str, Any], shots: Collection[int]) -> tuple[Rows, bool]:
        """The results of these shots that arrive in time, and whether more can arrive."""
        if self._run_dir is not None:
            process = self._processes.get(str(analysis[USE]))
            return ({}, False) if process is None else process.wait_for(shots, self._stop)
        assert self._run is not None  # it died before it had read the results of its last point
        process = self._started(self._run.path, analysis)
        if process is None:
            return {}, False
        try:
            return process.wait_for(shots, self._stop)
        finally:
            process.end_of_run()
            process.wait(time.monotonic(), self._warn)

    def _started(self, run_dir: Path, analysis: Mapping[str, Any]) -> _AnalysisProcess | None:
        try:
            return _AnalysisProcess(run_dir, analysis)
        except OSError as error:
            self._warn(f"the process of analysis '{analysis[USE]}' could not be started: {error.strerror}")
            return None

    def _report_missing(self, name: str) -> None:
        assert self._run_dir is not None
        with suppress(LabseqError):
            rows = read_results(results_file(self._run_dir, name))[0]
            shots = {shot.index for shot in open_run(self._run_dir).shots}
            n_missing, n_failed = len(shots - shots_with_result(rows)), sum(ERROR in row for row in rows)
            if n_missing:
                failed = f" ({n_failed} failed)" if n_failed else ""
                text = f"analysis '{name}' has no result for {n_missing} of {len(shots)} shots{failed}"
                self._warn(f"{text}; 'labseq analyse {self._run_dir}' computes the missing results")

    def _value(self, name: str, shot: int, row: Mapping[str, Any] | None) -> float | None:
        """The value in a row of the results. None, with a warning, if it has none."""
        analysis = self._analysis[name]
        prefix = f"{RESULT_PREFIX}{analysis[USE]}."
        value = None if row is None else row.get(name.removeprefix(prefix))
        if isinstance(value, bool | int | float) and math.isfinite(value):
            return value
        if row is None:
            why = f"the analysis gave no result within {format_quantity(analysis[FINISH_WITHIN], 'time')}"
        elif ERROR in row:
            why = f"the analysis failed: {row[ERROR]}"
        else:
            others = [f"{prefix}{other}" for other in row if other != SHOT]
            why = did_you_mean(name, others) or f"it is not a number; the analysis gave {listing(others)}"
        if (kind := (name, why.partition(":")[0])) not in self._warned:
            self._warned.add(kind)
            self._warn(f"shot {shot} has no '{clean(name)}': {why}")
        return None

    def _ended(self, name: str) -> DeviceError:
        use = self._analysis[name][USE]
        what = f"it has ended, and the run needs '{clean(name)}' {self._needed[name]}"
        return DeviceError(f"analysis '{use}'", f"{what}; see analysis/{use}.log in the run's folder")

    def _warn(self, text: str) -> None:
        self._observer.event("warning", {"text": text})


class _AnalysisProcess:
    """The process of one analysis."""

    def __init__(self, run_dir: Path, analysis: Mapping[str, Any]) -> None:
        self.name = name = str(analysis[USE])
        self._finish_within_s = float(analysis[FINISH_WITHIN])
        self._has_warned = False
        self._log = results_file(run_dir, name).with_suffix(".log")
        make_folder(self._log.parent)
        self._results_file = results_file(run_dir, name)
        self._results = Results(self._results_file)
        self._size_before = self._size()
        self._start_s = time.monotonic()
        if self._log.exists():
            check_ordinary(self._log)
        with self._log.open("ab") as log:
            self._seen = log.tell()
            share_with_group(self._log)  # another user may resume the run
            self._process = subprocess.Popen(  # noqa: S603 - our own module, no shell
                [sys.executable, "-P", "-m", _MODULE, str(run_dir), name, str(self._finish_within_s)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,  # Ctrl-C and a lost terminal are handled by the run
                creationflags=_flags(),
            )

    def look(self, warn: Callable[[str], None]) -> None:
        """Report the first failure. The log of the analysis lists all of them."""
        if self._has_warned:
            return
        code = self._process.poll()
        with suppress(OSError):
            lines = self._new_lines()
            failed = [line.removeprefix(FAILED) for line in lines if line.startswith(FAILED)]
            if code and not failed:
                failed = [": ".join([f"its process ended with exit code {code}", *lines[-1:]])]
            if failed:
                warn(f"analysis '{self.name}' failed: {failed[0]}; see {self._log}")
                self._has_warned = True

    def wait_for(self, shots: Collection[int], stop: StopFlag) -> tuple[Rows, bool]:
        """Wait for the results of shots, at most ``finish_within`` from the start of the process.

        Returns:
            Shot -> its row if that arrived in time, and whether more can arrive.

        Raises:
            RecordingError: The results cannot be read.
            StopRequested: The run was asked to stop.
        """
        asked_s = time.monotonic()
        while True:
            is_running, now_s = self._process.poll() is None, time.monotonic()
            self._results.read()
            # its time begins with its first result, or 60 s after its start at the latest, because
            # starting takes seconds
            if self._size() == self._size_before and now_s < self._start_s + 60.0:
                asked_s = now_s
            found = {shot: self._results.rows[shot] for shot in shots if shot in self._results.rows}
            if len(found) == len(shots) or not is_running or now_s > asked_s + self._finish_within_s:
                return found, is_running
            stop.wait(LOOK_S)

    def _size(self) -> int:
        return self._results_file.stat().st_size if self._results_file.exists() else 0

    def end_of_run(self) -> None:
        """Tell the process that no more shots follow."""
        assert self._process.stdin is not None
        with suppress(OSError):  # it has exited
            self._process.stdin.close()

    def wait(self, end_s: float, warn: Callable[[str], None]) -> None:
        """Wait until the process has ended, and kill it if its time is up.

        Args:
            end_s: When the run ended, on this computer's monotonic clock.
        """
        left_s = end_s + self._finish_within_s + GRACE_S - time.monotonic()
        try:
            self._process.wait(max(0.0, left_s))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            within = format_quantity(self._finish_within_s, "time")
            warn(f"analysis '{self.name}' did not finish within {within} after the run and was ended")
            self._has_warned = True
        self.look(warn)
        with suppress(OSError):
            if not self._log.stat().st_size:
                self._log.unlink()

    def _new_lines(self) -> list[str]:
        """Lines added to the end of its log since the last call."""
        if self._log.stat().st_size == self._seen:
            return []
        with self._log.open("rb") as log:
            log.seek(max(self._seen, self._log.stat().st_size - MAX_READ))
            text = log.read(MAX_READ)
            self._seen = log.tell()
        return text.decode(errors="replace").splitlines()


def _flags() -> int:
    if sys.platform == "win32":
        return subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.BELOW_NORMAL_PRIORITY_CLASS
    return 0


def _analysis_of(name: str, analyses: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """The analysis that computes a quantity."""
    use, _ = split_result(name) or ("", "")
    return next(analysis for analysis in analyses if analysis[USE] == use)
