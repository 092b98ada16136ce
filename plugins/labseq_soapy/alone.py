"""A streaming process that goes on, or ramps down, after its labseq is gone."""

from __future__ import annotations

import hashlib
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from labseq.plugin import Clock, DeviceError, Process, state_root, wait_for

END_S: Final = 10.0
"""How long a process that was left alone may take to ramp down and let its radio go."""


def place() -> Path:
    """Folder of markers and logs, in the user's state folder if there is one."""
    root = state_root()
    with suppress(OSError):
        if root is not None:
            folder = root / "soapy"
            folder.mkdir(parents=True, exist_ok=True)
            return folder
    return Path(tempfile.gettempdir())


def marker_of(device: str) -> Path:
    """The file in which a process that is alone with a radio writes its number; who deletes it ends it."""
    return place() / f"soapy-{hashlib.sha256(device.encode()).hexdigest()[:16]}.alone"


def end_stale_process(name: str, marker: Path, clock: Clock) -> None:
    """End the process that an earlier labseq left behind with this radio, if there is one; it ramps down.

    Args:
        name: Name of the device, for the message.
        marker: See :func:`marker_of`.
        clock: The session's clock.

    Raises:
        DeviceError: It does not end.
    """
    try:
        number = int(marker.read_text("ascii"))
        marker.unlink()
    except (OSError, ValueError):
        return
    here = Process.current()
    one = Process(number, 0.0, here.host)
    if not wait_for(lambda longest_s: _gone(one, longest_s), END_S, clock):
        text = (
            f"process {number}, left behind with this radio, does not end within {END_S:g} s; end it yourself"
        )
        raise DeviceError(name, text)


def _gone(one: Process, longest_s: float) -> bool | None:
    if not one.is_running:
        return True
    import threading

    threading.Event().wait(longest_s)
    return None
