"""Shared code of camera simulators: exposures at triggers, a ring buffer of frames, failures."""

from __future__ import annotations

from labseq.drivers.exposures import CameraFaults, ExposureTiming, SimulatedExposures

__all__ = ["CameraFaults", "ExposureTiming", "SimulatedExposures"]
