"""Switches a radio off from another process, after labseq has died or hangs.

labseq's watchdog loads this file by its path. It needs nothing but Python's standard library. The streaming
process, which alone has the radio open, is asked to end. It ramps the tones down and closes the radio. If it
hangs it is killed, and then the radio's buffer runs dry. Its transmitters stay on with their gain and the
leakage of the local oscillator until somebody opens it again. So another process of the streaming program
opens the radio, sets the lowest gains and closes it.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

END_S = 0.5
"""How long the streaming process may take to end in addition to its ramp."""
KILL_S = 5.0
"""How long the system may take to end a killed process, which a driver may keep in the kernel."""
OPEN_S = 60.0
"""How long a radio may take to open. Some load their firmware."""
PAUSE_S = 1e-3
STAYS_ON = "It plays nothing any more, but its transmitters stay on with their gain; switch it off by hand"


class EmergencyError(Exception):
    """The radio could not be switched off. The text says why."""


def start_of(pid: int) -> int:
    """When a process was started, in ticks since the computer's start, 0 if the system does not say."""
    with suppress(OSError, ValueError, IndexError):
        return int(_status(pid)[19])
    return 0


def _status(pid: int) -> list[str]:
    """The fields of /proc/PID/stat after the name, from the state on."""
    return Path(f"/proc/{pid}/stat").read_text("ascii", "replace").rpartition(")")[2].split()


def off(
    pid: int,
    started: int,
    opened: str,
    ramp_s: float,
    device: str,
    channels: Sequence[int],
    program: str,
) -> str:
    """End the streaming process, and switch the transmitters off if it did not. Can be repeated.

    Args:
        pid: Number of the streaming process.
        started: Its start, by :func:`start_of`, since numbers of processes are used again.
        opened: File that exists while it has the radio open.
        ramp_s: How long its ramp to zero takes, with the radio's buffer.
        device: Arguments that open the radio.
        channels: Channels that transmit.
        program: Module that streams to it.

    Returns:
        What was done.

    Raises:
        EmergencyError: Wrong arguments, the process cannot be ended, or the radio cannot be opened.
    """
    if type(pid) is not int or pid <= 1:
        raise EmergencyError(f"the number of the streaming process is {pid!r}; expected a number above 1")
    is_killed = _end(pid, started, ramp_s)
    if not _left_open(opened, pid):
        return "streaming process ended, radio ramped down and closed"
    done = _switch_off_again(device, channels, program)
    Path(opened).unlink(missing_ok=True)
    how = "hung and was killed" if is_killed else "ended without closing its radio"
    return f"streaming process {how}; {done}"


def _left_open(opened: str, pid: int) -> bool:
    """Whether the file says that this process has not closed its radio."""
    with suppress(OSError):
        return Path(opened).read_text("ascii") == str(pid)
    return False


def _end(pid: int, started: int, ramp_s: float) -> bool:
    """End the process, and return whether it had to be killed."""
    try:
        if os.name != "nt" and _runs(pid, started):  # elsewhere this kills it, and it ends by itself
            os.kill(pid, signal.SIGTERM)
        if _ended(pid, started, ramp_s + END_S):
            return False
        os.kill(pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
    except ProcessLookupError:
        return False
    except OSError as error:
        raise EmergencyError(f"the streaming process {pid} cannot be ended: {error}") from error
    if not _ended(pid, started, KILL_S):
        raise EmergencyError(f"the streaming process {pid} does not end although it was killed")
    return True


def _ended(pid: int, started: int, longest_s: float) -> bool:
    """Wait until a process has ended, and return whether it has."""
    deadline_s = time.monotonic() + longest_s
    while _runs(pid, started):
        if time.monotonic() > deadline_s:
            return False
        time.sleep(PAUSE_S)
    return True


def _runs(pid: int, started: int) -> bool:
    if os.name == "nt":
        return _runs_windows(pid)
    if not started:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, 0)
            return True
        return False
    try:
        state, *fields = _status(pid)
    except OSError:
        return False
    return int(fields[18]) == started and state not in "ZX"


def _runs_windows(pid: int) -> bool:
    kernel: Any = ctypes.__dict__["WinDLL"]("kernel32")
    synchronize, timeout = 0x00100000, 0x102
    kernel.OpenProcess.restype = ctypes.c_void_p
    handle = ctypes.c_void_p(kernel.OpenProcess(synchronize, False, pid))
    if not handle:
        return False
    try:
        return kernel.WaitForSingleObject(handle, 0) == timeout
    finally:
        kernel.CloseHandle(handle)


def _switch_off_again(device: str, channels: Sequence[int], program: str) -> str:
    """Open the radio in a process of its own, set the lowest gains, close it."""
    command = [sys.executable, "-P", "-m", program, "--off", device, *map(str, channels)]
    try:
        done = subprocess.run(  # noqa: S603 - our own module
            command,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=OPEN_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise EmergencyError(f"the radio '{device}' does not open within {OPEN_S:g} s. {STAYS_ON}") from error
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or [f"code {done.returncode}"])[-1]
        raise EmergencyError(f"the radio '{device}' cannot be opened again: {reason}. {STAYS_ON}")
    return "radio opened again, lowest gains set, closed"
