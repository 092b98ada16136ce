"""Which process does something, and whether it still lives. Needs no package."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Owner:
    """A process, told apart from a later one that was given the same number.

    Attributes:
        pid: Process id.
        started: When it started, in the system's own terms; "" if that is unknown.
        host: The computer that it runs on.
    """

    pid: int
    started: str
    host: str

    @classmethod
    def current(cls) -> Owner:
        """This process."""
        return cls(os.getpid(), _started(os.getpid()) or "", platform.node())

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> Owner | None:
        """Read back what ``dataclasses.asdict`` made; None if it is not that."""
        pid = values.get("pid")
        if not isinstance(pid, int) or isinstance(pid, bool) or pid <= 0:
            return None
        return cls(pid, str(values.get("started") or ""), str(values.get("host") or ""))

    @property
    def is_here(self) -> bool:
        """Whether it belongs to this computer, so that :attr:`lives` can be known."""
        return self.host == platform.node()

    @property
    def lives(self) -> bool:
        """Whether it still runs; meaningful on its own computer only."""
        started = _started(self.pid)
        if started is None:
            return False
        return not (self.started and started) or started == self.started


if sys.platform == "win32":

    def _started(pid: int) -> str | None:
        """When a process started; None if there is no such process, "" if nobody says."""
        import ctypes
        from ctypes import wintypes

        query_limited_information, still_active, access_denied = 0x1000, 259, 5
        kernel = ctypes.WinDLL("kernel32", use_last_error=True)
        kernel.OpenProcess.restype = wintypes.HANDLE
        kernel.OpenProcess.argtypes = (wintypes.DWORD, wintypes.BOOL, wintypes.DWORD)
        kernel.CloseHandle.argtypes = (wintypes.HANDLE,)
        kernel.GetExitCodeProcess.argtypes = (wintypes.HANDLE, ctypes.POINTER(wintypes.DWORD))
        kernel.GetProcessTimes.argtypes = (wintypes.HANDLE, *[ctypes.POINTER(wintypes.FILETIME)] * 4)
        handle = kernel.OpenProcess(query_limited_information, False, pid)
        if not handle:
            return "" if ctypes.get_last_error() == access_denied else None
        try:
            code = wintypes.DWORD()
            if kernel.GetExitCodeProcess(handle, ctypes.byref(code)) and code.value != still_active:
                return None
            times = [wintypes.FILETIME() for _ in range(4)]
            if not kernel.GetProcessTimes(handle, *[ctypes.byref(time) for time in times]):
                return ""
            return f"{times[0].dwHighDateTime:08x}{times[0].dwLowDateTime:08x}"
        finally:
            kernel.CloseHandle(handle)

else:

    def _started(pid: int) -> str | None:
        """When a process started; None if there is no such process, "" if nobody says."""
        try:
            os.kill(pid, 0)
        except (ProcessLookupError, OverflowError):
            return None
        except PermissionError:
            pass  # it exists and belongs to somebody else
        try:
            stat = Path(f"/proc/{pid}/stat").read_bytes()
            boot = Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
        except OSError:
            return ""  # not Linux, or hidden
        # The name in parentheses may hold anything; state is the 1st field after it, the start time the 20th.
        fields = stat[stat.rindex(b")") + 1 :].split()
        if fields[0] in {b"Z", b"X"}:
            return None  # ended; its parent has not yet asked how
        return f"{boot}/{fields[19].decode('ascii')}"
