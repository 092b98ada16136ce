"""Constructs the analyses of a run from its settings, applies them to its shots and stores the results."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import labseq
from labseq.config.validation import validate_values
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import format_error
from labseq.plain import now_utc
from labseq.processes import Lock, knows_no_locks
from labseq.recording import Run
from labseq.recording.results import AGAIN, ResultsLog, done, read_results, results_file
from labseq.roles import Analysis, RecordedShot
from labseq.session.chosen import ChosenPlugin, construct_one
from labseq.session.observers import FINISH_WITHIN, USE
from labseq.session.recorded import context_of, plugins_of, resolved_of


@dataclass(frozen=True, slots=True)
class PreparedAnalysis:
    """An analysis, constructed and ready for the shots of a run.

    Attributes:
        name: Its name.
        analysis: The analysis itself.
        about: Plugin, version and settings, as the file of the results has them.
    """

    name: str
    analysis: Analysis
    about: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class AnalysisOutcome:
    """What an analysis has done: number of shots analysed, failures, and the file of the results.

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
    found: Any = resolved_of(run).get("analysis") or []
    return [dict(one) for one in cast("list[dict[str, Any]]", found)]


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
        yield ResultsLog(path, {**prepared.about, AGAIN: again}), set() if again else done(rows)


def analyse(
    prepared: PreparedAnalysis,
    shots: Iterable[RecordedShot],
    log: ResultsLog,
    failed: Callable[[int, BaseException], None],
) -> int:
    """Analyse shots; a failure is recorded and reported, and the next shot follows.

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
        LabseqError: See :func:`prepare`; or the disk is full.
    """
    prepared = prepare(run, settings)
    failures: dict[int, str] = {}

    def failed(shot: int, error: BaseException) -> None:
        failures[shot] = format_error(error)

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
