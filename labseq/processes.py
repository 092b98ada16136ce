"""Processes, and locks that are released when their process ends."""

from __future__ import annotations

import errno
import json
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from labseq.errors import RecordingError
from labseq.files import FOR_ALL, make_folder, read_file, write_shared
from labseq.plain import now_utc, parse_object

if TYPE_CHECKING:
    from filelock import BaseFileLock


@dataclass(frozen=True, slots=True)
class Process:
    """A process, identified by its id and its start time, because ids are used again.

    Attributes:
        pid: Process id.
        started: Its start time, in seconds since the start of the computer on Linux, where changes of the
            clock do not matter, and since 1970 elsewhere. 0 if unknown.
        host: The computer that it runs on.
        boot: Id of the computer's last start, or "" if unknown.
    """

    pid: int
    started: float
    host: str
    boot: str = ""

    @classmethod
    def current(cls) -> Process:
        """This process."""
        return cls(os.getpid(), _start_time(os.getpid()) or 0.0, platform.node(), _boot_id())

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> Process | None:
        """A process from the result of ``dataclasses.asdict``, or None for any other value."""
        pid, started = values.get("pid"), values.get("started", 0.0)
        if type(pid) is not int or pid <= 0 or type(started) not in (int, float):
            return None
        return cls(pid, float(started), str(values.get("host") or ""), str(values.get("boot") or ""))

    @property
    def is_here(self) -> bool:
        """Whether it belongs to this computer, so that :attr:`is_running` can be known."""
        return self.host == platform.node()

    @property
    def is_running(self) -> bool:
        """Whether it still runs. Only known on its own computer."""
        if self.boot and self.boot != _boot_id():
            return False
        started = _start_time(self.pid)
        if started is None:
            return False
        # on systems other than Linux a correction of the clock may move the start time of a process
        tolerance_s = 0.02 if sys.platform == "linux" else 2.0
        return not (self.started and started) or abs(started - self.started) < tolerance_s

    def end(self, grace_s: float) -> bool:
        """End it with SIGTERM, or with SIGKILL if it has not ended within the grace time.

        Returns:
            Whether it has ended.

        Raises:
            OSError: It belongs to another user.
        """
        for number in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)):
            deadline_s = time.monotonic() + grace_s
            with suppress(ProcessLookupError):
                if self.is_running:
                    os.kill(self.pid, number)
            while self.is_running and time.monotonic() < deadline_s:
                time.sleep(0.02)
        return not self.is_running


@cache
def _boot_id() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    except OSError:
        return ""


def _start_time(pid: int) -> float | None:
    """Start time of a process, as in :class:`Process`. None if there is no such process, 0 if hidden."""
    if sys.platform == "linux":
        return _start_since_boot(pid)
    import psutil  # takes 0.03 s to import

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process.create_time()
    except psutil.AccessDenied:
        return 0.0
    except (psutil.NoSuchProcess, OverflowError):
        return None


