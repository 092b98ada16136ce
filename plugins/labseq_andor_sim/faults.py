"""Failures that the simulated camera can be told to have."""

from __future__ import annotations

import threading
from dataclasses import dataclass


@dataclass(slots=True)
class Faults:
    """Failures to simulate; may be changed at any time.

    Attributes:
        not_connected: The camera is not there.
        held: Another program uses it.
        unplugged: It answers no call any more.
        unplugged_at: Number of the frame, from 1, at which it is unplugged; 0: never.
        missed_triggers: How many of the next triggers the camera does not see.
        late_s: Delay of each frame, in seconds.
        buffer_error_at: Number of the frame, from 1, that the computer fails to take over; 0: none.
        buffer_frames: Frames that the ring buffer holds; 0: as many as fit into 48 MiB (ours).
        coldest_c: Lowest temperature that the cooler reaches, in degrees Celsius (ours).
        drift_k: How far the sensor has drifted from its temperature, in kelvins.
        hang: Fetching a frame does not return until this is set; None: it returns.
    """

    not_connected: bool = False
    held: bool = False
    unplugged: bool = False
    unplugged_at: int = 0
    missed_triggers: int = 0
    late_s: float = 0.0
    buffer_error_at: int = 0
    buffer_frames: int = 0
    coldest_c: float = -100.0
    drift_k: float = 0.0
    hang: threading.Event | None = None
