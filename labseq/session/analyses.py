"""Analyses of a run's shots, each in its own process next to the run."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, cast

import labseq
from labseq.config import validate_values
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError
from labseq.files import Lock, knows_no_locks
from labseq.recording import Run, open_run
from labseq.recording.results import ANEW, ERROR, ResultsLog, done, read_results, results_file
from labseq.roles import Analysis, RecordedShot
from labseq.session.construct import construct_one
from labseq.session.profile import ChosenPlugin
from labseq.session.recorded import context_of, plugins_of, resolved_of
from labseq.units import format_quantity

USE: Final = "use"
FINISH_WITHIN: Final = "finish_within"
FAILED: Final = "failed: "
"""Prefix of the lines of a process's log that the run shows as a warning."""


@dataclass(frozen=True, slots=True)
class PreparedAnalysis:
    """An analysis that is ready for the shots of a run.

    Attributes:
        name: Its name.
        analysis: The analysis itself.
        about: Its description in the file of the results.
    """

    name: str
    analysis: Analysis
    about: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class AnalysisOutcome:
    """The result of an analysis.

    Attributes:
        name: Its name.
        n_done: Shots that were analysed now.
        n_before: Shots of which there was a result already.
        failures: Index of a shot -> why there is no result of it.
        path: The file of the results.
    """

    name: str
    n_done: int
    n_before: int
    failures: Mapping[int, str]
    path: Path


def analyses_of(run: Run) -> list[dict[str, Any]]:
    """The analyses that a run's sequence asks for, with their settings.

    Raises:
        RecordingError: The run does not say what it was taken with.
    """
    found: Any = resolved_of(run).get("analysis") or []
    return [dict(one) for one in cast("list[dict[str, Any]]", found)]


