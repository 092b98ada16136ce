"""`labseq doctor`: finds and repairs damage in recorded data."""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from labseq.errors import RecordingError
from labseq.files import LineLog, Lock, Process, explained, sync_folder, whole_lines, write_file
from labseq.plain import dumps, parse_object
from labseq.recording import folders
from labseq.recording.folders import Marker, markers_in
from labseq.recording.run_file import (
    STATUSES,
    OtherFormatError,
    encode_state,
    index_row,
    is_index_row,
    is_skip_row,
    read_run,
)

QUARANTINE: Final = "quarantine"
LOG_FILE: Final = "doctor.jsonl"


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is not as it should be.

    Attributes:
        what: What is wrong.
        where: The file or folder.
        done: What was done about it, or is to be done in a dry run; or why nothing can be done.
        left: Whether it stays as it is.
    """

    what: str
    where: Path
    done: str
    left: bool


@dataclass(slots=True)
class Report:
    """What was found.

    Attributes:
        findings: In the order they were found.
        n_runs: Runs that were looked at.
        n_shots: Shots of those that are whole.
        in_progress: Runs that were left alone because they go on, here or on another computer.
    """

    findings: list[Finding] = field(default_factory=list[Finding])
    n_runs: int = 0
    n_shots: int = 0
    in_progress: list[Path] = field(default_factory=list[Path])


@dataclass(frozen=True, slots=True)
class Damage:
    """Something that is wrong, and the remedy.

    Attributes:
        what: What is wrong.
        where: The file or folder.
        remedy: What the remedy does, in words; without one, what the user can do.
        mend: Does it; raises ``RecordingError`` where it cannot. None: nobody but the user can.
    """

    what: str
    where: Path
    remedy: str
    repair: Callable[[], None] | None = None

    def apply_repair(self, *, dry_run: bool) -> Finding:
        """Mend it, unless that is not possible or only asked for."""
        if self.repair is None:
            return Finding(self.what, self.where, self.remedy, left=True)
        if not dry_run:
            try:
                self.repair()
            except RecordingError as error:
                return Finding(self.what, self.where, f"not repaired: {error}", left=True)
        return Finding(self.what, self.where, self.remedy, left=dry_run)


def quarantined(what: str, path: Path, folder: Path) -> Damage:
    """A file or folder that is moved out of the way.

    Args:
        what: What is wrong with it.
        path: It.
        folder: Whose quarantine it comes to.
    """
    return Damage(what, path, f"moved to {QUARANTINE}", lambda: move_away(what, path, folder))


def move_away(what: str, path: Path, folder: Path) -> None:
    """Move a file or folder to a folder's quarantine, and note where it came from.

    Raises:
        RecordingError: It cannot be moved.
    """
    place = _quarantine_of(folder)
    goal = _free_name(place / path.name)
    note(folder, what, path, goal)
    with explained(path):
        path.rename(goal)
        sync_folder(path.parent)
        sync_folder(place)


def keep_lines(what: str, path: Path, lines: bytes) -> None:
    """Keep what is taken out of a file of lines, in the quarantine beside it.

    Raises:
        RecordingError: It cannot be written.
    """
    goal = _quarantine_of(path.parent) / path.name
    note(path.parent, what, path, goal)
    with explained(goal), goal.open("ab") as file:
        file.write(lines if lines.endswith(b"\n") else lines + b"\n")
    with explained(goal):
        sync_folder(goal.parent)


def note(folder: Path, what: str, path: Path, goal: Path) -> None:
    """Write down in a folder's quarantine what is about to be done.

    Raises:
        RecordingError: It cannot be written.
    """
    log = LineLog(_quarantine_of(folder) / LOG_FILE)
    t_utc = datetime.now(UTC).isoformat(timespec="seconds")
    log.append({"t_utc": t_utc, "what": what, "from": str(path), "to": str(goal)}, sync=True)


def _quarantine_of(folder: Path) -> Path:
    place = folder / QUARANTINE
    with explained(place):
        place.mkdir(exist_ok=True)
    return place


def _free_name(path: Path) -> Path:
    free, n = path, 1
    while free.exists() or free.is_symlink():
        n += 1
        free = path.with_name(f"{path.name}.{n}")
    return free


@dataclass(slots=True, eq=False)
class LineFile:
    """A file of JSON lines that is being mended: written anew once, when all is known.

    Attributes:
        path: The file.
        lines: What stays in it.
        removed: What is kept in quarantine instead.
        is_changed: Whether it differs from what is on the disk.
    """

    path: Path
    lines: list[bytes] = field(default_factory=list[bytes])
    removed: list[bytes] = field(default_factory=list[bytes])
    is_changed: bool = False

    def remove(self, line: bytes) -> None:
        """Take out the first such line."""
        self.lines.remove(line)
        self.removed.append(line)
        self.is_changed = True

    def add(self, row: dict[str, Any], *, first: bool) -> None:
        """Add a line, at the end or as the first one."""
        self.lines.insert(0 if first else len(self.lines), dumps(row).encode())
        self.is_changed = True

    def save(self) -> None:
        """Write it, if it has changed; the second time nothing happens.

        Raises:
            RecordingError: It cannot be written; it is as it was.
        """
        if not self.is_changed:
            return
        if self.removed:
            keep_lines("damaged or superfluous lines", self.path, b"\n".join(self.removed))
        write_file(self.path, b"".join(line + b"\n" for line in self.lines))
        self.removed, self.is_changed = [], False


def read_line_file(path: Path) -> tuple[LineFile, list[tuple[bytes, dict[str, Any]]], list[Damage]]:
    """Read a file of JSON lines.

    Returns:
        The file without what is torn or no JSON object, its lines with what they say, and what is wrong.

    Raises:
        RecordingError: It is there and cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        data = b""
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}; check the disk") from error
    whole = whole_lines(data)
    file = LineFile(path, whole.split(b"\n")[:-1])
    damage: list[Damage] = []
    if torn := data[len(whole) :]:
        file.removed.append(torn)
        file.is_changed = True
        damage.append(Damage("torn last line", path, "moved to quarantine", file.save))
    rows: list[tuple[bytes, dict[str, Any]]] = []
    for number, line in enumerate(list(file.lines), start=1):
        row = parse_object(line)
        if row is None:
            file.remove(line)
            damage.append(Damage(f"line {number} is damaged", path, "moved to quarantine", file.save))
        else:
            rows.append((line, row))
    return file, rows, damage


