"""One run: its files, its index, its end."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from labseq.errors import RecordingError
from labseq.locks import Lock
from labseq.recording import folders
from labseq.recording.doctor.findings import Damage, Finding, Report, move_away, quarantined
from labseq.recording.doctor.lines import LineFile, read_line_file
from labseq.recording.doctor.shots import check_shots
from labseq.recording.durable import parse_object, write_file
from labseq.recording.plain import dumps
from labseq.recording.process import Owner
from labseq.recording.run_file import STATUSES, encode_state, is_skip_row, read_run


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
    owner = Owner.from_plain(state)
    return state.get("state") == "running" and owner is not None and (not owner.is_here or owner.lives)


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
            owner = Owner.from_plain(json.loads((folder / name).read_bytes()))
        except (OSError, ValueError, AttributeError):
            continue  # it is just being taken away, or half of it is written
        if owner is not None and owner.is_here and not owner.lives:
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
