"""`labseq resume`: a run that ended early, read back from its own folder so that it can go on."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, Self, cast

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import LineLog, Lock, explained, knows_no_locks
from labseq.guard import StopFlag
from labseq.messages import visible
from labseq.model import RunRecord
from labseq.plain import dumps
from labseq.recording import Run, RunWriter, open_run
from labseq.recording.folders import INDEX_FILE, LOCK_FILE, PROFILE_FILE, RUN_FILE, SEQUENCE_FILE, find_run
from labseq.recording.points import SCANNER
from labseq.recording.run_file import encode_run, read_owner, read_run, read_state
from labseq.session.assembly import Assembly, assemble
from labseq.session.options import Options
from labseq.session.profile import RecordedSetup
from labseq.session.provenance import now_utc, run_record
from labseq.session.recorded import stored_text
from labseq.session.scan_run import scan_run_of
from labseq.text_files import decode, read_bytes

_NOTHING: Final = "nothing"
_UNKNOWN: Final = "unknown"


class Change(NamedTuple):
    """One thing that differs.

    Attributes:
        what: What it is, for example an address.
        was: When the run was begun.
        now: Today.
    """

    what: str
    was: str
    now: str

    def __str__(self) -> str:
        return f"{self.what} was {self.was}, is {self.now}"


def changes_between(then: Mapping[str, Any], today: RunRecord) -> list[Change]:
    """What of the code, the plugins and the settings differs.

    Args:
        then: The run's run.json.
        today: The same run, put together today.
    """
    now = _plain(today)
    before, after = then["provenance"], now["provenance"]
    changes = _versions("labseq", before.get("labseq"), after.get("labseq"))
    changes += _code((before.get("git") or {}).get("code"), (after.get("git") or {}).get("code"))
    changes += _plugins(then["plugins"], now["plugins"], before.get("folder"))
    changes += _values("the calibrations in use", then.get("calibrations", {}), now["calibrations"])
    return changes + differences(then, today, "resolved")


def differences(then: Mapping[str, Any], today: RunRecord, name: str) -> list[Change]:
    """What differs in one field of run.json, address by address."""
    before, after = dict(_leaves(then.get(name, {}), "")), dict(_leaves(_plain(today)[name], ""))
    folder = then["provenance"].get("folder")
    return [
        Change(address or name, _shown(before, address), _shown(after, address))
        for address in dict.fromkeys([*before, *after])
        if not _same(before.get(address, _NOTHING), after.get(address, _NOTHING), folder)
    ]


def _plain(record: RunRecord) -> dict[str, Any]:
    return json.loads(encode_run(record, ""))


def _versions(what: str, was: Any, now: Any) -> list[Change]:
    return [] if was == now else [Change(what, str(was), str(now))]


def _code(was: Mapping[str, Any] | None, now: Mapping[str, Any] | None) -> list[Change]:
    """What git knows of labseq's own code: the commit, and what of it was not committed."""
    if was is None or now is None:
        return _values("labseq's commit", was and was.get("commit"), now and now.get("commit"))
    if was.get("commit") != now.get("commit"):
        return [Change("labseq's commit", str(was.get("commit"))[:12], str(now.get("commit"))[:12])]
    before, after = _uncommitted(was), _uncommitted(now)
    if before == after != _UNKNOWN:
        return []
    what = "labseq's code without a commit"
    return [Change(what, _code_text(before), _code_text(after))]


def _uncommitted(state: Mapping[str, Any]) -> str:
    """What stands for changes of the code that are not committed; "" for none."""
    if not state.get("dirty"):
        return ""
    return str(state.get("code_sha256", _UNKNOWN))


def _code_text(uncommitted: str) -> str:
    if uncommitted == _UNKNOWN:
        return "something that nobody can compare"
    return f"changed in a way known as {uncommitted[:12]}" if uncommitted else "as committed"


def _plugins(was: Any, now: Any, folder: Any) -> list[Change]:
    before, after = ({one["name"]: one for one in plugins} for plugins in (was, now))
    changes: list[Change] = []
    for name in dict.fromkeys([*before, *after]):
        old, new = before.get(name, {}), after.get(name, {})
        for key in ("origin", "version"):
            if not _same(old.get(key, _NOTHING), new.get(key, _NOTHING), folder):
                told = [str(one.get(key, _NOTHING)) or _NOTHING for one in (old, new)]
                changes.append(Change(f"plugin {name}: {key}", *told))
    return changes


