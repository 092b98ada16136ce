"""`labseq resume`: a run that ended early is read back from its own folder and continued."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, Self, cast

from labseq.assembly.assemble import Assembly, assemble_recorded
from labseq.assembly.options import Options
from labseq.assembly.recorded import files_of
from labseq.data import Run, open_run
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import LineLog, explained
from labseq.guard import StopFlag
from labseq.messages import visible
from labseq.model import RunRecord
from labseq.plain import dumps, now_utc
from labseq.processes import Lock, knows_no_locks
from labseq.recording import RunWriter
from labseq.recording.folders import INDEX_FILE, LOCK_FILE, RUN_FILE, find_run
from labseq.recording.index import IndexRow
from labseq.recording.run_file import SCANNER, encode_run, read_owner, read_run, read_state, read_state_file
from labseq.session.provenance import run_record
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
    """A run on disk that is being resumed; no other process can resume it until it is released.

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
    def open(cls, path: Path) -> Self:
        """Open a run for resuming, and lock it.

        Raises:
            ConfigError: It is complete or in progress, or another process resumes it.
            RecordingError: It is not a run, is damaged, has another format, or cannot be written to.
        """
        folder = find_run(path)
        _check(folder)  # before anything is written there
        lock, warnings = Lock(folder / LOCK_FILE, "labseq resume"), list[str]()
        try:
            with explained(folder):
                holder = lock.take()
        except RecordingError as error:
            if not (isinstance(error.__cause__, OSError) and knows_no_locks(error.__cause__)):
                raise
            holder = None
            warnings.append(
                f"{folder} does not support file locks: another process could resume the run at the same time"
            )
        if holder is not None:
            raise _refused(folder, f"another process is already resuming it: {holder}")
        try:
            return cls._read(folder, lock, warnings)
        except BaseException:
            lock.release()
            raise

    @classmethod
    def _read(cls, folder: Path, lock: Lock, warnings: list[str]) -> Self:
        owner, changes = read_owner(folder), list[Change]()
        if read_state(folder)[0] == "running" and owner is not None:
            if owner.is_here:
                raise _refused(folder, f"it is in progress (process {owner.pid} on {owner.host})")
            changes.append(
                Change("the computer", owner.host, "this one; the run may still be in progress there")
            )
        LineLog(folder / INDEX_FILE)  # ends an unfinished last line: if it is whole, its shot counts
        run = open_run(folder)
        gone = [shot.index for shot in run.shots if not shot.file.is_file()]
        if (over := is_over(run)) and not gone:
            raise _refused(folder, over)
        done = frozenset(shot.index for shot in run.shots).difference(gone).union(run.skipped)
        if gone:
            warnings.append(
                f"the files of these shots are gone, and the shots are taken again: {_numbers(gone)}"
            )
        return cls(run, done, tuple(changes), warnings, lock)

    @property
    def rows(self) -> list[IndexRow]:
        """The shots that are on disk, in order."""
        return [shot.row for shot in self.run.shots if shot.index in self.done]

    @property
    def root(self) -> Path:
        """The data root of the run; of a run that was moved elsewhere, the folder that it is in."""
        day = self.run.path.parent
        return day.parent if _DAY.fullmatch(day.name) else day

    def release(self) -> None:
        """Let other processes resume the run; legal at any time."""
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
                    f"{path} has been changed since; the run continues with its earlier content"
                )
        return assembly, options

    def compare(self, assembly: Assembly, options: Options, *, accept: bool) -> None:
        """Compare the run as it began with the run as it would continue today.

        Raises:
            ConfigError: A change is not accepted, or the remaining shots would be different ones.
        """
        record, folder = self.run.record, self.run.path
        today = run_record(assembly, self.run.seed, options.changes(), Path.cwd())
        for what in ("n_shots", "scan", "target"):
            if found := differences(record, today, what):
                raise _refused(folder, f"its shots would differ today: {found[0]}")
        self.changes += tuple(changes_between(record, today))
        if self.changes and not accept:
            problems = [Problem(str(change), str(folder)) for change in self.changes]
            what = "this has changed since the run was begun"
            hint = "'labseq resume --accept-changes' continues anyway, and records the changes"
            raise ConfigError([*problems, Problem(what, str(folder), hint=hint)])

    def reopen(self, record: RunRecord, first_shot: int | None, stop: StopFlag) -> RunWriter:
        """Open its folder for writing.

        Args:
            record: The current record of the run.
            first_shot: The first shot that is taken; None if none is.
            stop: The request to stop the run.

        Raises:
            RecordingError: The folder cannot be written to, or the disk is full.
        """
        resumed = tuple(self.run.record.get("resumed") or ())
        if first_shot is not None:
            before = ": ".join(filter(None, [self.run.status, self.run.error]))
            entry = {"t_utc": now_utc(), "first_shot": first_shot, "before": before}
            changes = [change._asdict() for change in self.changes]
            resumed += ({**entry, "changes": changes, "provenance": record.provenance},)
        then = str(self.run.record["t_start_utc"])
        record = replace(record, t_start_utc=then, resumed=resumed)
        return RunWriter.reopen(self.run.path, record, n_written=len(self.rows), stop=stop)


