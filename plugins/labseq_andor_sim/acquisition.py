"""How the simulated camera acquires series of frames, and the ring buffer that keeps them."""

# ruff: noqa: N802 - the SDK's names, which its manual explains

from __future__ import annotations

import ctypes
from typing import Any, Final

import numpy as np
from labseq_andor.codes import (
    EXTERNAL,
    EXTERNAL_EXPOSURE,
    EXTERNAL_START,
    INTERNAL,
    SOFTWARE,
    Code,
)

from labseq.plugin import Clock, Frame, Trigger
from labseq.plugin.camera import Series, SimulatedSensor
from labseq.plugin.camera_simulator import ExposureTiming, SimulatedExposures
from labseq_andor_sim.faults import Faults
from labseq_andor_sim.settings import Timing, require

BUFFER_BYTES: Final = 48 * 2**20
"""Size of the ring buffer (ours)."""
KINDS: Final[dict[int, Trigger]] = {
    INTERNAL: "internal",
    EXTERNAL: "external",
    EXTERNAL_START: "external_start",
    EXTERNAL_EXPOSURE: "bulb",
    SOFTWARE: "software",
}


class Acquisition(SimulatedExposures):
    """Series of frames as the SDK's functions start, fetch and abort them.

    Args:
        sensor: Source of the pixels.
        timing: Exposure, cycle times and trigger.
    """

    def __init__(
        self, sensor: SimulatedSensor, timing: Timing, clock: Clock, faults: Faults, arm_s: float = 0.0
    ) -> None:
        self._times, self._arm_s, self._errors = timing, arm_s, faults
        self._fault: Code = Code.SUCCESS
        super().__init__(sensor, clock, faults)

    def reset(self) -> None:
        """End any series, as Initialize does."""
        self._fault = Code.SUCCESS
        super().reset()

    def PrepareAcquisition(self) -> None:
        """Empty the ring buffer."""
        height, width = self._times.optics.frame_shape
        self.empty_buffer(self._errors.buffer_frames or max(2, BUFFER_BYTES // (2 * height * width)))

    def StartAcquisition(self) -> None:
        """Arm the sensor. With the internal trigger the first exposure begins."""
        timing, mode = self._times, self._times.sensor_mode
        require(timing.optics.reads_images, Code.INVALID_MODE)
        is_bulb = timing.trigger == EXTERNAL_EXPOSURE
        require(not (is_bulb and timing.optics.frame_transfer), Code.INVALID_MODE)
        self.PrepareAcquisition()
        self._fault = Code.SUCCESS
        series = Series(timing.n_frames, timing.exposure_s, KINDS[timing.trigger], mode.em_gain or 1.0)
        overlaps = timing.optics.frame_transfer
        self.start(series, mode, ExposureTiming(timing.readout_s, timing.kinetic_s, overlaps, self._arm_s))

    def AbortAcquisition(self) -> None:
        """Stop. Frames that were not read out are lost."""
        require(self.is_acquiring, Code.IDLE)
        self.abort()

    def SendSoftwareTrigger(self) -> None:
        """Expose. Refused during an exposure, or a read-out that cannot overlap with the next exposure."""
        require(self._times.trigger == SOFTWARE and self._times.runs_till_abort, Code.INVALID_MODE)
        require(self.is_acquiring, Code.IDLE)
        require(not self.is_busy, Code.ERROR_CODES)
        self.expose()

    def GetStatus(self) -> Code:
        """Idle, acquiring, or why the acquisition ended early."""
        self.proceed()
        idle = self._fault if self._fault != Code.SUCCESS else Code.IDLE
        return Code.ACQUIRING if self.is_acquiring else idle

    def GetNumberNewImages(self) -> tuple[int, int]:
        """Numbers of the first and the last frame that were not fetched."""
        self.proceed()
        new = [number for number in self.buffer if number > self.n_fetched]
        require(new, Code.NO_NEW_DATA)
        return new[0], new[-1]

    def GetImages16(self, first: int, last: int, pixels: int, size: int) -> tuple[int, int]:
        """Copy frames to an address with room for ``size`` pixels."""
        self.hang()
        require(first in self.buffer)
        require(last in self.buffer and last >= first, Code.P2INVALID)
        images = [np.ascontiguousarray(self.buffer[number].image) for number in range(first, last + 1)]
        require(size == sum(image.size for image in images), Code.P4INVALID)
        for image in images:
            ctypes.memmove(pixels, image.ctypes.data, image.nbytes)
            pixels += image.nbytes
        self.n_fetched = max(self.n_fetched, last)
        return first, last

    def GetMetaDataInfo(self, _start: Any, since_start_ms: Any, index: int) -> None:
        """Milliseconds from the start of the series to the start of a frame, counted from 0."""
        require(index + 1 in self.buffer, Code.P2INVALID)
        since_start_ms.contents.value = (self.buffer[index + 1].t_start_s - self.started_s) * 1e3

    def WaitForAcquisitionByHandleTimeOut(self, _handle: int, timeout_ms: int) -> None:
        """Wait in real time for a frame. On a virtual clock it is there already, or does not come."""
        require(self.wait(timeout_ms / 1e3), Code.NO_NEW_DATA)

    def CancelWait(self) -> None:
        """Make a wait return."""
        self.cancel_wait()

    def keep(self, number: int, frame: Frame) -> bool:
        """Put a frame into the ring buffer, unless the computer fails to take it over."""
        if number == self._errors.buffer_error_at:
            self._fault = Code.ACQ_BUFFER
            return False
        return super().keep(number, frame)
