"""Locks that name their holder, and free themselves when that is gone."""

from __future__ import annotations

import errno
import json
import os
import platform
import warnings
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from labseq.files import whole_file

if TYPE_CHECKING:
    from filelock import BaseFileLock

_NO_LOCKS: Final = frozenset({errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP})
_FOR_ALL: Final = 0o666
"""Other users may lock the same file, whatever this user's mask is."""


@dataclass(frozen=True, slots=True)
class Holder:
    """Who holds a lock.

    Attributes:
        what: What it does, for example "the run data/2026-01-02/0001_compact"; "" if nobody knows.
        pid: Its process; 0 if nobody knows.
        host: Its computer.
        since_utc: Since when, ISO 8601, UTC.
    """

    what: str
    pid: int
    host: str
    since_utc: str

    def __str__(self) -> str:
        if not self.pid:
            return "a process that has not said what it does"
        return f"{self.what} (process {self.pid} on {self.host}, since {_local(self.since_utc)})"


class Lock:
    """A lock of the system on a file: whoever holds it loses it with its process.

    Beside the file stands ``<file>.holder``, which says who holds it.

    Args:
        path: The file; it is made if there is none, and its folder, and it stays.
        what: What the holder does.
    """

    def __init__(self, path: Path, what: str) -> None:
        self.path = path
        self._lock: BaseFileLock | None = None
        self._about = path.with_name(f"{path.name}.holder")
        self._holder = Holder(
            what, os.getpid(), platform.node(), datetime.now(UTC).isoformat(timespec="seconds")
        )

    def take(self) -> Holder | None:
        """Take it if it is free; who holds it if it is not.

        Raises:
            OSError: The file cannot be made; or the folder knows no locks, see :func:`knows_no_locks`.
        """
        from filelock import FileLock, SoftFileLock, Timeout  # takes 0.05 s to import

        self.path.parent.mkdir(parents=True, exist_ok=True)
        lock: Any = FileLock(self.path, timeout=0, mode=_FOR_ALL, thread_local=False)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of the package, where it makes do with less than a lock
                lock.acquire()
        except Timeout:
            return self._other()
        except NotImplementedError as error:
            raise OSError(errno.ENOSYS, str(error)) from error
        if isinstance(lock, SoftFileLock):  # it would outlive its holder
            lock.release()
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
        self._lock = lock
        self.describe(self._holder.what)
        return None

    def describe(self, what: str) -> None:
        """Say what is done meanwhile; what cannot be written is not said."""
        self._holder = replace(self._holder, what=what)
        with suppress(OSError), whole_file(self._about) as file:
            file.write(json.dumps(asdict(self._holder)).encode())

    def release(self) -> None:
        """Free it; legal at any time."""
        if self._lock is not None:
            with suppress(OSError):
                self._about.unlink(missing_ok=True)
            self._lock.release()
            self._lock = None

    def _other(self) -> Holder:
        try:
            values: dict[str, Any] = json.loads(self._about.read_bytes())
            return Holder(
                str(values["what"]), int(values["pid"]), str(values["host"]), str(values["since_utc"])
            )
        except (OSError, ValueError, TypeError, KeyError):
            return Holder("", 0, "", "")


def knows_no_locks(error: OSError) -> bool:
    """Whether a lock failed because its folder, perhaps one of the network, has none to give."""
    return error.errno in _NO_LOCKS


def _local(time_utc: str) -> str:
    try:
        return f"{datetime.fromisoformat(time_utc).astimezone():%Y-%m-%d %H:%M:%S}"
    except ValueError:
        return time_utc
