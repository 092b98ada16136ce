"""Constructs the analyses of a run and applies them to its shots, here or in a separate process.

``python -m labseq.session.analyses RUN_DIR NAME FINISH_WITHIN`` is the process of one analysis. Its queue is
the run's index, which lists a shot as soon as it is complete on disk. So the run never waits for an analysis,
an analysis that falls behind takes no memory, and a restarted analysis continues where it was. The end of
standard input signals the end of the run.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import labseq
from labseq.assembly.plugin_choice import ChosenPlugin, construct_one
from labseq.assembly.recorded import context_of, plugins_of, resolved_of
from labseq.config.validation import validate_values
from labseq.data.follower import Follower
from labseq.data.reader import Run, open_run
from labseq.errors import ConfigError, LabseqError, Problem
from labseq.files import explained
from labseq.messages import format_plugin_error
from labseq.plain import now_utc
from labseq.processes import Lock
from labseq.recording.results import AGAIN, ResultsLog, read_results, results_file, shots_with_result
from labseq.roles import Analysis, RecordedShot
from labseq.session.analysis_processes import FAILED, FINISH_WITHIN, USE


@dataclass(frozen=True, slots=True)
class PreparedAnalysis:
    """An analysis, constructed and ready for the shots of a run.

    Attributes:
        name: Its name.
        analysis: The analysis itself.
        about: Plugin, version and settings, for the file of the results.
    """

    name: str
    analysis: Analysis
    about: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class AnalysisOutcome:
    """The outcome of an analysis, with the number of analysed shots, the failures, and the results file.

    Attributes:
        name: Its name.
        n_done: Number of shots analysed by this call.
        n_before: Number of shots that already had a result.
        failures: Index of a shot -> why it has no result.
        path: The file of the results.
    """

    name: str
    n_done: int
    n_before: int
    failures: Mapping[int, str]
    path: Path


def analyses_of(run: Run) -> list[dict[str, Any]]:
    """The analyses listed in a run's sequence, with their settings.

    Raises:
        RecordingError: run.json lacks the settings of the run.
    """
    settings: Any = resolved_of(run).get("analysis") or []
    return [dict(one) for one in cast("list[dict[str, Any]]", settings)]


def prepare(run: Run, settings: Mapping[str, Any]) -> PreparedAnalysis:
    """Construct an analysis for the shots of a run.

    Raises:
        UnknownPluginError: No plugin offers this analysis.
        PluginLoadError: Its plugin failed to load, or its constructor failed.
        ConfigError: A setting is invalid.
        RecordingError: run.json lacks settings of the run.
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
        "t_utc": now_utc("seconds"),
    }
    return PreparedAnalysis(name, construct_one(chosen, context_of(run, name)), about)


@contextlib.contextmanager
def results_of(
    run_dir: Path, prepared: PreparedAnalysis, *, again: bool = False
) -> Generator[tuple[ResultsLog, set[int]]]:
    """Open the results of an analysis for writing, locked against other processes.

    If the settings of the analysis have changed, all shots are analysed again, so that results never mix.

    Args:
        again: Whether to analyse all shots again even if the settings are unchanged.

    Yields:
        The file of the results, and the shots that already have one.

    Raises:
        ConfigError: Another process is writing them.
        RecordingError: They cannot be written.
    """
    path = results_file(run_dir, prepared.name)
    with _alone(path, prepared.name):
        rows, about = read_results(path)
        again = again or about.get("settings") != prepared.about["settings"]
        yield ResultsLog(path, {**prepared.about, AGAIN: again}), set() if again else shots_with_result(rows)


