"""`labseq doctor`: finds and repairs damage in recorded data.

Nothing is deleted. Files that do not belong are moved to the folder ``quarantine`` of their run, where
``doctor.jsonl`` records when, why and from where.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from labseq.errors import RecordingError
from labseq.files import (
    LineLog,
    check_ordinary,
    explained,
    lines_in,
    make_folder,
    sync_folder,
    write_file,
)
from labseq.model.image_quantities import measured_in
from labseq.plain import dumps, now_utc, parse_object
from labseq.processes import Lock, Process
from labseq.recording import folders
from labseq.recording.index import SHOT_FILE, IndexRow, digest_of, row_of_line, row_of_record
from labseq.recording.markers import Marker, markers
from labseq.recording.run_file import (
    STATUSES,
    OtherFormatError,
    encode_state,
    is_skip_row,
    read_run,
    read_state_file,
)

QUARANTINE: Final = "quarantine"
_TO_QUARANTINE: Final = "moved to quarantine"
_CHECK_PERMISSIONS: Final = "left: check its permissions and the disk"
_MAX_FINDINGS: Final = 100
"""Maximum number of damaged lines of a file that are reported one by one."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A defect, and what was done about it.

    Attributes:
        what: The defect.
        where: The damaged file or folder.
        done: The repair, or the intended repair in a dry run, or why it cannot be repaired.
        left: Whether the defect remains.
    """

    what: str
    where: Path
    done: str
    left: bool


@dataclass(slots=True)
class Report:
    """The result of looking for damage.

    Attributes:
        findings: Defects in the order in which they were found.
        n_runs: Number of runs that were checked.
        n_shots: Number of their intact shots.
        in_progress: Runs that were skipped because they are in progress, here or on another computer.
        n_in_use: Number of intact shots that another program has open for writing.
    """

    findings: list[Finding] = field(default_factory=list[Finding])
    n_runs: int = 0
    n_shots: int = 0
    in_progress: list[Path] = field(default_factory=list[Path])
    n_in_use: int = 0


def examine(path: Path, *, dry_run: bool = False) -> Report:
    """Look for damage in a data folder or in one run, and repair what can be repaired.

    Runs in progress are skipped.

    Args:
        path: The data folder, the folder of a day, or a run's folder.
        dry_run: True to change nothing.

    Raises:
        RecordingError: The folder cannot be read.
    """
    root, report = path.absolute(), Report()
    all_markers = markers()
    active = {marker.run_dir for marker in all_markers if marker.is_active}
    for run_dir in _runs(root, report):
        # run.json is written last when a folder is created
        is_being_made = not _may_exist(run_dir / folders.RUN_FILE) and _is_young(run_dir)
        if run_dir.resolve() in active or is_being_made:
            report.in_progress.append(run_dir)
        else:
            _examine_run(run_dir, report, dry_run=dry_run)
    if not _is_run(root):
        check = _Check(root, dry_run=dry_run)
        check.check_data_folder([marker for marker in all_markers if not marker.is_active])
        report.findings += check.findings
    return report


def _examine_run(run_dir: Path, report: Report, *, dry_run: bool) -> None:
    """Check a run and repair it under its lock, so that no process resumes it meanwhile."""
    if _is_in_progress(run_dir):
        report.in_progress.append(run_dir)
        return
    check = _Check(run_dir, dry_run=True)  # an intact run needs no lock, and may be in a read-only folder
    check.check_run()
    if check.findings and not dry_run:
        lock = Lock(run_dir / folders.LOCK_FILE, "labseq doctor")
        try:
            is_locked = False
            with suppress(OSError):  # the repairs report a folder without locks or permission to write
                is_locked = lock.take() is not None
            if is_locked or _is_in_progress(run_dir):
                report.in_progress.append(run_dir)
                return
            check = _Check(run_dir, dry_run=False)  # again, as it may have changed before it was locked
            check.check_run()
        finally:
            lock.release()
    report.findings += check.findings
    report.n_runs += 1
    report.n_shots += check.n_whole
    report.n_in_use += check.n_in_use


def _is_in_progress(run_dir: Path) -> bool:
    """Whether a process works on a run. For a run on another computer, its folder tells."""
    state = read_state_file(run_dir)
    process = Process.from_plain(state)
    is_gone = process is None or (process.is_here and not process.is_running)
    return state.get("state") == "running" and not is_gone


class _LineFile:
    """A file of JSON lines, read for repair and written once all changes are known.

    Attributes:
        path: The file.
        rows: Number of a line, from 0 -> its JSON object. Other lines are removed.
        added: Lines that are added at the end.
        problems: Each problem, its place, and its repair when the file is saved.

    Raises:
        RecordingError: The file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[int, dict[str, Any]] = {}
        self.added: list[bytes] = []
        self.problems: list[tuple[str, Path, str]] = []
        self._lines = list(lines_in(path)) if path.exists() else []
        self._removed: set[int] = set()
        damaged: list[int] = []
        for number, line in enumerate(self._lines):
            row = parse_object(line)
            if not line.endswith(b"\n"):
                self.remove([number], "torn last line")
            elif row is None:
                damaged.append(number)
            else:
                self.rows[number] = row
        if len(damaged) > _MAX_FINDINGS:
            self.remove(damaged, f"{len(damaged)} lines are damaged, from line {damaged[0] + 1} on")
        else:
            for number in damaged:
                self.remove([number], f"line {number + 1} is damaged")

    def remove(self, numbers: Collection[int], what: str = "") -> None:
        """Remove lines. ``what`` is the reason, or "" if another finding reports it."""
        self._removed.update(numbers)
        if what:
            n_findings = len(numbers) if len(numbers) <= _MAX_FINDINGS else 1
            self.problems += [(what, self.path, _TO_QUARANTINE)] * n_findings

    def save(self) -> None:
        """Write the file if it changes.

        Raises:
            RecordingError: The file cannot be written. The old file is unchanged.
        """
        if self._removed:
            # to the quarantine first: if this is interrupted, a line is in both files, and none is lost
            goal = _quarantine_of(self.path.parent) / self.path.name
            _log_move(self.path.parent, "damaged or superfluous lines", self.path, goal)
            with explained(goal):
                goal.touch()
                check_ordinary(goal)
                with goal.open("ab") as file:
                    file.writelines(self._lines[n].rstrip(b"\n") + b"\n" for n in sorted(self._removed))
                sync_folder(goal.parent)
        if self._removed or self.added:
            kept = [line for number, line in enumerate(self._lines) if number not in self._removed]
            write_file(self.path, b"".join([*kept, *(line + b"\n" for line in self.added)]))


