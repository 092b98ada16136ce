"""What can go wrong with the simulated camera."""

from __future__ import annotations

import threading
from dataclasses import dataclass

COLDEST_C = -100.0
"""Coldest that the cooler makes the sensor, in degrees Celsius (ours)."""


@dataclass(slots=True)
class Faults:
    """Failures to rehearse; may be changed at any time.

    Attributes:
        not_connected: The camera is not there.
        held: Another program holds it.
        unplugged: It answers no call any more.
        unplugged_at: Number of the frame, from 1, at which that happens; 0: never.
        missed_triggers: How many of the next triggers are not seen.
        late_s: How much later than it should a frame comes, in seconds.
        buffer_error_at: Number of the frame, from 1, that the computer fails to take over; 0: none.
        buffer_frames: Frames that the computer's ring buffer holds; 0: as many as fit into 48 MiB (ours).
        coldest_c: Coldest that the cooler makes the sensor, in degrees Celsius.
        drift_k: How far the sensor has drifted from its temperature, in kelvins.
        hang: Fetching a frame does not come back until this is set; None: it does.
    """

    not_connected: bool = False
    held: bool = False
    unplugged: bool = False
    unplugged_at: int = 0
    missed_triggers: int = 0
    late_s: float = 0.0
    buffer_error_at: int = 0
    buffer_frames: int = 0
    coldest_c: float = COLDEST_C
    drift_k: float = 0.0
    hang: threading.Event | None = None
