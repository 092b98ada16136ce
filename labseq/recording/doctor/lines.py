"""Files of lines: the torn, the damaged, the doubled."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from labseq.errors import RecordingError
from labseq.recording.doctor.findings import Damage, keep_lines
from labseq.recording.durable import parse_object, whole_lines, write_file
from labseq.recording.plain import dumps


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
