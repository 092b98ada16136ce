"""Writing that survives a kill, a power cut and a full disk; reading what they left."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any, Final, cast

from labseq.errors import RecordingError
from labseq.recording.plain import dumps

_ELSEWHERE: Final = "choose another place with --output or LABSEQ_DATA"
_ADVICE: Final = {
    errno.ENOSPC: f"the disk is full; free some space, or {_ELSEWHERE}",
    errno.EDQUOT: f"your disk quota is used up; free some space, or {_ELSEWHERE}",
    errno.EACCES: f"labseq may not write there; {_ELSEWHERE}",
    errno.EPERM: f"labseq may not write there; {_ELSEWHERE}",
    errno.EROFS: f"the disk is read-only; {_ELSEWHERE}",
    errno.ENOTDIR: f"a file is in the way of a folder; move it, or {_ELSEWHERE}",
    errno.EEXIST: f"a file is in the way of a folder; move it, or {_ELSEWHERE}",
    errno.ENOENT: "the folder is gone; do not move or delete a run while it is written",
    errno.EIO: f"the disk reports a fault; check it and its cable, or {_ELSEWHERE}",
}


@contextlib.contextmanager
def explained(path: Path) -> Generator[None]:
    """Turn an ``OSError`` while writing ``path`` into a ``RecordingError`` that says what to do.

    Raises:
        RecordingError: The body raised an ``OSError``.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        advice = _ADVICE.get(error.errno or 0, f"check the disk, or {_ELSEWHERE}")
        raise RecordingError(path, f"cannot be written: {reason}; {advice}") from error


def write_file(path: Path, data: bytes | memoryview) -> None:
    """Write a file so that it is either there, whole and on the disk, or not there at all.

    The bytes go to ``<path>.part``, are flushed to the disk, and get their name
    only then. An older file of that name is replaced.

    Raises:
        RecordingError: The disk is full or the place cannot be written to.
    """
    part = path.with_name(path.name + ".part")
    with explained(path):
        try:
            with part.open("wb", buffering=0) as file:
                _write_all(file.fileno(), data)
                os.fsync(file.fileno())
            part.replace(path)
        except OSError:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flush a folder's list of files to the disk, where the system can (Windows cannot)."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in {errno.EINVAL, errno.ENOTSUP}:  # some network folders cannot either
            raise
    finally:
        os.close(handle)


class LineLog:
    """An append-only file of JSON lines that a torn last line does not confuse.

    Only what ends with a newline counts. What a process that was killed has left of a
    line is kept, as a line of its own; the rest of an append that failed in this
    process is overwritten by the next one.

    Args:
        path: The file; it is made if it does not exist.

    Raises:
        RecordingError: The file cannot be made or read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with explained(path), path.open("a+b", buffering=0) as file:
            self._length = file.seek(0, os.SEEK_END)
            file.seek(max(0, self._length - 1))
            if file.read(1) not in (b"", b"\n"):
                self._length += file.write(b"\n")

    def append(self, values: object, *, sync: bool) -> None:
        """Add a line; ``sync`` waits until it is on the disk.

        Raises:
            RecordingError: It could not be written; the file is as it was before.
        """
        line = dumps(values).encode() + b"\n"
        with explained(self.path), self.path.open("r+b", buffering=0) as file:
            start = min(self._length, file.seek(0, os.SEEK_END))
            try:
                file.seek(start)
                file.truncate()
                _write_all(file.fileno(), line)
                if sync:
                    os.fsync(file.fileno())
            except OSError:
                with contextlib.suppress(OSError):
                    file.truncate(start)
                raise
        self._length = start + len(line)


def _write_all(handle: int, data: bytes | memoryview) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(handle, rest) :]


def whole_lines(data: bytes) -> bytes:
    r"""What is left without a torn last line.

    Example:
        >>> whole_lines(b'{"a": 1}\n{"b"')
        b'{"a": 1}\n'
    """
    return data[: data.rfind(b"\n") + 1]


def read_lines(path: Path) -> tuple[list[dict[str, Any]], list[int]]:
    """Read a file of JSON lines, whatever state it is in.

    Returns:
        The lines that are whole, and the numbers (from 1) of lines that are
        damaged. A torn last line is neither: it was never reported as written.

    Raises:
        RecordingError: The file exists but cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return [], []
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}; check the disk") from error
    rows: list[dict[str, Any]] = []
    damaged: list[int] = []
    for number, line in enumerate(whole_lines(data).split(b"\n")[:-1], start=1):
        row = parse_object(line)
        if row is None:
            damaged.append(number)
        else:
            rows.append(row)
    return rows, damaged


def parse_object(data: bytes) -> dict[str, Any] | None:
    """Read a JSON object; None if it is anything else."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return cast("dict[str, Any]", value) if isinstance(value, dict) else None
