"""Failures that the simulated camera can be told to have."""

from __future__ import annotations

from dataclasses import dataclass

from labseq.plugin.camera_simulator import CameraFaults


@dataclass(slots=True)
class Faults(CameraFaults):
    """Failures to simulate. They may be changed at any time.

    Attributes:
        buffer_error_at: Number of the frame, from 1, that the computer fails to take over, 0 for none.
        buffer_frames: Frames that the ring buffer holds, 0 for as many as fit into 48 MiB (ours).
        coldest_c: Lowest temperature that the cooler reaches, in degrees Celsius (ours).
        drift_k: How far the sensor has drifted from its temperature, in kelvins.
    """

    buffer_error_at: int = 0
    buffer_frames: int = 0
    coldest_c: float = -100.0
    drift_k: float = 0.0