class _Check:
    """Checks one folder, and repairs it at once unless it is a dry run.

    Attributes:
        folder: The folder. Files that do not belong are moved to its quarantine.
        findings: Defects in the order in which they were found.
        n_whole: Number of intact shots.
        n_in_use: Number of intact shots that another program has open for writing.
    """

    def __init__(self, folder: Path, *, dry_run: bool) -> None:
        self.folder = folder
        self.findings: list[Finding] = []
        self.n_whole = 0
        self.n_in_use = 0
        self._dry_run = dry_run

    def check_run(self) -> None:
        """Check everything in a run's folder. An unreadable part is left unchanged."""
        shots, results = self.folder / folders.SHOTS_FOLDER, self.folder / folders.RESULTS_FOLDER
        try:
            if not (self.folder / folders.RUN_FILE).exists():
                self._report_missing_run_file(shots)
                return
            record = read_run(self.folder)
            for folder in (self.folder, shots, results):
                for name in names_in(folder):
                    if name.endswith(".part"):
                        self._quarantine("half-written", folder / name)
            if (stop := self.folder / folders.STOP_FILE).exists():
                self._quarantine("a stop request that no run acted on", stop)
            self._check_state()
            self._check_shots(shots, str(record.get("run_id")))
            skipped = _LineFile(self.folder / folders.SKIPPED_FILE)
            wrong = [
                number for number, row in skipped.rows.items() if not is_skip_row(row, record["n_shots"])
            ]
            skipped.remove(wrong, "a line names no shots of this run, or no reason")
            logs = [results / name for name in names_in(results) if name.endswith(".jsonl")]
            for lines in (skipped, *map(_LineFile, (self.folder / folders.EVENTS_FILE, *logs))):
                self._save(lines)
        except OSError as error:
            self._add(f"cannot be read: {str(error.strerror).lower()}", self.folder, _CHECK_PERMISSIONS)
        except RecordingError as error:
            self.report_unreadable(error)

    def check_data_folder(self, stale: list[Marker]) -> None:
        """Check for leftovers in a data folder next to its runs."""
        for marker in stale:
            # a run in another folder, often of another user, says nothing about this one
            if marker.run_dir is None or not marker.run_dir.is_relative_to(self.folder.resolve()):
                continue
            advice = f"'labseq safe {marker.profile or 'PROFILE'}', or the next run on it, makes it safe"
            self._add("a run died without making its hardware safe", marker.run_dir, f"left: {advice}")
        days = [self.folder / name for name in names_in(self.folder) if not name.startswith(".")]
        for folder in (self.folder, *days):
            with suppress(RecordingError):  # reported where its runs are looked for
                for name in names_in(folder):
                    if re.fullmatch(r"\.\d{4,}\.claim", name) and not _is_young(folder / name):
                        self._quarantine("a leftover reservation of a run's number", folder / name, folder)

    def report_unreadable(self, error: RecordingError) -> None:
        """Report unreadable files and folders, which only the user can repair."""
        self._add(error.what, Path(error.path), f"left: {error.advice or error.what}")

    def _report_missing_run_file(self, shots: Path) -> None:
        if any(name.endswith(".h5") for name in names_in(shots)):
            remedy = "left as it is: restore it from a backup, then run this again"
            self._add(f"{folders.RUN_FILE} is missing", self.folder, remedy)
        else:
            what = "the run died while its folder was created and holds no shots"
            self._quarantine(what, self.folder, self.folder.parent)

    def _check_state(self) -> None:
        path, state = self.folder / folders.STATE_FILE, read_state_file(self.folder)
        if state.get("state") not in STATUSES:
            what = f"{folders.STATE_FILE} is {'damaged' if path.exists() else 'missing'}"

            def replace() -> None:
                if path.exists():
                    _move_away(what, path, self.folder)
                write_file(path, encode_state("failed", f"interrupted: {what}"))

            self._add(what, path, "marked as interrupted", replace)
        elif state["state"] == "running":
            ended = {**state, "state": "failed", "error": "interrupted: the process that ran it is gone"}
            what = "the run did not end, and its process is gone"
            data = dumps(ended).encode() + b"\n"
            self._add(what, path, "marked as interrupted", lambda: write_file(path, data))

    def _check_shots(self, folder: Path, run_id: str) -> None:
        """Compare the index with the files of the shots."""
        index = _LineFile(self.folder / folders.INDEX_FILE)
        rows, of_file = dict[int, IndexRow](), dict[str, list[int]]()
        for number, values in index.rows.items():
            row = row_of_line(values)
            if row is not None and _is_name(row):
                rows[number] = row
                of_file.setdefault(row.file, []).append(number)
        index.remove([*index.rows.keys() - rows.keys()], "a line of the index describes no shot")
        whole = {
            file for file, same in of_file.items() if self._check_file({n: rows[n] for n in same}, index)
        }
        self.n_whole += len(whole)
        intact = sorted(number for file in whole for number in of_file[file])
        # the last line of a shot that was written twice counts
        file_of = {rows[number].shot: rows[number].file for number in intact if rows[number].counts}
        # later takes first, because an earlier take of a shot must not get the line
        for name in sorted(names_in(folder), key=lambda name: (len(name), name), reverse=True):
            if SHOT_FILE.fullmatch(file := f"{folder.name}/{name}") and file not in of_file:
                self._check_stray(folder / name, run_id, file_of, index)
        self._save(index)

    def _check_stray(self, path: Path, run_id: str, file_of: dict[int, str], index: _LineFile) -> None:
        """Add a line for a shot's file without one, unless the shot was taken again.

        Args:
            path: The file. Later takes of a shot come before earlier ones.
            file_of: Shot -> the file that counts. The shot is added.
        """
        row = self._row_of_stray(path, run_id)
        if row is None:
            return
        if row.counts and (later := file_of.setdefault(row.shot, row.file)) != row.file:
            what = f"an earlier take of shot {row.shot}, taken again as {Path(later).name}"
            self._quarantine(what, path)
            return
        index.added.append(dumps(row).encode())
        index.problems.append(("no line in the index", path, "line added: the file is intact"))
        self.n_whole += 1

    def _check_file(self, rows: dict[int, IndexRow], index: _LineFile) -> bool:
        """Whether the file of a shot exists unchanged. Superfluous lines of the index for it are removed.

        Args:
            rows: The lines for the file, by line number.
        """
        numbers, last = [*rows], [*rows.values()][-1]
        path = self.folder / last.file
        try:
            n_bytes, sha256, is_marked = digest_of(path, max(row.bytes for row in rows.values()))
        except FileNotFoundError:
            index.remove(numbers)
            remedy = "its line moved to quarantine; if you find the file, put it back and run this again"
            index.problems.append(("the shot's file is missing", path, remedy))
            return False
        except OSError as error:
            self._add(f"cannot be read: {error.strerror}", path, _CHECK_PERMISSIONS)
            return False
        good = [number for number, row in rows.items() if row.sha256 == sha256]
        if is_marked and (good or _is_locked(path)):
            if good:
                self.n_in_use += 1
            else:
                what = "another program has it open for writing and has changed it"
                self.findings.append(
                    Finding(what, path, "left: close it there, then run this again", left=True)
                )
        elif not good:
            what = "the checksum does not match: the file has changed since it was written"
            if n_bytes < last.bytes:
                what = f"the shot's file is cut off: {n_bytes} of {last.bytes} bytes"
            remedy = f"{_TO_QUARANTINE}, with its line"
            if self._add(what, path, remedy, lambda: _move_away(what, path, self.folder)):
                index.remove(numbers)
        if not good:
            return False
        superfluous = [number for number in numbers if number != good[-1]]
        index.remove(superfluous, f"a second line for {path.name}")
        return True

    def _row_of_stray(self, path: Path, run_id: str) -> IndexRow | None:
        """The line for a file without one, if the file is an intact shot of this run."""
        from labseq.recording.shot_file import (  # h5py takes 0.1 s to import
            damage_reported,
            iter_frames,
            read_content,
        )

        file = path.relative_to(self.folder).as_posix()
        try:
            content = read_content(path)
            for _ in iter_frames(path):  # every frame must be readable
                pass
            n_bytes, sha256, _ = digest_of(path)
            with damage_reported(path):
                row = row_of_record(
                    content.record,
                    content.target,
                    file=file,
                    sha256=sha256,
                    n_bytes=n_bytes,
                    measured=measured_in(content.run["resolved"]),
                )
        except OSError as error:
            self._add(f"cannot be read: {error.strerror}", path, _CHECK_PERMISSIONS)
            return None
        except OtherFormatError as error:
            self._add("no line in the index", path, f"left: {error.text}")
            return None
        except RecordingError as error:
            self._quarantine(f"no line in the index, and {error.what}", path)
            return None
        if content.run_id != run_id:
            self._quarantine(f"a shot of another run, {content.run_id}", path)
            return None
        if not _is_name(row):
            self._quarantine("a shot under a wrong name", path)
            return None
        return row

    def _save(self, lines: _LineFile) -> None:
        """Save a file of lines, and report its defects."""
        error = ""
        if not self._dry_run:
            try:
                lines.save()
            except RecordingError as failure:
                error = f"not repaired: {failure}"
        problems = lines.problems or ([("cannot be repaired", lines.path, "")] if error else [])
        for what, where, remedy in problems:
            self.findings.append(Finding(what, where, error or remedy, left=self._dry_run or bool(error)))

    def _quarantine(self, what: str, path: Path, folder: Path | None = None) -> None:
        """Move a file or folder to the quarantine of ``folder``. Default: the folder that is checked."""
        goal = self.folder if folder is None else folder
        self._add(what, path, _TO_QUARANTINE, lambda: _move_away(what, path, goal))

    def _add(self, what: str, where: Path, done: str, repair: Callable[[], None] | None = None) -> bool:
        """Report and repair a finding. True if it is repaired, or would be without a dry run."""
        if repair is not None and not self._dry_run:
            try:
                repair()
            except RecordingError as error:
                self.findings.append(Finding(what, where, f"not repaired: {error}", left=True))
                return False
        self.findings.append(Finding(what, where, done, left=repair is None or self._dry_run))
        return repair is not None