_NAME: Final = re.compile(r"shot_\d{6,}(\.attempt_\d+)?(\.take_(\d+))?\.h5")

Line = tuple[bytes, dict[str, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class ShotsCheck:
    """What came of comparing the index of a run with its files.

    Attributes:
        ailments: What is wrong.
        index: The index as it will be; saved when all ailments are treated.
        n_whole: Shots that are whole.
    """

    damage: list[Damage]
    index: LineFile
    n_whole: int


def check_shots(run_dir: Path, run_id: str) -> ShotsCheck:
    """Compare the index with the files.

    Args:
        run_dir: The run's folder.
        run_id: What its shots have as theirs.

    Raises:
        RecordingError: The index or the folder of the shots cannot be read.
    """
    index, lines, damage = read_line_file(run_dir / folders.INDEX_FILE)
    of_file: dict[str, list[Line]] = {}
    for line, row in lines:
        if _fits(row):
            of_file.setdefault(row["file"], []).append((line, row))
        else:
            index.remove(line)
            what = "a line of the index is no shot's"
            damage.append(Damage(what, index.path, "moved to quarantine", index.save))
    n_whole = 0
    for file, same in of_file.items():
        found = _check_file(run_dir / file, same, index)
        damage += found
        n_whole += not any(one.where == run_dir / file for one in found)
    n_lines = len(index.lines)
    counted = frozenset(row["shot"] for same in of_file.values() for _, row in same if row["counts"])
    for path in _without_line(run_dir, of_file):
        damage.append(_check_stray(run_dir, path, run_id, index, counted))
    return ShotsCheck(damage, index, n_whole + len(index.lines) - n_lines)


def _fits(row: Mapping[str, Any]) -> bool:
    """Whether a line of the index is whole, and names the file that its shot must have."""
    return is_index_row(row) and _is_name_of(row["file"], row["shot"], row["attempt"], counts=row["counts"])


def _is_name_of(file: str, shot_index: int, attempt: int, *, counts: bool) -> bool:
    match = _NAME.fullmatch(file.rpartition("/")[2])
    take = int(match[3] or 1) if match else 1
    return file == folders.shot_file_name(shot_index, attempt, counts=counts, take=take)


def _without_line(run_dir: Path, of_file: Mapping[str, object]) -> list[Path]:
    folder = run_dir / folders.SHOTS_FOLDER
    try:
        names = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise RecordingError(folder, f"cannot be read: {error.strerror}; check the disk") from error
    return [
        folder / name
        for name in names
        if _NAME.fullmatch(name) and f"{folders.SHOTS_FOLDER}/{name}" not in of_file
    ]


def _check_file(path: Path, lines: list[Line], index: LineFile) -> list[Damage]:
    """A file that has lines in the index: it must be there as it was written, and one line is enough."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        for line, _ in lines:
            index.remove(line)
        remedy = "its line moved to quarantine; if you find the file, put it back and run this again"
        return [Damage("the shot's file is missing", path, remedy, index.save)]
    except OSError as error:
        return [_unreadable(path, error)]
    sha256 = hashlib.sha256(data).hexdigest()
    good = [line for line, row in lines if row.get("sha256") == sha256]
    if not good:
        return [_changed(path, data, lines, index)]
    kept = max(i for i, (line, _) in enumerate(lines) if line == good[-1])
    damage: list[Damage] = []
    for i, (line, _) in enumerate(lines):
        if i != kept:
            index.remove(line)
            what = f"a second line for {path.name}"
            damage.append(Damage(what, index.path, "moved to quarantine", index.save))
    return damage


def _changed(path: Path, data: bytes, lines: list[Line], index: LineFile) -> Damage:
    n_bytes = lines[-1][1].get("bytes")
    what = "the checksum does not hold: a byte has changed since it was written"
    if not data:
        what = "the shot's file is empty"
    elif isinstance(n_bytes, int) and len(data) < n_bytes:
        what = f"the shot's file is cut off: {len(data)} of {n_bytes} bytes"

    def repair() -> None:
        move_away(what, path, path.parent.parent)
        for line, _ in lines:
            index.remove(line)

    return Damage(what, path, "moved to quarantine, with its line", repair)


def _check_stray(run_dir: Path, path: Path, run_id: str, index: LineFile, counted: Container[int]) -> Damage:
    """A file without a line: it gets one if it is a whole shot of this run.

    Of a shot that has another line, that goes on to count: the last one does.
    """
    from labseq.recording.shot_file import read_content, read_frames

    try:
        data = path.read_bytes()
    except OSError as error:
        return _unreadable(path, error)
    try:
        content = read_content(path)
        read_frames(path)
    except OtherFormatError as error:
        return Damage("no line in the index", path, f"left: {_reason(error)}")
    except RecordingError as error:
        return quarantined(f"no line in the index, and {_reason(error).partition('; ')[0]}", path, run_dir)
    record, file = content.record, path.relative_to(run_dir).as_posix()
    counts = record.status == "complete"
    if content.run_id != run_id:
        return quarantined(f"a shot of another run, {content.run['run_id']}", path, run_dir)
    if not _is_name_of(file, record.shot_index, record.attempt, counts=counts):
        return quarantined("a shot under a name that is not its own", path, run_dir)
    sha256 = hashlib.sha256(data).hexdigest()
    row = index_row(record, content.target, file=file, sha256=sha256, n_bytes=len(data))
    index.add(row, first=record.shot_index in counted)
    return Damage("no line in the index", path, "line added: the file is whole", index.save)


def _unreadable(path: Path, error: OSError) -> Damage:
    return Damage(f"cannot be read: {error.strerror}", path, "left: check its permissions and the disk")


def _reason(error: RecordingError) -> str:
    return str(error).removeprefix(f"{error.path}: ")


def repair_run(run_dir: Path, report: Report, *, dry_run: bool) -> None:
    """Look for damage in a run, and repair what can be repaired, unless it is in progress.

    It is looked at again when nobody else can go on with it.
    """
    if _goes_on(run_dir):
        report.in_progress.append(run_dir)
        return
    report.findings += [
        damaged_item.apply_repair(dry_run=dry_run) for damaged_item in holders_gone(run_dir)
    ]  # no lock keeps them
    checked = _Checked.of(run_dir)
    if checked.damage and not dry_run:
        lock = Lock(run_dir / folders.LOCK_FILE, "labseq doctor")
        try:
            held = lock.take() is not None
        except OSError:  # no locks here, or no right to write: that is told below
            held = False
        try:
            if held or _goes_on(run_dir):
                report.in_progress.append(run_dir)
                return
            checked = _Checked.of(run_dir)
            report.findings += [damaged_item.apply_repair(dry_run=False) for damaged_item in checked.damage]
            report.findings += checked.save()
        finally:
            lock.release()
    else:
        report.findings += [damaged_item.apply_repair(dry_run=True) for damaged_item in checked.damage]
    report.n_runs += 1
    report.n_shots += checked.n_whole


class _Checked:
    """What was found in a run.

    Attributes:
        ailments: What is wrong.
        files: Its files of lines as they will be.
        n_whole: Shots that are whole.
    """

    def __init__(self) -> None:
        self.damage: list[Damage] = []
        self.files: list[LineFile] = []
        self.n_whole = 0

    @classmethod
    def of(cls, run_dir: Path) -> _Checked:
        """Look at a run; what cannot be read is left."""
        checked = cls()
        try:
            checked._look(run_dir)
        except OSError as error:
            what = f"cannot be read: {str(error.strerror).lower()}"
            checked.damage.append(Damage(what, run_dir, "left: check its permissions and the disk"))
        except RecordingError as error:
            checked.damage.append(unreadable(error))
        return checked

    def _look(self, run_dir: Path) -> None:
        shots = run_dir / folders.SHOTS_FOLDER
        if not (run_dir / folders.RUN_FILE).exists():
            self.damage.append(_without_run_file(run_dir, shots))
            return
        record = read_run(run_dir)
        results = run_dir / folders.RESULTS_FOLDER
        self.damage += [
            quarantined("half-written", folder / name, run_dir)
            for folder in (run_dir, shots, results)
            for name in names_in(folder)
            if name.endswith(".part")
        ]
        if (run_dir / folders.STOP_FILE).exists():
            what = "a request to stop that nobody followed"
            self.damage.append(quarantined(what, run_dir / folders.STOP_FILE, run_dir))
        self.damage += _check_state(run_dir)
        found = check_shots(run_dir, str(record.get("run_id")))
        self.n_whole = found.n_whole
        self.damage += found.damage
        self.files.append(found.index)
        self._look_at_skipped(run_dir / folders.SKIPPED_FILE, record["n_shots"])
        logs = [results / name for name in names_in(results) if name.endswith(".jsonl")]
        for path in (run_dir / folders.EVENTS_FILE, *logs):
            file, _, damage = read_line_file(path)
            self.files.append(file)
            self.damage += damage

    def _look_at_skipped(self, path: Path, n_shots: int) -> None:
        file, lines, damage = read_line_file(path)
        self.files.append(file)
        self.damage += damage
        for line, row in lines:
            if not is_skip_row(row, n_shots):
                file.remove(line)
                what = "a line names no shots of this run, or no reason"
                self.damage.append(Damage(what, path, "moved to quarantine", file.save))

    def save(self) -> list[Finding]:
        """Write the files of lines that have changed; what cannot be written is told."""
        findings: list[Finding] = []
        for file in self.files:
            try:
                file.save()
            except RecordingError as error:
                findings.append(Finding("cannot be mended", file.path, f"not repaired: {error}", left=True))
        return findings


def _without_run_file(run_dir: Path, shots: Path) -> Damage:
    if any(name.endswith(".h5") for name in names_in(shots)):
        remedy = "left: take it from a backup, then run this again"
        return Damage(f"{folders.RUN_FILE} is missing", run_dir, remedy)
    what = "the run died while its folder was made; it holds no shots"
    return quarantined(what, run_dir, run_dir.parent)


def _check_state(run_dir: Path) -> list[Damage]:
    path = run_dir / folders.STATE_FILE
    state = _state(run_dir)
    if state.get("state") not in STATUSES:
        what = f"{folders.STATE_FILE} is {'damaged' if path.exists() else 'missing'}"

        def renew() -> None:
            if path.exists():
                move_away(what, path, run_dir)
            write_file(path, encode_state("failed", f"interrupted: {what}"))

        return [Damage(what, path, "marked as interrupted", renew)]
    if state["state"] != "running":
        return []

    def close() -> None:
        ended = {**state, "state": "failed", "error": "interrupted: the process that ran it is gone"}
        write_file(path, dumps(ended).encode() + b"\n")

    return [Damage("the run has no end, and its process is gone", path, "marked as interrupted", close)]


def _goes_on(run_dir: Path) -> bool:
    """Whether a process has it in progress, as far as anybody here can tell."""
    state = _state(run_dir)
    owner = Process.from_plain(state)
    return state.get("state") == "running" and owner is not None and (not owner.is_here or owner.is_running)


def _state(run_dir: Path) -> dict[str, Any]:
    try:
        return parse_object((run_dir / folders.STATE_FILE).read_bytes()) or {}
    except OSError:
        return {}


def holders_gone(folder: Path) -> Iterator[Damage]:
    """Notes on who holds a lock, left by processes of this computer that are gone."""
    try:
        names = names_in(folder)
    except RecordingError:
        return  # told by whoever looks for more than notes
    for name in names:
        if not name.endswith(".lock.holder"):
            continue
        try:
            owner = Process.from_plain(json.loads((folder / name).read_bytes()))
        except (OSError, ValueError, AttributeError):
            continue  # it is just being taken away, or half of it is written
        if owner is not None and owner.is_here and not owner.is_running:
            yield quarantined("a lock whose holder is gone", folder / name, folder)


def unreadable(error: RecordingError) -> Damage:
    """What cannot be read, which only the user can mend."""
    what, _, advice = str(error).removeprefix(f"{error.path}: ").partition("; ")
    return Damage(what, Path(error.path), f"left: {advice or what}")


def is_there(path: Path) -> bool:
    """Whether a file exists, or might: of one in a folder that cannot be looked into nobody knows."""
    try:
        return path.exists()
    except OSError:
        return True


def names_in(folder: Path) -> list[str]:
    """What is in a folder, in order; nothing where there is none.

    Raises:
        RecordingError: It cannot be read.
    """
    try:
        return sorted(entry.name for entry in folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise RecordingError(folder, f"cannot be read: {error.strerror}; check its permissions") from error


_RUN_NAME: Final = re.compile(r"\d{4,}_.*", re.DOTALL)
_CLAIM: Final = re.compile(r"\.\d{4,}\.claim")
_YOUNG_S: Final = 60.0
"""What is younger may belong to a run that is just being made."""


def examine(path: Path, *, dry_run: bool = False) -> Report:
    """Look for damage in a data folder or in one run, and repair what can be repaired.

    Runs in progress are left alone.

    Args:
        path: The data folder, a day of it, or a run's folder.
        dry_run: Whether to change nothing.

    Raises:
        RecordingError: The folder cannot be read.
    """
    root, report = path.absolute(), Report()
    markers = markers_in(root if not _is_run(root) else root.parent.parent)
    living = {marker.run_dir for marker in markers if marker.is_active}
    for run_dir in _runs(root, report):
        if run_dir.resolve() in living or _is_being_made(run_dir):
            report.in_progress.append(run_dir)
        else:
            repair_run(run_dir, report, dry_run=dry_run)
    if not _is_run(root):
        damage = [*map(_stale, (one for one in markers if not one.is_active)), *_check_leftovers(root)]
        report.findings += [damaged_item.apply_repair(dry_run=dry_run) for damaged_item in damage]
    return report


def _runs(root: Path, report: Report) -> Iterator[Path]:
    """The folders of runs: the path itself, those in it, or those in its days."""
    if _is_run(root):
        yield root
        return
    for name in names_in(root):
        folder = root / name
        if name == QUARANTINE or name.startswith(".") or not folder.is_dir():
            continue
        if _is_run(folder):
            yield folder
            continue
        try:
            yield from [folder / inner for inner in names_in(folder) if _is_run(folder / inner)]
        except RecordingError as error:
            report.findings.append(unreadable(error).apply_repair(dry_run=True))


def _is_run(folder: Path) -> bool:
    if folder.name == QUARANTINE or not folder.is_dir():
        return False
    own = (folders.RUN_FILE, folders.STATE_FILE, folders.INDEX_FILE, folders.SHOTS_FOLDER)
    return _RUN_NAME.fullmatch(folder.name) is not None or any(is_there(folder / name) for name in own)


def _is_being_made(run_dir: Path) -> bool:
    return not is_there(run_dir / folders.RUN_FILE) and _is_young(run_dir)


def _is_young(path: Path) -> bool:
    try:
        return abs(time.time() - path.stat().st_mtime) < _YOUNG_S
    except OSError:
        return False


def _check_leftovers(root: Path) -> Iterator[Damage]:
    """Claims on numbers, notes on locks, and half-written markers that nobody takes away any more."""
    for folder in (root, *(root / name for name in names_in(root) if not name.startswith("."))):
        names: list[str] = []
        with suppress(RecordingError):  # told by whoever looks for runs in it
            names = names_in(folder)
        for name in names:
            if _CLAIM.fullmatch(name) and not _is_young(folder / name):
                yield quarantined("a claim on a run's number that nobody gave back", folder / name, folder)
    active = root / ".active"
    yield from holders_gone(active)
    for name in names_in(active):
        if name.endswith(".part") and not _is_young(active / name):
            yield quarantined("half-written", active / name, active)


def _stale(marker: Marker) -> Damage:
    what = "a run died here without making its hardware safe"
    profile = marker.profile or "PROFILE"
    return Damage(what, marker.path, f"left: 'labseq safe {profile}', or the next run on it, makes it safe")
