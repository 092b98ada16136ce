"""What the drivers of one role have in common, for those who write one.

A driver need not use any of it: a role is a Protocol. But a camera's series, its limits,
its lost frames and its errors are the same for all cameras, and are made once, here.
"""

from labseq.drivers.camera import CameraDriver, Cooling, ExposureResult, Series, SimulatedSensor, settle
from labseq.drivers.serial_port import wait_for

__all__ = ["CameraDriver", "Cooling", "ExposureResult", "Series", "SimulatedSensor", "settle", "wait_for"]