def prepare(run: Run, settings: Mapping[str, Any]) -> PreparedAnalysis:
    """Make an analysis for the shots of a run.

    Args:
        run: The run.
        settings: "use" and its settings.

    Raises:
        UnknownPluginError: No plugin offers it.
        PluginLoadError: Its plugin failed to load, or is at fault.
        ConfigError: A setting is wrong.
        RecordingError: The run does not say enough of itself.
    """
    name = str(settings[USE])
    host = plugins_of(run)
    entry = host.get("analysis", name)
    own = {key: value for key, value in settings.items() if key not in (USE, FINISH_WITHIN)}
    chosen = ChosenPlugin(entry, validate_values(entry.settings_model, own, f"analysis '{name}'"))
    version = next((info.version for info in host.infos if info.name == entry.origin), "")
    about = {
        "analysis": name,
        "settings": {key: value for key, value in chosen.dump().items() if key != USE},
        "plugin": entry.origin,
        "version": version,
        "labseq": labseq.__version__,
        "t_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    return PreparedAnalysis(name, construct_one(chosen, context_of(run, name)), about)


@contextlib.contextmanager
def results_of(
    run_dir: Path, prepared: PreparedAnalysis, *, anew: bool = False
) -> Generator[tuple[ResultsLog, set[int]]]:
    """The results of an analysis, for writing by this process alone.

    Results of other settings are not mixed with new ones: all shots are analysed again then.

    Args:
        run_dir: The run's folder.
        prepared: The analysis.
        anew: Whether to begin again in any case.

    Yields:
        Where results go, and the shots that have one already.

    Raises:
        ConfigError: Another process writes them.
        RecordingError: They cannot be written.
    """
    path = results_file(run_dir, prepared.name)
    with _alone(path, prepared.name):
        rows, about = read_results(path)
        anew = anew or about.get("settings") != prepared.about["settings"]
        yield ResultsLog(path, {**prepared.about, ANEW: anew}), set() if anew else done(rows)


def analyse(
    prepared: PreparedAnalysis,
    shots: Iterable[RecordedShot],
    log: ResultsLog,
    failed: Callable[[int, BaseException], None],
) -> int:
    """Analyse shots; one that fails is recorded and reported, and the next one follows.

    Args:
        prepared: The analysis.
        shots: The shots.
        log: Where the results go.
        failed: Receives the index of a failed shot, and the error.

    Returns:
        How many have a result.

    Raises:
        RecordingError: The disk is full.
    """
    n_done = 0
    for shot in shots:
        try:
            result = log.checked(prepared.analysis.shot(shot))
        except (Exception, SystemExit) as error:  # noqa: BLE001 - an analysis may raise anything
            log.fail(shot.index, error)
            failed(shot.index, error)
        else:
            log.write(shot.index, result)
            n_done += 1
    return n_done


def analyse_missing(run: Run, settings: Mapping[str, Any], *, anew: bool = False) -> AnalysisOutcome:
    """Analyse the shots of a run that have no result yet.

    Args:
        run: The run.
        settings: "use" and its settings.
        anew: Whether to analyse all shots again.

    Raises:
        ConfigError: A setting is wrong, or another process writes the same results.
        LabseqError: See :func:`prepare`; or the disk is full.
    """
    prepared = prepare(run, settings)
    failures: dict[int, str] = {}

    def failed(shot: int, error: BaseException) -> None:
        failures[shot] = f"{type(error).__name__}: {error}"

    with results_of(run.path, prepared, anew=anew) as (log, before):
        n_done = analyse(prepared, (s for s in run.shots if s.index not in before), log, failed)
    return AnalysisOutcome(prepared.name, n_done, len(before), failures, log.path)


@contextlib.contextmanager
def _alone(path: Path, name: str) -> Generator[None]:
    """Keep other processes from writing the same results at the same time.

    Raises:
        ConfigError: One does already.
        RecordingError: The folder cannot be written to.
    """
    lock = Lock(path.with_name(f".{path.stem}.lock"), f"the analysis '{name}'")
    try:
        holder = lock.take()
    except OSError as error:
        if not knows_no_locks(error):
            raise RecordingError(
                path.parent, f"cannot be written: {error.strerror}; check the disk"
            ) from error
        holder = None
    if holder is not None:
        what = f"the results of '{name}' are being written by {holder}"
        raise ConfigError(Problem(what, str(path), hint="wait until it has finished"))
    try:
        yield
    finally:
        lock.release()


GRACE_S: Final = 2.0
"""How much longer than its time a process may take to end by itself."""
MAX_READ: Final = 1 << 16
"""Bytes of a log that are looked at, from its end."""
_MODULE: Final = "labseq.session.analysis_process"

Warn = Callable[[str], None]


class AnalysisProcesses:
    """A process for each analysis of a run; nothing that they do stops or slows the run.

    Args:
        run_dir: The run's folder.
        analyses: "use" and "finish_within" of each.
        warn: Receives warnings.
    """

    def __init__(self, run_dir: Path, analyses: Sequence[Mapping[str, Any]], warn: Warn) -> None:
        self._run_dir = run_dir
        self._report = warn
        self._processes: list[_AnalysisProcess] = []
        for analysis in analyses:
            name = str(analysis[USE])
            try:
                self._processes.append(_AnalysisProcess(run_dir, name, float(analysis[FINISH_WITHIN])))
            except OSError as error:
                warn(f"the process of analysis '{name}' could not be started: {error.strerror}")

    def look(self) -> None:
        """Warn once of each analysis that has failed; quick, for use between shots."""
        for one in self._processes:
            one.look(self._report)

    def finish(self) -> None:
        """After the run: give each analysis time for the remaining shots, then report what is missing."""
        for one in self._processes:
            one.end_of_run()
        end_s = time.monotonic()
        for one in self._processes:
            one.wait(end_s, self._report)
            self._report_missing(one.name)
        self._processes = []

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
        """Report the first failure; its log has all of them."""
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

    def end_of_run(self) -> None:
        """Signal that no more shots come."""
        assert self._process.stdin is not None
        with suppress(OSError):  # it is gone
            self._process.stdin.close()

    def wait(self, end_s: float, warn: Warn) -> None:
        """Wait until it has ended, and end it if its time is up.

        Args:
            end_s: When the run ended, on this computer's monotonic clock.
            warn: Receives warnings.
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
        """The last lines of its log that are new since the last call."""
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
