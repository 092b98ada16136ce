"""What was found, and how it is mended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from labseq.errors import RecordingError
from labseq.recording.durable import LineLog, explained, sync_folder

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
