"""Base classes and helpers for authors of drivers, by role.

A driver need not use any of it: it only has to fulfil its role. But a camera's series, its limits,
its lost frames and its errors are the same for all cameras, and are handled once, here.
"""

from labseq.drivers.camera import CameraDriver, Cooling, ExposureResult, Series, SimulatedSensor, settle
from labseq.drivers.waiting import wait_for

__all__ = ["CameraDriver", "Cooling", "ExposureResult", "Series", "SimulatedSensor", "settle", "wait_for"]
