"""The shots of a run, and their lines in the index."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Container, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from labseq.errors import RecordingError
from labseq.recording import folders
from labseq.recording.doctor.findings import Damage, move_away, quarantined
from labseq.recording.doctor.lines import LineFile, read_line_file
from labseq.recording.run_file import NewerFormatError, index_row, is_index_row

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
    from labseq.recording.shot_reader import read_content, read_frames  # h5py takes 0.1 s to import

    try:
        data = path.read_bytes()
    except OSError as error:
        return _unreadable(path, error)
    try:
        content = read_content(path)
        read_frames(path)
    except NewerFormatError as error:
        return Damage("no line in the index", path, f"left: {_reason(error)}")
    except RecordingError as error:
        return quarantined(f"no line in the index, and {_reason(error).partition('; ')[0]}", path, run_dir)
    record, file = content.record, path.relative_to(run_dir).as_posix()
    counts = record.status == "complete"
    if content.run_id != run_id:
        return quarantined(f"a shot of another run, {content.run_id}", path, run_dir)
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
