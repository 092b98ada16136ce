"""Passes the events of a run to its log, plugins' observer hooks and the live view; starts its analyses."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from labseq.errors import DeviceTimeoutError, LabseqError
from labseq.files import check_ordinary
from labseq.guard import Guard, StopFlag
from labseq.messages import format_error
from labseq.model import CycleRecord, ShotRecord, StageTiming
from labseq.plugins import PluginHost
from labseq.recording import open_run
from labseq.recording.results import ERROR, Results, done, read_results, results_file
from labseq.roles import RunObserver
from labseq.units import format_quantity

USE: Final = "use"
FINISH_WITHIN: Final = "finish_within"
FAILED: Final = "failed: "
"""Lines of an analysis's log with this prefix are shown as warnings of the run."""

_QUIET: Final = frozenset({"image", "cycle", "state", "compiling", "compiled", "run_finished"})
"""Events that are not logged: the shot files hold them, or the writer logs them itself."""
_HOOKS: Final = {  # event -> observer hook of plugins, and the event's values that are its arguments
    "run_started": ("labseq_run_started", {"run": "record"}),
    "shot_finished": ("labseq_shot_finished", {"shot": "shot"}),
    "run_finished": ("labseq_run_finished", {"run": "record"}),
}
MAX_WAIT_S: Final = 5.0
"""Maximum time for a plugin's observer hook, in seconds; a slower one is not called again in the run."""


class Observers:
    """Implements ``RunObserver`` for the sequencer; no failure of a receiver stops the run.

    Attributes:
        log: Writes a line into the run's event log; set once the run has a folder.
    """

    def __init__(self, host: PluginHost, observer: RunObserver | None) -> None:
        self._host = host
        self._observer = observer
        self._guard = Guard()
        self._hung: set[str] = set()
        self._analyses: AnalysisProcesses | None = None
        self.log: Callable[..., None] | None = None

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Pass an event on to every receiver."""
        self._write(name, values)
        self._notify(name, values)
        self._show(name, values)
        if name == "shot_finished" and self._analyses is not None:
            self._analyses.look()

    @property
    def need_frames(self) -> bool:
        """Whether a plugin receives the shots, with their frames."""
        return any(True for _ in self._host.listeners("labseq_shot_finished", shot=None))

    def warn(self, text: str) -> None:
        """Report a warning."""
        self.event("warning", {"text": text})

    def analyse(self, run_dir: Path, analyses: Sequence[Mapping[str, Any]]) -> AnalysisProcesses:
        """Start the analyses of the run's shots, each in its own process."""
        self._analyses = AnalysisProcesses(run_dir, analyses, self.warn)
        return self._analyses

    def finish_analyses(self) -> None:
        """Wait for the analyses to finish, after the devices are safe."""
        if self._analyses is not None:
            self._analyses.finish()

    def end(self) -> None:
        """End the plugins' threads."""
        self._guard.end()

    def _notify(self, name: str, values: Mapping[str, Any]) -> None:
        if name not in _HOOKS:
            return
        hook, names = _HOOKS[name]
        arguments = {argument: values[key] for argument, key in names.items()}
        for plugin, call in self._host.listeners(hook, **arguments):
            if plugin in self._hung:
                continue
            try:
                self._guard.call_despite_stop(plugin, MAX_WAIT_S, call)
            except LabseqError as error:
                if isinstance(error, DeviceTimeoutError):
                    self._hung.add(plugin)
                warning = {"text": f"plugin '{plugin}' failed in its observer hook: {error}"}
                self._write("warning", warning)
                self._show("warning", warning)

    def _show(self, name: str, values: Mapping[str, Any]) -> None:
        if self._observer is None:
            return
        try:
            self._observer.event(name, values)
        except BaseException as error:  # noqa: BLE001 - a broken screen must not stop the run
            self._observer = None
            self._write("warning", {"text": f"the live view failed and is off: {format_error(error)}"})

    def _write(self, name: str, values: Mapping[str, Any]) -> None:
        if self.log is None or name in _QUIET:
            return
        timing = values.get("timing")
        if isinstance(timing, StageTiming):
            if timing.over_budget:
                self.log("over_budget", **_timing(timing))
            return
        self.log(name, **{key: _plain(value) for key, value in values.items() if key != "record"})


def _timing(timing: StageTiming) -> dict[str, Any]:
    names = ("stage", "step", "cycle", "duration_s", "host_s", "budget_s")
    return {name: getattr(timing, name) for name in names}


