"""Messages between a simulated camera's process and its parent, pickled, through two pipes."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO, Any, Final

GAIN_STEP: Final = 1e-3
"""Gain per step of its register."""


@dataclass(frozen=True, slots=True)
class Faults:
    """Failures to simulate, as in the settings. The camera's process, or the library in it, really fails.

    Attributes:
        packet_loss: Fraction of the packets of frames that are never sent, 0 to 1.
        failed_frames: Numbers of the frames, from 0, that come with half of their packets.
        late_by: Delay of each frame, in seconds. The camera answers nothing meanwhile.
        unplugged_at: Number of the frame at which the camera vanishes, before it is sent, None for never.
        busy: Whether another application controls the camera.
        ignores_triggers: Whether its software trigger has no effect.
    """

    packet_loss: float = 0.0
    failed_frames: Sequence[int] = ()
    late_by: float = 0.0
    unplugged_at: int | None = None
    busy: bool = False
    ignores_triggers: bool = False


@dataclass(frozen=True, slots=True)
class Setup:
    """Settings with which the camera starts.

    Attributes:
        serial: Serial number, at most 15 bytes.
        sensor_shape: Height and width of the sensor, in pixels.
        address: Address that it had before, empty for any.
        faults: Failures to simulate.
    """

    serial: str
    sensor_shape: tuple[int, int]
    address: str
    faults: Faults


@dataclass(frozen=True, slots=True)
class Image:
    """The parent's answer to an exposure.

    Attributes:
        pixels: The bytes of a frame, in the camera's pixel format, None for a frame that fails.
    """

    pixels: bytes | None


@dataclass(frozen=True, slots=True)
class Ready:
    """The camera can be reached.

    Attributes:
        address: Its IP address.
    """

    address: str


@dataclass(frozen=True, slots=True)
class NotStarted:
    """The camera cannot start.

    Attributes:
        reason: Why.
    """

    reason: str


@dataclass(frozen=True, slots=True)
class Exposure:
    """A frame that the camera begins.

    Attributes:
        n: Number of the frame, from 0.
        exposure_us: Exposure time, in microseconds.
        gain_steps: Gain, in steps of its register.
        pixel_format: Code of the pixel format.
        x: First column of the region, in binned pixels.
        y: First row of the region, in binned pixels.
        width: Number of columns, in binned pixels.
        height: Number of rows, in binned pixels.
        binning_x: Columns that are added up.
        binning_y: Rows that are added up.
        reverse_x: 1 if the camera reverses the order of the columns.
        reverse_y: 1 if it reverses the order of the rows.
    """

    n: int
    exposure_us: int
    gain_steps: int
    pixel_format: int
    x: int
    y: int
    width: int
    height: int
    binning_x: int
    binning_y: int
    reverse_x: int = 0
    reverse_y: int = 0


class Channel:
    """Messages over a pipe in each direction. Any thread may send, one receives."""

    def __init__(self, reader: IO[bytes], writer: IO[bytes]) -> None:
        self._reader = reader
        self._writer = writer
        self._sending = threading.Lock()

    def send(self, message: object) -> None:
        """Send a message."""
        with self._sending:
            pickle.dump(message, self._writer)
            self._writer.flush()

    def receive(self) -> Any:
        """Wait for a message. None when the other side is gone."""
        try:
            return pickle.load(self._reader)  # noqa: S301 - the other side is a process of ours
        except (OSError, EOFError, ValueError, pickle.UnpicklingError):  # closed, or cut off
            return None
