"""What can go wrong with the simulated camera, and how it is told."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Faults:
    """What goes wrong. Each is done by the camera's process or by the library in it.

    Attributes:
        packet_loss: Fraction of the packets of frames that are never sent, 0 to 1.
        failed_frames: Numbers of the frames, from 0, that come with half of their packets.
        late_s: How long each frame is held back, in seconds. The camera answers nothing meanwhile.
        unplugged_at: Number of the frame at which the camera is gone, before it is sent; None
            for never.
        is_busy: Whether another application controls the camera.
        ignores_triggers: Whether its software trigger is connected to nothing; not while it runs.
        vendor: Maker that it names; not while it runs.
        model: Model that it names; not while it runs.
    """

    packet_loss: float = 0.0
    failed_frames: tuple[int, ...] = ()
    late_s: float = 0.0
    unplugged_at: int | None = None
    is_busy: bool = False
    ignores_triggers: bool = False
    vendor: str = "labseq"
    model: str = "Simulated"


@dataclass(frozen=True, slots=True)
class Setup:
    """What the camera is told when it starts.

    Attributes:
        serial: Serial number, at most 15 bytes.
        sensor_shape: Height and width of the sensor, in pixels.
        address: Address that it had before, or "".
        faults: What goes wrong.
    """

    serial: str
    sensor_shape: tuple[int, int]
    address: str
    faults: Faults


def to_json(message: Setup | Faults) -> bytes:
    """As JSON."""
    return json.dumps(dataclasses.asdict(message)).encode()


def faults_from(data: bytes | bytearray) -> Faults:
    """Out of JSON."""
    return _faults(json.loads(data))


def setup_from(data: bytes | bytearray) -> Setup:
    """Out of JSON."""
    values = json.loads(data)
    height, width = values["sensor_shape"]
    return Setup(values["serial"], (height, width), values["address"], _faults(values["faults"]))


def _faults(values: dict[str, Any]) -> Faults:
    values["failed_frames"] = tuple(values["failed_frames"])
    return Faults(**values)
