"""The simulated camera's times."""

from __future__ import annotations

from typing import Any, Final

from labseq.plugin import SensorMode
from labseq_andor.codes import Code
from labseq_andor.counterpart.amplifiers import Amplifiers
from labseq_andor.counterpart.calls import answers
from labseq_andor.counterpart.em_register import EmRegister
from labseq_andor.counterpart.optics import Optics
from labseq_andor.heads import ReadOut

MIN_EXPOSURE_S: Final = 10e-6
"""Shortest exposure without frame transfer; with it, that is the read-out (ours)."""

MAX_EXPOSURE_S: Final = 1000.0
"""Longest exposure (ours)."""


class Timing:
    """Exposure, read-out and cycle times.

    Args:
        optics: What is read.
        amplifiers: How fast.
        register: EM gain.
    """

    def __init__(self, optics: Optics, amplifiers: Amplifiers, register: EmRegister) -> None:
        self._optics, self._amplifiers, self._register = optics, amplifiers, register
        self.reset()

    def reset(self) -> None:
        """As after Initialize."""
        self._exposure_s = 0.1
        self._cycle_s = 0.0

    @property
    def sensor_mode(self) -> SensorMode:
        """How the sensor is exposed and read."""
        has_register = self._amplifiers.amplifier == 0
        return self._optics.mode(float(max(1, self._register.gain)) if has_register else 1.0)

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(height, width) of a frame."""
        return self._optics.frame_shape

    @property
    def reads_images(self) -> bool:
        """Whether images are read, rather than tracks."""
        return self._optics.reads_images

    @property
    def frame_transfer(self) -> bool:
        """Whether a read-out overlaps with the next exposure."""
        return self._optics.frame_transfer

    @property
    def readout_s(self) -> float:
        """From the end of an exposure to its frame, in seconds."""
        read = ReadOut(self._amplifiers.rate_hz, self._amplifiers.shift_s, self._optics.is_cropped)
        return read.duration_s(self._optics.sensor_shape, self.sensor_mode)

    @property
    def exposure_s(self) -> float:
        """Exposure as the camera makes it, in seconds."""
        return max(self._exposure_s, self.readout_s if self.frame_transfer else MIN_EXPOSURE_S)

    @property
    def kinetic_s(self) -> float:
        """From one exposure to the next with the internal trigger, in seconds."""
        least_s = self.exposure_s if self.frame_transfer else self.exposure_s + self.readout_s
        return max(least_s, self._cycle_s)

    @answers("SetExposureTime", only_idle=True)
    def set_exposure(self, seconds: float) -> int:
        """Ask for an exposure; the camera makes it as long as it must be."""
        if not 0 <= seconds <= MAX_EXPOSURE_S:
            return Code.P1INVALID
        self._exposure_s = seconds
        return Code.SUCCESS

    @answers("GetMaximumExposure")
    def get_longest(self, seconds: Any) -> int:
        """Longest exposure."""
        seconds[0] = MAX_EXPOSURE_S
        return Code.SUCCESS

    @answers("SetKineticCycleTime", only_idle=True)
    def set_cycle(self, seconds: float) -> int:
        """Ask for a cycle time; 0: the shortest."""
        self._cycle_s = seconds
        return Code.SUCCESS if seconds >= 0 else Code.P1INVALID

    @answers("SetAccumulationCycleTime", only_idle=True)
    def set_accumulation_cycle(self, seconds: float) -> int:
        """Without effect: one exposure makes a frame."""
        return Code.SUCCESS if seconds >= 0 else Code.P1INVALID

    @answers("GetAcquisitionTimings")
    def get_timings(self, exposure: Any, accumulate: Any, kinetic: Any) -> int:
        """Times as the camera makes them."""
        exposure[0], accumulate[0], kinetic[0] = self.exposure_s, self.kinetic_s, self.kinetic_s
        return Code.SUCCESS

    @answers("GetReadOutTime")
    def get_readout(self, seconds: Any) -> int:
        """Time to read a frame."""
        seconds[0] = self.readout_s
        return Code.SUCCESS
