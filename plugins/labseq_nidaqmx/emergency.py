"""Turns lines off from another process, with NI's driver library alone.

labseq's watchdog loads this file by its path after the run that used the cards has died. It needs nothing
but Python's standard library. NI-DAQmx ends the tasks of a process that has died, and the outputs keep the
levels that they have, so these are written. A process that hangs still holds its outputs. Then the card is
reset first, which ends the tasks of every process.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
from collections.abc import Sequence
from functools import cache
from typing import Any, TypeAlias

Output: TypeAlias = tuple[str, str, float, float]
"""Kind ("do" or "ao"), channel of the task, its value while the lines are off, and while they are on."""

RESERVED = (-50103, -200022, -200587)
CHAN_FOR_ALL_LINES, VOLTS = 1, 10348
NOW = (ctypes.c_int32(1), ctypes.c_uint32(1), ctypes.c_double(1.0), ctypes.c_uint32(0))
"""One sample, started at once, with a time limit of 1 s, channel by channel."""


class EmergencyError(Exception):
    """An output could not be switched off. The text says why."""


def prepare(outputs: Sequence[Output]) -> None:
    """Load NI's driver library without touching the cards.

    Raises:
        EmergencyError: It is not there.
    """
    del outputs
    load()


def off(outputs: Sequence[Output]) -> str:
    """Write the values of lines that are off to all outputs, even after one refused.

    Returns:
        What was done.

    Raises:
        EmergencyError: An output refused. The text is NI's.
    """
    library, failures = load(), list[str]()
    for kind, channel, low, high in outputs:
        code, text = _write(library, kind, channel, low, high)
        if code in RESERVED:
            library.DAQmxResetDevice(channel.split("/")[0].encode())
            code, text = _write(library, kind, channel, low, high)
        if code < 0:
            failures.append(f"{channel}: {text} ({code})")
    if failures:
        raise EmergencyError("; ".join(failures))
    return f"{len(outputs)} outputs of NI-DAQmx written: {', '.join(channel for _, channel, _, _ in outputs)}"


@cache
def load() -> Any:
    """NI's driver library."""
    name = "nicaiu" if sys.platform == "win32" else ctypes.util.find_library("nidaqmx")
    try:
        library: Any = ctypes.CDLL(name or "libnidaqmx.so")
    except OSError as error:
        raise EmergencyError(f"NI's driver library cannot be loaded: {error}") from error
    return library


def _write(library: Any, kind: str, channel: str, low: float, high: float) -> tuple[int, str]:
    """Write one value without a clock. Returns NI's code and, if it refused, its text."""
    task, name, written = ctypes.c_void_p(), channel.encode(), ctypes.c_int32()
    code = int(library.DAQmxCreateTask(b"", ctypes.byref(task)))
    if kind == "do":
        value: Any = (ctypes.c_uint32 * 1)(int(low))
        steps = [
            (library.DAQmxCreateDOChan, (name, b"", ctypes.c_int32(CHAN_FOR_ALL_LINES))),
            (library.DAQmxWriteDigitalU32, (*NOW, value, ctypes.byref(written), None)),
        ]
    else:
        value, limits = (ctypes.c_double * 1)(low), map(ctypes.c_double, sorted((low, high)))
        steps = [
            (library.DAQmxCreateAOVoltageChan, (name, b"", *limits, ctypes.c_int32(VOLTS), None)),
            (library.DAQmxWriteAnalogF64, (*NOW, value, ctypes.byref(written), None)),
        ]
    for function, arguments in steps:
        code = code if code < 0 else int(function(task, *arguments))
    text = _error(library) if code < 0 else ""
    library.DAQmxClearTask(task)
    return code, text


def _error(library: Any) -> str:
    """NI's text of the last error."""
    text = ctypes.create_string_buffer(2048)
    library.DAQmxGetExtendedErrorInfo(text, ctypes.c_uint32(len(text)))
    return " ".join(text.value.decode(errors="replace").split())
