"""Messages between a simulated camera's process and its parent, through two pipes."""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import IO, Any, Final

HEAD: Final = struct.Struct("<4sQ")
"""Kind of a message, and size of its data in bytes."""

# from the parent
SETUP: Final = b"SET1"  # JSON of a Setup
IMAGE: Final = b"IMAG"  # the bytes of a frame, in the camera's pixel format
NO_IMAGE: Final = b"NONE"  # there is no image; the frame fails
# from the camera
READY: Final = b"HELO"  # its address
REFUSED: Final = b"ERRO"  # why it cannot start
EXPOSE: Final = b"EXPO"  # JSON of an Exposure

GAIN_STEP: Final = 1e-3
"""Gain per step of its register."""


@dataclass(frozen=True, slots=True)
class Faults:
    """Failures to simulate, as in the settings. The camera's process, or the library in it, really fails.

    Attributes:
        packet_loss: Fraction of the packets of frames that are never sent, 0 to 1.
        failed_frames: Numbers of the frames, from 0, that come with half of their packets.
        late_by: Delay of each frame, in seconds. The camera answers nothing meanwhile.
        unplugged_at: Number of the frame at which the camera vanishes, before it is sent; None for never.
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
    """How the camera starts.

    Attributes:
        serial: Serial number, at most 15 bytes.
        sensor_shape: Height and width of the sensor, in pixels.
        address: Address that it had before; empty for any.
        faults: Failures to simulate.
    """

    serial: str
    sensor_shape: tuple[int, int]
    address: str
    faults: Faults


def to_json(message: Setup | Exposure) -> bytes:
    """JSON of a message; its values are the arguments of its class."""
    return json.dumps(asdict(message)).encode()


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
        reverse_y: 1 if it reverses that of the rows.
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
    """Messages over a pipe in each direction; any thread may send, one receives."""

    def __init__(self, reader: IO[bytes], writer: IO[bytes]) -> None:
        self._reader = reader
        self._writer = writer
        self._sending = threading.Lock()

    def send(self, kind: bytes, data: Any = b"") -> None:
        """Send a message; ``data`` is any object with contiguous bytes."""
        view = memoryview(data).cast("B")
        with self._sending:
            self._writer.write(HEAD.pack(kind, len(view)))
            self._writer.write(view)
            self._writer.flush()

    def receive(self) -> tuple[bytes, bytes] | None:
        """Wait for a message; None when the other side is gone."""
        head = self._reader.read(HEAD.size)
        if len(head) < HEAD.size:
            return None
        kind, size = HEAD.unpack(head)
        data = self._reader.read(size)
        return (kind, data) if len(data) == size else None