def _start_since_boot(pid: int) -> float | None:
    """Start time of a process on Linux, from proc(5), whose times do not follow the clock."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace").rpartition(")")[2].split()
        has_ended = fields[0] in "ZXx" and int(fields[17]) <= 1  # other threads still hold its files
        return None if has_ended else int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        try:
            os.kill(pid, 0)
        except PermissionError:  # it is hidden
            return 0.0
        except (OSError, OverflowError):
            return None
        return 0.0


HANG_S: Final = 5.0
"""A process without a sign of life for this long hangs. Processes that use devices give two a second."""


@dataclass(frozen=True, slots=True)
class Holder:
    """The process that holds a lock.

    Attributes:
        purpose: For example "the run data/2026-01-02/0001_compact". "" if unknown.
        process: The process, or None if unknown.
        since_utc: Since when, ISO 8601, UTC.
        silent_s: Time since its last sign of life. 0 if it gives none.
    """

    purpose: str = ""
    process: Process | None = None
    since_utc: str = ""
    silent_s: float = 0.0

    @property
    def hangs(self) -> bool:
        """Whether it has given no sign of life for too long."""
        return self.silent_s > HANG_S

    @property
    def is_running(self) -> bool:
        """Whether its process still runs."""
        return self.process is not None and self.process.is_running

    def __str__(self) -> str:
        if self.process is None:
            return "an unknown process"
        process = f"process {self.process.pid} on {self.process.host}"
        return f"{self.purpose} ({process}, since {_local(self.since_utc)})"


class Lock:
    """A lock of the operating system on a file, released when its process ends, even if it is killed.

    ``<file>.holder`` next to the file describes the process that holds it. The time stamp of that file, on
    the system's monotonic clock, is the last sign of life of the process.

    Args:
        path: The file. It and its folder are made if they do not exist, and stay.
        purpose: Purpose of the lock, shown to other processes.
    """

    def __init__(self, path: Path, purpose: str) -> None:
        self.path = path
        self._lock: BaseFileLock | None = None
        self._about = path.with_name(f"{path.name}.holder")
        self._holder = Holder(purpose, Process.current(), now_utc("seconds"))

    def take(self, warn: Callable[[str], None] | None = None) -> Holder | None:
        """Take the lock if it is free.

        Args:
            warn: Receives a message if the folder, perhaps on a network, has no locks. Without `warn` that is
                an error.

        Returns:
            None, or the holder if it is not free.

        Raises:
            OSError: The file cannot be made, or its folder has no locks.
        """
        from filelock import FileLock, Timeout  # takes 0.05 s to import

        make_folder(self.path.parent)
        # without fallback_to_soft=False it would use a lock file, which outlives its holder
        lock = FileLock(self.path, timeout=0, mode=FOR_ALL, thread_local=False, fallback_to_soft=False)
        try:
            lock.acquire()
        except Timeout:
            return self.holder() or Holder()
        except (NotImplementedError, OSError) as error:
            failure = error if isinstance(error, OSError) else OSError(errno.ENOSYS, str(error))
            # the codes of a folder, perhaps on a network, that does not support locks
            no_locks = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP}
            if warn is None or failure.errno not in no_locks:
                raise failure from error
            warn(f"{self.path.parent} does not support file locks, so another process could work there, too")
            return None
        self._lock = lock
        self.describe(self._holder.purpose)
        return None

    def describe(self, purpose: str) -> None:
        """Write the purpose of the lock to the file of its holder, if possible."""
        self._holder = replace(self._holder, purpose=purpose)
        values = {"what": purpose, "since_utc": self._holder.since_utc, **asdict(Process.current())}
        with suppress(OSError):
            write_shared(self._about, json.dumps(values).encode())
        self.beat()

    def beat(self) -> None:
        """Give a sign of life."""
        with suppress(OSError):
            os.utime(self._about, ns=(time.monotonic_ns(), time.monotonic_ns()))

    def release(self) -> None:
        """Free the lock. Legal at any time."""
        if self._lock is not None:
            with suppress(OSError):
                try:
                    self._about.unlink(missing_ok=True)
                except PermissionError:  # it belongs to another user, and only that user may delete it
                    write_shared(self._about, b"")
            self._lock.release()
            self._lock = None

    def holder(self) -> Holder | None:
        """The process that holds the lock, or died holding it. None if there is none or it is unknown."""
        try:
            values = parse_object(read_file(self._about)) or {}
            silent_s = max(0.0, time.monotonic() - self._about.stat().st_mtime)
            return Holder(str(values["what"]), Process.from_plain(values), str(values["since_utc"]), silent_s)
        except (RecordingError, OSError, KeyError):
            return None


def _local(time_utc: str) -> str:
    try:
        return f"{datetime.fromisoformat(time_utc).astimezone():%Y-%m-%d %H:%M:%S}"
    except ValueError:
        return time_utc


def is_loopback(host: str) -> bool:
    """Whether only this computer can reach an address. Host names count as reachable by others.

    Example:
        >>> is_loopback("127.0.0.1"), is_loopback("::1"), is_loopback("localhost"), is_loopback("0.0.0.0")
        (True, True, True, False)
        >>> is_loopback("camera-pc")
        False
    """
    import ipaddress  # few commands need it

    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