def is_over(run: Run) -> str:
    """Why there is nothing left to do in a run; "" if it can be resumed."""
    # of a run that has failed after its last shot, resuming it would hide the reason; one whose process is
    # gone, or that was stopped, has yet to be ended
    failed = read_state_file(run.path).get("state") == "failed"
    # a scanner, or `stop_when`, may end a run before all shots are taken
    is_scanner = SCANNER in (run.record.get("scan") or {})
    ended = run.status == "complete" and (is_scanner or bool(run.ended_early))
    if not ended and len({*run.skipped, *(shot.index for shot in run.shots)}) < run.n_shots:
        return ""
    if failed:
        return f"no shot is missing, and its end stays on record: {run.error}"
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


def reopened(path: Path, *, accept_changes: bool, realtime: bool) -> tuple[Assembly, Options, ResumableRun]:
    """Read a run back so that it can be continued.

    Raises:
        ConfigError: The run cannot be resumed, or something has changed.
        RecordingError: It is not a run, is damaged, has another format, or cannot be written to.
    """
    earlier = ResumableRun.open(path)
    try:
        assembly, options = earlier.assemble(realtime=realtime)
        earlier.compare(assembly, options, accept=accept_changes)
    except BaseException:
        earlier.release()
        raise
    return assembly, options, earlier


_MAX_TEXT: Final = 60


class Change(NamedTuple):
    """A difference between the run at its start and today.

    Attributes:
        what: The changed item, for example an address.
        was: Its value when the run was begun.
        now: Its value today.
    """

    what: str
    was: str
    now: str

    def __str__(self) -> str:
        return f"{self.what} was {self.was}, is {self.now}"


def changes_between(then: Mapping[str, Any], today: RunRecord) -> list[Change]:
    """The changes in code, plugins, calibrations and settings between two records of a run."""
    folder, now = then["provenance"].get("folder"), plain_record(today)
    return [
        *_differences(_made_with(then), _made_with(now), folder),
        *differences(then, today, "resolved"),
    ]


def differences(then: Mapping[str, Any], today: RunRecord, name: str) -> list[Change]:
    """The changes in one value of run.json, address by address."""
    before, after = (
        {address or name: value for address, value in _leaves(record.get(name, {}), "")}
        for record in (then, plain_record(today))
    )
    return _differences(before, after, then["provenance"].get("folder"))


def plain_record(record: RunRecord) -> dict[str, Any]:
    """A run's record as it is in run.json."""
    return json.loads(encode_run(record, ""))


def _made_with(record: Mapping[str, Any]) -> dict[str, Any]:
    """Versions, code state, plugins and calibrations of a run: name -> value."""
    provenance = record["provenance"]
    code = (provenance.get("git") or {}).get("code") or {}
    found = {"labseq": provenance.get("labseq"), "labseq's commit": code.get("commit")}
    if code.get("code_sha256"):
        found["labseq's uncommitted code"] = f"changes with the SHA-256 {code['code_sha256'][:12]}"
    for plugin in record["plugins"]:
        found |= {f"plugin {plugin['name']}: {key}": plugin[key] for key in ("origin", "version")}
    calibrations = record.get("calibrations") or {}
    return found | {f"the calibration in use of {kind}": entry for kind, entry in calibrations.items()}


def _differences(before: Mapping[str, Any], after: Mapping[str, Any], folder: Any) -> list[Change]:
    return [
        Change(name, _shown(before, name), _shown(after, name))
        for name in dict.fromkeys([*before, *after])
        if (name in before) != (name in after) or not _same(before[name], after[name], folder)
    ]


def _leaves(value: Any, address: str) -> Iterator[tuple[str, Any]]:
    """Each value of a tree of mappings and lists of mappings, with its address."""
    items: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        items = list(cast("dict[str, Any]", value).items())
    elif isinstance(value, list) and any(isinstance(one, dict) for one in cast("list[Any]", value)):
        items = list(enumerate(cast("list[Any]", value)))
    if not items:
        yield address, value
    for key, one in items:
        yield from _leaves(one, f"{address}.{key}" if address else str(key))


def _shown(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "nothing"
    text = values[name] if isinstance(values[name], str) else dumps(values[name])
    return text if len(text) <= _MAX_TEXT else f"{text[: _MAX_TEXT - 3]}..."


def _same(was: Any, now: Any, folder: Any) -> bool:
    """Whether two values are the same; each path is relative to the working folder of its record."""
    if was == now:
        return True
    if not (isinstance(was, str) and isinstance(now, str) and isinstance(folder, str)):
        return False
    return os.path.normpath(Path(folder) / was) == os.path.normpath(Path.cwd() / now)
