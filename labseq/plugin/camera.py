"""Shared code of camera drivers: base class, settings, series of exposures, cooling, simulated sensor."""

from __future__ import annotations

from labseq.drivers.camera import (
    CameraDriver,
    Cooling,
    ExposureResult,
    Series,
    SimulatedSensor,
    check_step,
    nearest,
    settle,
)
from labseq.drivers.settings import CameraSettings, OrientationSettings

__all__ = [
    "CameraDriver",
    "CameraSettings",
    "Cooling",
    "ExposureResult",
    "OrientationSettings",
    "Series",
    "SimulatedSensor",
    "check_step",
    "nearest",
    "settle",
]