def _values(what: str, was: Any, now: Any) -> list[Change]:
    return [] if was == now else [Change(what, dumps(was), dumps(now))]


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


def _shown(values: Mapping[str, Any], address: str) -> str:
    if address not in values:
        return _NOTHING
    text = dumps(values[address])
    return text if len(text) <= 60 else f"{text[:57]}..."


def _same(was: Any, now: Any, folder: Any) -> bool:
    """Whether two values are the same; paths count from the working folder of then."""
    if was == now:
        return True
    if not (isinstance(was, str) and isinstance(now, str) and isinstance(folder, str)):
        return False
    return os.path.normpath(Path(folder) / was) == os.path.normpath(Path.cwd() / now)


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
    """A run on disk that is to go on; nobody else can go on with it until it is released.

    Attributes:
        run: As it was when it was opened.
        done: Shots that are on disk, or were skipped.
        changes: What differs from then, and was accepted.
        warnings: What the user should know although it is no error.
    """

    run: Run
    done: frozenset[int]
    changes: tuple[Change, ...]
    warnings: list[str]
    _lock: Lock

    @classmethod
    def open(cls, path: Path) -> Self:
        """Take a run over.

        Args:
            path: The run's folder or any file in it.

        Raises:
            ConfigError: It is complete, or in progress, or somebody else goes on with it.
            RecordingError: It is no run, is damaged, of a newer labseq, or cannot be written to.
        """
        folder = find_run(path)
        _check(folder)  # what is no run of ours is not touched
        lock, warnings = Lock(folder / LOCK_FILE, "labseq resume"), list[str]()
        try:
            with explained(folder):
                holder = lock.take()
        except RecordingError as error:
            if not (isinstance(error.__cause__, OSError) and knows_no_locks(error.__cause__)):
                raise
            holder = None
            warnings.append(
                f"{folder} knows no locks: nothing keeps others from going on with the run as well"
            )
        if holder is not None:
            raise _refused(folder, f"somebody goes on with it already: {holder}")
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
            changes.append(Change("its computer, where it may still be in progress", owner.host, "this one"))
        LineLog(folder / INDEX_FILE)  # ends a torn last line: if that is whole, its shot counts
        run = open_run(folder)
        gone = [shot.index for shot in run.shots if not shot.file.is_file()]
        done = frozenset(shot.index for shot in run.shots).difference(gone).union(run.skipped)
        ended = SCANNER in (run.record.get("scan") or {}) and not gone  # by the scanner, before its last shot
        if run.status == "complete" and (ended or len(done) >= run.n_shots):
            raise _refused(folder, "it is complete: no shot is missing")
        if gone:
            warnings.append(f"files of shots are gone, and these shots are taken again: {_numbers(gone)}")
        return cls(run, done, tuple(changes), warnings, lock)

    @property
    def rows(self) -> list[Mapping[str, Any]]:
        """The lines of the index of the shots that are on disk, in order."""
        return [shot.row for shot in self.run.shots if shot.index in self.done]

    @property
    def root(self) -> Path:
        """The data root that the run lies in; of a run that was put elsewhere, the folder that it is in."""
        day = self.run.path.parent
        return day.parent if _DAY.fullmatch(day.name) else day

    def release(self) -> None:
        """Let others go on with the run; legal at any time."""
        self._lock.release()

    def assemble(self, *, realtime: bool) -> tuple[Assembly, Options]:
        """Put the run together of its own files, calibrations and options.

        Raises:
            ConfigError: That cannot be done today: a calibration is missing, a plugin, ...
            RecordingError: The run's own files have been changed.
        """
        record, options = self.run.record, Options.of(self.run.record["overrides"], realtime=realtime)
        sequence, profile = Path(record["sequence_path"]), Path(record["profile_path"])
        kept = {
            "sequence": stored_text(self.run.path / SEQUENCE_FILE, record["sequence_sha256"]),
            "profile": stored_text(self.run.path / PROFILE_FILE, record["profile_sha256"]),
        }
        assembly = assemble(
            sequence,
            profile=profile,
            overrides=options.overrides,
            given=options.own(),
            dry_run=options.dry_run,
            kept=kept["sequence"],
            again=RecordedSetup(kept["profile"], record.get("calibrations", {})),
        )
        for path, own in ((sequence, kept["sequence"]), (profile, kept["profile"])):
            if _says_otherwise(path, own.text):
                self.warnings.append(f"{path} has been changed since; the run goes on with what it said then")
        return assembly, options

    def compare(self, assembly: Assembly, options: Options, *, accept: bool) -> None:
        """Find out what differs from then.

        Args:
            assembly: The run, put together today.
            options: Its options.
            accept: Whether differences are accepted.

        Raises:
            ConfigError: Something differs and is not accepted; or the shots themselves would be others.
        """
        record, folder = self.run.record, self.run.path
        scan_run = scan_run_of(assembly, self.run.seed, StopFlag())
        today = run_record(assembly, self.run.seed, options.changes(), scan_run.record(), Path.cwd())
        for what in ("n_shots", "scan", "target"):
            if found := differences(record, today, what):
                raise _refused(folder, f"its shots would be others today: {found[0]}")
        self.changes += tuple(changes_between(record, today))
        if self.changes and not accept:
            problems = [Problem(str(change), str(folder)) for change in self.changes]
            what = "this has changed since the run was begun"
            hint = "'labseq resume --accept-changes' goes on all the same, and records it"
            raise ConfigError([*problems, Problem(what, str(folder), hint=hint)])

    def reopen(self, record: RunRecord, first_shot: int | None) -> RunWriter:
        """Open its folder for writing.

        Args:
            record: What is known of the run now.
            first_shot: The first shot that is taken; None if none is.

        Raises:
            RecordingError: The folder cannot be written to, or the disk is full.
        """
        resumed = tuple(self.run.record.get("resumed") or ())
        if first_shot is not None:
            entry = {"t_utc": now_utc(), "first_shot": first_shot}
            changes = [change._asdict() for change in self.changes]
            resumed += ({**entry, "changes": changes, "provenance": record.provenance},)
        then = str(self.run.record["t_start_utc"])
        record = replace(record, t_start_utc=then, resumed=resumed)
        return RunWriter.reopen(self.run.path, record, n_written=len(self.rows))