def _plain(value: Any) -> Any:
    if isinstance(value, ShotRecord):
        names = ("shot_index", "attempt", "status", "error", "success", "filling_fraction")
        return {name: getattr(value, name) for name in names}
    if isinstance(value, CycleRecord):
        return {"cycle": value.cycle, "n_batches_played": value.n_batches_played}
    return value


GRACE_S: Final = 2.0
"""Extra time for a process to exit before it is killed, in seconds."""
MAX_START_S: Final = 60.0
"""Time for the process of an analysis to start, before it counts as late, in seconds."""
LOOK_S: Final = 0.02
"""Interval between two readings of results that the run waits for, in seconds."""
MAX_READ: Final = 1 << 16
"""Number of bytes that are read from the end of a log."""
_MODULE: Final = "labseq.session.analyses"

Warn = Callable[[str], None]


class AnalysisProcesses:
    """The processes of a run's analyses, one each; they neither stop nor slow the run.

    Args:
        analyses: "use" and "finish_within" of each.
    """

    def __init__(self, run_dir: Path, analyses: Sequence[Mapping[str, Any]], warn: Warn) -> None:
        self._run_dir = run_dir
        self._report = warn
        self._processes: dict[str, _AnalysisProcess] = {}
        for analysis in analyses:
            name = str(analysis[USE])
            try:
                self._processes[name] = _AnalysisProcess(run_dir, name, float(analysis[FINISH_WITHIN]))
            except OSError as error:
                warn(f"the process of analysis '{name}' could not be started: {error.strerror}")

    def look(self) -> None:
        """Warn once about each analysis that has failed; fast enough to call between shots."""
        for one in self._processes.values():
            one.look(self._report)

    def wait_for(
        self, name: str, shots: Collection[int], stop: StopFlag
    ) -> tuple[Mapping[int, Mapping[str, Any]], bool]:
        """Wait until an analysis has results of shots, at most its time ``finish_within``.

        Returns:
            Shot -> its row, without those that did not come in time; and whether more can come.

        Raises:
            RecordingError: The results cannot be read.
            StopRequested: The run was asked to stop.
        """
        one = self._processes.get(name)
        return ({}, False) if one is None else one.wait_for(shots, stop)

    def finish(self) -> None:
        """After the run: give each analysis time for the remaining shots, then report missing results."""
        for one in self._processes.values():
            one.end_of_run()
        end_s = time.monotonic()
        for one in self._processes.values():
            one.wait(end_s, self._report)
            self._report_missing(one.name)
        self._processes = {}

    def _report_missing(self, name: str) -> None:
        with suppress(LabseqError):
            rows = read_results(results_file(self._run_dir, name))[0]
            shots = {shot.index for shot in open_run(self._run_dir).shots}
            n_missing, n_failed = len(shots - done(rows)), sum(ERROR in row for row in rows)
            if n_missing:
                failed = f" ({n_failed} failed)" if n_failed else ""
                text = f"analysis '{name}' has no result of {n_missing} of {len(shots)} shots{failed}"
                self._report(f"{text}; 'labseq analyse {self._run_dir}' computes the missing results")


class _AnalysisProcess:
    """The process of one analysis."""

    def __init__(self, run_dir: Path, name: str, finish_within_s: float) -> None:
        self.name = name
        self._finish_within_s = finish_within_s
        self._has_warned = False
        self._log = results_file(run_dir, name).with_suffix(".log")
        self._log.parent.mkdir(exist_ok=True)
        self._results_file = results_file(run_dir, name)
        self._results = Results(self._results_file)
        self._size_before = self._size()
        self._start_s = time.monotonic()
        if self._log.exists():
            check_ordinary(self._log)
        with self._log.open("ab") as log:
            self._seen = log.tell()
            self._process = subprocess.Popen(  # noqa: S603 - our own module, no shell
                [sys.executable, "-P", "-m", _MODULE, str(run_dir), name, str(finish_within_s)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,  # Ctrl-C and a lost terminal are handled by the run
                creationflags=_flags(),
            )

    def look(self, warn: Warn) -> None:
        """Report the first failure; the log of the analysis lists all of them."""
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

    def wait_for(
        self, shots: Collection[int], stop: StopFlag
    ) -> tuple[Mapping[int, Mapping[str, Any]], bool]:
        """See :meth:`AnalysisProcesses.wait_for`; the time that the process takes to start does not count."""
        asked_s = time.monotonic()
        while True:
            is_running, now_s = self._process.poll() is None, time.monotonic()
            self._results.read()
            if self._size() == self._size_before and now_s < self._start_s + MAX_START_S:
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

    def wait(self, end_s: float, warn: Warn) -> None:
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
            warn(f"analysis '{self.name}' did not finish within {within} after the run, and was ended")
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
