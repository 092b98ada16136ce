"""Switches a device on a serial line off from another process, with pyserial alone.

The watchdog loads this file by its path when the run that used the device has died; see
``labseq.plugin.serial_emergency``.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

SLICE_S: Final = 0.005
MAX_SHOWN: Final = 60


def prepare(port: str, options: Mapping[str, Any], messages: Sequence[Mapping[str, Any]]) -> None:  # noqa: ARG001
    """Load pyserial; the port is not touched."""
    importlib.import_module("serial")


def off(port: str, options: Mapping[str, Any], messages: Sequence[Mapping[str, Any]]) -> str:
    """Open the port, send every message, and wait for its answer.

    Args:
        port: The port, as pyserial knows it.
        options: Those of the port.
        messages: For each, as Latin-1 text: ``send``; ``until``, the end of the answer; and ``within_s``,
            how long the answer may take, or the pause after a message without one.

    Returns:
        What was sent.

    Raises:
        OSError: The port cannot be opened, or an answer did not come; every message was sent.
    """
    serial: Any = importlib.import_module("serial")
    silent: list[str] = []
    with serial.serial_for_url(port, timeout=SLICE_S, write_timeout=1.0, **options) as line:
        for message in messages:
            line.write(message["send"].encode("latin-1"))
            line.flush()
            if not message["until"]:
                time.sleep(message["within_s"])
            elif not _answers(line, message["until"].encode("latin-1"), message["within_s"]):
                silent.append(_shown(message["send"]))
    if silent:
        raise OSError(f"{port}: no answer to {', '.join(silent)}")
    sent = [_shown(message["send"]) for message in messages if message["send"]]
    return f"sent {', '.join(sent)} to {port}"


def _answers(line: Any, end: bytes, within_s: float) -> bool:
    came, deadline = b"", time.monotonic() + within_s
    while end not in came:
        if time.monotonic() > deadline:
            return False
        came += line.read(max(1, line.in_waiting))
    return True


def _shown(text: str) -> str:
    return ascii(text.strip())[:MAX_SHOWN]
