"""Lines appended and files written so that they survive a crash; values as plain JSON."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import math
import os
from collections.abc import Generator, Mapping, Set as AbstractSet
from datetime import date, time
from enum import Enum
from pathlib import Path, PurePath
from typing import Any, Final, cast

import numpy as np

from labseq.errors import RecordingError

_MAX_DEPTH: Final = 32
_MAX_BITS: Final = 4096  # Python refuses to write much longer integers in decimal


def to_plain(value: Any) -> Any:
    """Turn any value into what JSON can hold; never raises.

    nan and infinities become None, numpy scalars and arrays plain numbers and
    lists, keys text. What nothing else fits becomes its ``repr``.

    Example:
        >>> to_plain({1: np.float32(0.5), "b": (float("nan"), np.arange(2))})
        {'1': 0.5, 'b': [None, [0, 1]]}
    """
    return _plain(value, ())


def dumps(value: Any, *, indent: int | None = None) -> str:
    """JSON of any value, by :func:`to_plain`; one line unless indented.

    Example:
        >>> dumps({"t_s": float("inf")})
        '{"t_s": null}'
    """
    text = json.dumps(to_plain(value), ensure_ascii=False, allow_nan=False, indent=indent)
    # What is left of undecodable bytes (lone surrogates) has no UTF-8; "\udc80" is its JSON escape.
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def plain_text(text: str) -> str:
    r"""Text that every file format takes: no NUL characters and no lone surrogates.

    Example:
        >>> print(plain_text("a\0b"))
        a\x00b
    """
    return text.replace("\0", r"\x00").encode("utf-8", "backslashreplace").decode("utf-8")


def _plain(value: Any, parents: tuple[int, ...]) -> Any:
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, np.integer)) and not isinstance(value, Enum):
        number = int(value)
        return number if number.bit_length() <= _MAX_BITS else hex(number)
    if isinstance(value, (float, np.floating)):
        real = float(value)
        return real if math.isfinite(real) else None
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, PurePath):
        return str(value)
    if id(value) in parents or len(parents) >= _MAX_DEPTH:
        return _repr(value)
    try:
        return _plain_container(value, (*parents, id(value)))
    except Exception:  # noqa: BLE001 - a stranger's container may do anything when it is walked
        return _repr(value)


def _plain_container(value: Any, parents: tuple[int, ...]) -> Any:
    if isinstance(value, Enum):
        return _plain(value.value, parents)
    if isinstance(value, np.ndarray):
        return _plain(value.tolist(), parents)
    if isinstance(value, Mapping):
        items = cast("Mapping[Any, Any]", value).items()
        return {_key(key): _plain(item, parents) for key, item in items}
    if isinstance(value, (list, tuple)):
        return [_plain(item, parents) for item in cast("list[Any]", value)]
    if isinstance(value, AbstractSet):
        return [_plain(item, parents) for item in sorted(cast("AbstractSet[Any]", value), key=_repr)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: _plain(getattr(value, item.name), parents) for item in dataclasses.fields(value)}
    if isinstance(value, date | time):
        return value.isoformat()
    return _repr(value)


def _key(key: Any) -> str:
    return key if isinstance(key, str) else str(_plain(key, ()))


def _repr(value: Any) -> str:
    try:
        return repr(value)
    except Exception:  # noqa: BLE001 - a stranger's repr may do anything
        return f"<{type(value).__name__}>"


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
