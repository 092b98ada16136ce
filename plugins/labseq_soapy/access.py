"""The radio of a profile, and a streaming process that an earlier labseq left with it."""

from __future__ import annotations

import hashlib
import tempfile
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Clock, Context, DeviceError, wait_for
from labseq.plugin.system import Process, state_root
from labseq_soapy.settings import SoapySettings

if TYPE_CHECKING:
    from labseq_soapy_sim.radio import SimulatedRadio

END_S: Final = 10.0
"""How long a process that was left behind may take to ramp down and close its radio."""


class RealRadio:
    """A radio that is connected to the computer. A ``SimulatedRadio`` has the same methods.

    Args:
        device: Arguments that open it.
    """

    def __init__(self, device: str) -> None:
        self._device = device

    outlives_run = True
    """Whether it can stay on when labseq has ended."""

    def connect(self) -> tuple[str, str, Path]:
        """Make the radio available.

        Returns:
            The arguments that open it, the module that streams to it, and a folder for logs.
        """
        return self._device, "labseq_soapy_stream.streamer", state_folder()

    def started(self, tones_hz: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
        """The radio streams these tones of rows and columns."""

    def changed(self) -> None:
        """The amplitudes of the tones have changed."""

    def released(self) -> None:
        """The array was off, and is on again."""

    def disconnect(self) -> None:
        """The radio was closed. No effect if it is not connected."""


def choose_radio(settings: SoapySettings, context: Context) -> RealRadio | SimulatedRadio:
    """The radio that the setting ``device`` names."""
    if not settings.is_simulated:
        return RealRadio(settings.device)
    from labseq_soapy_sim.radio import SimulatedRadio

    channels = settings.row_channel, settings.column_channel
    return SimulatedRadio(settings.device, channels, context.simulation)


def state_folder() -> Path:
    """Folder of markers and logs, in the user's state folder if there is one."""
    root = state_root()
    with suppress(OSError):
        if root is not None:
            folder = root / "soapy"
            folder.mkdir(parents=True, exist_ok=True)
            return folder
    return Path(tempfile.gettempdir())


def marker_of(device: str) -> Path:
    """File with the number of a process that runs this radio without labseq. Deleting it ends the process."""
    return state_folder() / f"soapy-{hashlib.sha256(device.encode()).hexdigest()[:16]}.alone"


def end_stale_process(name: str, marker: Path, clock: Clock) -> None:
    """End a process that an earlier labseq left behind with this radio. It ramps down.

    Raises:
        DeviceError: It does not end.
    """
    try:
        number = int(marker.read_text("ascii"))
        marker.unlink()
    except (OSError, ValueError):
        return
    process = Process(number, 0.0, Process.current().host)

    def poll(longest_s: float) -> bool | None:
        if not process.is_running:
            return True
        threading.Event().wait(longest_s)
        return None

    if not wait_for(poll, END_S, clock):
        text = f"process {number}, left behind with this radio, does not end within {END_S:g} s"
        raise DeviceError(name, f"{text}; end it yourself")