def analyse(
    prepared: PreparedAnalysis,
    shots: Iterable[RecordedShot],
    log: ResultsLog,
    failed: Callable[[int, BaseException], None],
) -> int:
    """Analyse shots. A failure is recorded and reported, and the next shot follows.

    Args:
        failed: Receives the index of a failed shot, and the error.

    Returns:
        Number of shots that now have a result.

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


def analyse_missing(run: Run, settings: Mapping[str, Any], *, again: bool = False) -> AnalysisOutcome:
    """Analyse the shots of a run that have no result yet.

    Raises:
        ConfigError: A setting is invalid, or another process writes the same results.
        LabseqError: As for :func:`prepare`, or the disk is full.
    """
    prepared = prepare(run, settings)
    failures: dict[int, str] = {}

    def failed(shot: int, error: BaseException) -> None:
        failures[shot] = format_plugin_error(error)

    with results_of(run.path, prepared, again=again) as (log, before):
        n_done = analyse(prepared, (s for s in run.shots if s.index not in before), log, failed)
    return AnalysisOutcome(prepared.name, n_done, len(before), failures, log.path)


@contextlib.contextmanager
def _alone(path: Path, name: str) -> Generator[None]:
    """Lock the results against other processes within the block.

    Raises:
        ConfigError: Another process is writing them.
        RecordingError: The folder cannot be written to.
    """
    lock = Lock(path.with_name(f".{path.stem}.lock"), f"the analysis '{name}'")
    with explained(path.parent):
        holder = lock.take(lambda text: print(f"warning: {text}", file=sys.stderr))  # noqa: T201 - or its log
    if holder is not None:
        what = f"the results of '{name}' are being written by {holder}"
        raise ConfigError(Problem(what, str(path), hint="wait until it has finished"))
    try:
        yield
    finally:
        lock.release()


LOOK_S: Final = 0.1
"""Interval between two readings of the index, in seconds."""


class _End:
    """Detects the end of the run, and the end of the time allowed after it."""

    def __init__(self, finish_within_s: float) -> None:
        self._within_s = finish_within_s
        self._deadline_s = float("inf")
        self._came = threading.Event()
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def came(self) -> bool:
        """Whether the run is over."""
        return self._came.is_set()

    @property
    def time_is_up(self) -> bool:
        """Whether the time after the run is used up, so that no further shot is analysed."""
        return time.monotonic() > self._deadline_s

    def wait(self) -> None:
        """Wait a moment for new shots, or until the run is over."""
        self._came.wait(LOOK_S)

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            sys.stdin.buffer.read()
        self._deadline_s = time.monotonic() + self._within_s
        self._came.set()


def main(run_dir: Path, name: str, finish_within_s: float) -> None:
    """Analyse the shots of a run as they come, until it is over.

    Args:
        run_dir: The run's folder.
        name: One of the analyses of its sequence.
        finish_within_s: Time allowed after the end of the run, in seconds.
    """
    end = _End(finish_within_s)
    if hasattr(os, "nice"):
        os.nice(10)  # the run comes first
    run = open_run(run_dir)
    prepared = prepare(run, next(one for one in analyses_of(run) if one[USE] == name))
    with results_of(run_dir, prepared) as (log, before):
        analyse(prepared, _as_they_come(run_dir, before, end), log, _report)


def _as_they_come(run_dir: Path, before: set[int], end: _End) -> Generator[RecordedShot]:
    """Yield the shots without a result as they are recorded, until the run is over."""
    follower = Follower(run_dir)
    while True:
        over = end.came  # before the index is read, so that it contains every shot written before the end
        for shot in follower.shots():
            if end.time_is_up:
                return
            if shot.row.counts and shot.index not in before:
                yield shot
        if over:
            return
        end.wait()


def _report(shot: int, error: BaseException) -> None:
    traceback.print_exception(error)
    print(f"{FAILED}shot {shot}: {format_plugin_error(error)}", file=sys.stderr, flush=True)  # noqa: T201 - its log


if __name__ == "__main__":
    # so that the output and the errors of an analysis keep their order in the log
    cast("io.TextIOWrapper", sys.stdout).reconfigure(line_buffering=True)
    try:
        main(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]))
    except LabseqError as failure:
        sys.exit(f"{FAILED}{failure}")
