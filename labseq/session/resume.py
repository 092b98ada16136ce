"""`labseq resume`, which reads back a run that ended early from its folder and continues it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self

from labseq.assembly.assemble import Assembly, assemble_recorded
from labseq.assembly.options import Options
from labseq.assembly.recorded import files_of
from labseq.data.reader import Run, open_run
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import LineLog, explained, write_file
from labseq.guard import StopFlag
from labseq.messages import visible
from labseq.model import RunRecord
from labseq.plain import now_utc
from labseq.processes import Lock
from labseq.recording.folders import INDEX_FILE, LOCK_FILE, RUN_FILE, SOURCES_FILE, find_run
from labseq.recording.index import IndexRow
from labseq.recording.run_file import SCANNER, read_owner, read_run, read_state, read_state_file
from labseq.recording.writer import RunWriter
from labseq.session.changes import Change, changes_between, code_changes, differences, record_today
from labseq.session.sources import RunCode
from labseq.text_files import decode, read_bytes

_DAY: Final = re.compile(r"\d{4}-\d\d-\d\d")
_NEEDED: Final[Mapping[str, type]] = {
    "sequence_path": str,
    "sequence_sha256": str,
    "profile_path": str,
    "profile_sha256": str,
    "overrides": dict,
    "resolved": dict,
    "plugins": list,
    "provenance": dict,
}


@dataclass(slots=True)
class ResumableRun:
    """A run on disk that is being resumed. No other process can resume it until it is released.

    Attributes:
        run: The run as it was when it was opened for resuming.
        done: Shots that are on disk or were skipped.
        changes: Accepted changes since the run began.
        warnings: Warnings for the user.
    """

    run: Run
    done: frozenset[int]
    changes: tuple[Change, ...]
    warnings: list[str]
    _lock: Lock

    @classmethod
    def open(cls, path: Path, shots: int | None = None) -> Self:
        """Open a run for resuming, and lock it.

        Args:
            path: The run.
            shots: New number of shots of the run. None for its original number.

        Raises:
            ConfigError: It is complete, has as many shots, is in progress, or another process resumes it.
            RecordingError: It is not a run, is damaged, has another format, or cannot be written to.
        """
        folder = find_run(path)
        _check(folder)  # before anything is written there
        lock, warnings = Lock(folder / LOCK_FILE, "labseq resume"), list[str]()
        with explained(folder):
            holder = lock.take(warnings.append)
        if holder is not None:
            raise _refused(folder, f"another process is already resuming it: {holder}")
        try:
            return cls._read(folder, shots, lock, warnings)
        except BaseException:
            lock.release()
            raise

    @classmethod
    def _read(cls, folder: Path, shots: int | None, lock: Lock, warnings: list[str]) -> Self:
        owner, changes = read_owner(folder), list[Change]()
        if read_state(folder)[0] == "running" and owner is not None:
            if owner.is_here:
                raise _refused(folder, f"it is in progress (process {owner.pid} on {owner.host})")
            changes.append(
                Change("the computer", owner.host, "this one; the run may still be in progress there")
            )
        LineLog(folder / INDEX_FILE)  # ends an unfinished last line, whose shot counts if it is complete
        run = open_run(folder)
        gone = [shot.index for shot in run.shots if not shot.file.is_file()]
        if shots is None and not gone and (over := is_over(run)):
            raise _refused(folder, f"{over}; --shots N adds more")
        done = frozenset(shot.index for shot in run.shots).difference(gone).union(run.skipped)
        if shots is not None and shots <= run.n_shots:
            raise _refused(folder, f"it has {run.n_shots} shots; expected a larger number with --shots")
        if gone:
            warnings.append(f"the files of some shots are gone; these are taken again: {_numbers(gone)}")
        return cls(run, done, tuple(changes), warnings, lock)

    @property
    def rows(self) -> list[IndexRow]:
        """The shots that are on disk, in order."""
        return [shot.row for shot in self.run.shots if shot.index in self.done]

    @property
    def root(self) -> Path:
        """The data root of the run. For a run that was moved elsewhere, the folder that it is in."""
        day = self.run.path.parent
        return day.parent if _DAY.fullmatch(day.name) else day

    def release(self) -> None:
        """Let other processes resume the run. Legal at any time."""
        self._lock.release()

    def assemble(self, *, realtime: bool) -> tuple[Assembly, Options]:
        """Assemble the run from its recorded files, calibrations and options.

        Raises:
            ConfigError: That is no longer possible, for example because a calibration or plugin is missing.
            RecordingError: The run's own files have been changed.
        """
        options, recorded = Options.of(self.run.changes, realtime=realtime), files_of(self.run)
        assembly = assemble_recorded(recorded, options)
        files = (recorded.sequence_path, recorded.sequence), (recorded.profile_path, recorded.profile)
        for path, own in files:
            if _has_changed(path, own.text):
                self.warnings.append(
                    f"{path} has been changed since, but the run continues with its earlier content"
                )
        return assembly, options

    def compare(self, assembly: Assembly, options: Options, *, accept: bool) -> None:
        """Compare the run as it began with the run as it would continue today.

        Raises:
            ConfigError: A change is not accepted, or the remaining shots would be different.
        """
        record, folder = self.run.record, self.run.path
        today = record_today(self.run, assembly, options.changes())
        for what in ("n_shots", "scan", "target"):
            if changes := differences(record, today, what):
                raise _refused(folder, f"its shots would differ today: {changes[0]}")
        self.changes += tuple(changes_between(self.run, today))
        if self.changes and not accept:
            problems = [Problem(str(change), str(folder)) for change in self.changes]
            what = "the run was begun before these changes"
            hint = "'labseq resume --accept-changes' continues anyway, and records the changes"
            raise ConfigError([*problems, Problem(what, str(folder), hint=hint)])

    def reopen(self, record: RunRecord, code: RunCode, first_shot: int | None, stop: StopFlag) -> RunWriter:
        """Open its folder for writing, and keep the plugins' sources if they have changed and take shots.

        Args:
            record: The current record of the run.
            code: The present code, which takes the remaining shots.
            first_shot: The first shot that is taken. None if none is.
            stop: The request to stop the run.

        Raises:
            RecordingError: The folder cannot be written to, or the disk is full.
        """
        resumed = tuple(self.run.record.get("resumed") or ())
        if first_shot is not None:
            before = ": ".join(filter(None, [self.run.status, self.run.error]))
            entry = {"t_utc": now_utc(), "first_shot": first_shot, "before": before}
            changes = [change._asdict() for change in self.changes]
            details = {"changes": changes, "provenance": record.provenance, "plugins": record.plugins}
            resumed += ({**entry, **details},)
        then = str(self.run.record["t_start_utc"])
        record = replace(record, t_start_utc=then, resumed=resumed)
        writer = RunWriter.reopen(self.run.path, record, n_written=len(self.rows), stop=stop)
        if first_shot is not None and code_changes(self.run, record):
            path = self.run.path / SOURCES_FILE
            write_file(path.with_stem(f"{path.stem}_{len(resumed)}"), code.archive)
        return writer


def is_over(run: Run) -> str:
    """Why there is nothing left to do in a run, or "" if it can be resumed."""
    # resuming a run that failed after its last shot would hide the reason, but a run that was stopped
    # or whose process is gone must still be ended
    failed = read_state_file(run.path).get("state") == "failed"
    # a scanner, or `stop_when`, may end a run before all shots are taken
    is_scanner = SCANNER in (run.record.get("scan") or {})
    ended = run.status == "complete" and (is_scanner or bool(run.ended_early))
    if not ended and len({*run.skipped, *(shot.index for shot in run.shots)}) < run.n_shots:
        return ""
    if failed:
        return f"no shot is missing, and its failure stays on record: {run.error}"
    return f"it is complete: {run.ended_early or 'no shot is missing'}" if run.status == "complete" else ""


def _refused(folder: Path, why: str) -> ConfigError:
    return ConfigError(Problem(f"the run cannot be resumed: {why}", str(folder)))


def _check(folder: Path) -> None:
    """Raise if run.json lacks entries that are needed for resuming.

    Raises:
        RecordingError: run.json is damaged, or has another format.
    """
    record = read_run(folder)
    wrong = [name for name, kind in _NEEDED.items() if not isinstance(record.get(name), kind)]
    if wrong:
        what = f"is damaged: it has no valid '{wrong[0]}'"
        raise RecordingError(folder / RUN_FILE, what, "restore it from a backup")


def _has_changed(path: Path, text: str) -> bool:
    """Whether a file can be read and its text has changed."""
    try:
        return decode(read_bytes(path), visible(str(path))) != text
    except ConfigError:
        return False


def _numbers(shots: list[int]) -> str:
    first = ", ".join(str(shot) for shot in shots[:5])
    return first if len(shots) <= 5 else f"{first}, ... ({len(shots)} in all)"


def reopened(
    path: Path, shots: int | None, *, accept_changes: bool, realtime: bool
) -> tuple[Assembly, Options, ResumableRun]:
    """Read a run back so that it can be continued, up to ``shots`` shots if given.

    Raises:
        ConfigError: The run cannot be resumed, or something has changed.
        RecordingError: It is not a run, is damaged, has another format, or cannot be written to.
    """
    earlier = ResumableRun.open(path, shots)
    try:
        assembly, options = earlier.assemble(realtime=realtime)
        earlier.compare(assembly, options, accept=accept_changes)
        if shots is not None:
            options = replace(options, shots=shots)
            assembly = assemble_recorded(files_of(earlier.run), options)
    except BaseException:
        earlier.release()
        raise
    return assembly, options, earlier


def taken_again(path: Path, given: Options, *, same_seed: bool) -> tuple[Assembly, Options, list[str]]:
    """Assemble a run's files for a new run, and report differences from the earlier run.

    Args:
        path: The earlier run.
        given: Options of the new run. All others are taken from the earlier run.
        same_seed: Whether to take its seed, too.

    Raises:
        ConfigError: That is no longer possible, for example because a plugin is missing.
        RecordingError: The run is damaged, or its own files have been changed.
    """
    run = open_run(path)
    _check(run.path)
    options = Options.of(run.changes, realtime=given.realtime)
    options = replace(
        options,
        shots=options.shots if given.shots is None else given.shots,
        seed=run.seed if same_seed else None,
        output=given.output,
        note=given.note or f"rerun of {run.path.parent.name}/{run.path.name}",
        tags=given.tags,
    )
    assembly = assemble_recorded(files_of(run)._replace(calibrations=None), options)
    today, asked_for = record_today(run, assembly, options.changes()), {"seed", "shots"}
    changes = (change for change in changes_between(run, today) if change.what not in asked_for)
    return assembly, options, [f"changed since {run.path.name}: {change}" for change in changes]