def _refused(folder: Path, why: str) -> ConfigError:
    return ConfigError(Problem(f"the run cannot be resumed: {why}", str(folder)))


def _check(folder: Path) -> None:
    """Refuse a run of which too little is known.

    Raises:
        RecordingError: run.json is damaged, or of a newer labseq.
    """
    record = read_run(folder)
    wrong = [name for name, kind in _NEEDED.items() if not isinstance(record.get(name), kind)]
    if wrong:
        what = f"is damaged: it has no valid '{wrong[0]}'; take it from a backup"
        raise RecordingError(folder / RUN_FILE, what)


def _says_otherwise(path: Path, text: str) -> bool:
    """Whether a file can be read, and says something else."""
    try:
        return decode(read_bytes(path), visible(str(path))) != text
    except ConfigError:
        return False


def _numbers(shots: list[int]) -> str:
    told = ", ".join(str(shot) for shot in shots[:5])
    return told if len(shots) <= 5 else f"{told}, ... ({len(shots)} in all)"


def reopened(path: Path, *, accept_changes: bool, realtime: bool) -> tuple[Assembly, Options, ResumableRun]:
    """Read a run back so that it can go on.

    Args:
        path: The run's folder or any file in it.
        accept_changes: Whether to go on although something differs from then.
        realtime: Let virtual time take as long as it says.

    Raises:
        ConfigError: The run cannot be resumed, or something differs from then.
        RecordingError: It is no run, is damaged, of a newer labseq, or cannot be written to.
    """
    earlier = ResumableRun.open(path)
    try:
        assembly, options = earlier.assemble(realtime=realtime)
        earlier.compare(assembly, options, accept=accept_changes)
    except BaseException:
        earlier.release()
        raise
    return assembly, options, earlier