def _is_locked(path: Path) -> bool:
    """Whether a program holds HDF5's lock on a file. A program that died has left only its mark."""
    try:
        import fcntl
    except ImportError:  # on Windows a file that is open cannot be moved anyway
        return True
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


def _is_name(row: IndexRow) -> bool:
    """Whether the file in a line of the index has the name of its shot."""
    match = SHOT_FILE.fullmatch(row.file)
    take = int(match[3] or 1) if match else 1
    return row.file == folders.shot_file_name(row.shot, row.attempt, counts=row.counts, take=take)


def _move_away(what: str, path: Path, folder: Path) -> None:
    place = _quarantine_of(folder)
    goal, n = place / path.name, 1
    while goal.exists() or goal.is_symlink():
        n += 1
        goal = place / f"{path.name}.{n}"
    _log_move(folder, what, path, goal)
    with explained(path):
        path.rename(goal)
        sync_folder(path.parent)
        sync_folder(place)


def _log_move(folder: Path, what: str, path: Path, goal: Path) -> None:
    log = LineLog(_quarantine_of(folder) / "doctor.jsonl")
    t_utc = now_utc("seconds")
    log.append({"t_utc": t_utc, "what": what, "from": str(path), "to": str(goal)}, sync=True)


def _quarantine_of(folder: Path) -> Path:
    place = folder / QUARANTINE
    with explained(place):
        make_folder(place)
    return place


def names_in(folder: Path) -> list[str]:
    """The names in a folder, sorted. Empty if there is no such folder.

    Raises:
        RecordingError: The folder cannot be read.
    """
    try:
        return sorted(entry.name for entry in folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise RecordingError(folder, f"cannot be read: {error.strerror}", "check its permissions") from error


def _runs(root: Path, report: Report) -> Iterator[Path]:
    """The folders of runs: the path itself, runs in it, or runs in the folders of its days."""
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
            check = _Check(folder, dry_run=True)
            check.report_unreadable(error)
            report.findings += check.findings


def _is_run(folder: Path) -> bool:
    if folder.name == QUARANTINE or not folder.is_dir():
        return False
    parts = (folders.RUN_FILE, folders.STATE_FILE, folders.INDEX_FILE, folders.SHOTS_FOLDER)
    if re.fullmatch(r"\d{4,}_.*", folder.name, re.DOTALL):
        return True
    # a renamed run, or a run outside the folder of a day
    return any(_may_exist(folder / name) for name in parts)


def _may_exist(path: Path) -> bool:
    """Whether a file exists, or may exist because its folder cannot be read."""
    try:
        return path.exists()
    except OSError:
        return True


def _is_young(path: Path) -> bool:
    """Whether something is less than a minute old, and so may belong to a run that is being created."""
    try:
        # of either sign, because the clock of a file server may be ahead
        return abs(time.time() - path.stat().st_mtime) < 60.0
    except OSError:
        return False
