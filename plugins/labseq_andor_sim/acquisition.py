"""How the simulated camera acquires series of frames, and the ring buffer that keeps them."""

# ruff: noqa: N802 - the SDK's names, which its manual explains

from __future__ import annotations

import ctypes
import math
import threading
import time
from collections import OrderedDict, deque
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
from labseq_andor_sim.faults import Faults
from labseq_andor_sim.settings import Refused, Timing, require

ROUNDING_S: Final = 1e-9
BUFFER_BYTES: Final = 48 * 2**20
"""Size of the ring buffer (ours)."""
KINDS: Final[dict[int, Trigger]] = {
    INTERNAL: "internal",
    EXTERNAL: "external",
    EXTERNAL_START: "external_start",
    EXTERNAL_EXPOSURE: "bulb",
    SOFTWARE: "software",
}


class Acquisition:
    """Starts exposures, and moves each frame into the ring buffer when it has been read.

    Frames in the ring buffer are numbered from 1; the oldest is overwritten when the buffer is full.

    Args:
        sensor: Source of the pixels.
        timing: Exposure, cycle times and trigger.

    Attributes:
        is_acquiring: Whether a series is running.
        n_fetched: Number of the last frame that was fetched.
        hangs: Set when fetching a frame hangs.
    """

    def __init__(
        self, sensor: SimulatedSensor, timing: Timing, clock: Clock, faults: Faults, arm_s: float = 0.0
    ) -> None:
        self._sensor, self._timing, self._arm_s = sensor, timing, arm_s
        self._clock, self._faults = clock, faults
        self._arrived = threading.Condition()
        self.hangs = threading.Event()
        self.reset()

    def reset(self) -> None:
        """End any series, as Initialize does."""
        self.is_acquiring = False
        self._fault: Code = Code.SUCCESS
        self._n_left = 0
        self._is_cancelled = False
        self._coming: deque[tuple[float, Frame]] = deque()
        self._busy_until_s = self._started_s = 0.0
        self._cycles_from_s = math.nan
        self._sensor.clear()
        self.PrepareAcquisition()

    def PrepareAcquisition(self) -> None:
        """Empty the ring buffer."""
        self._buffer: OrderedDict[int, Frame] = OrderedDict()
        self._n_arrived = self.n_fetched = 0

    @property
    def _buffer_size(self) -> int:
        height, width = self._timing.optics.frame_shape
        return self._faults.buffer_frames or max(2, BUFFER_BYTES // (2 * height * width))

    def StartAcquisition(self) -> None:
        """Arm the sensor; with the internal trigger the first exposure begins."""
        timing, mode = self._timing, self._timing.sensor_mode
        require(timing.optics.reads_images, Code.INVALID_MODE)
        is_bulb = timing.trigger == EXTERNAL_EXPOSURE
        require(not (is_bulb and timing.optics.frame_transfer), Code.INVALID_MODE)
        self.PrepareAcquisition()
        series = Series(timing.n_frames, timing.exposure_s, KINDS[timing.trigger], mode.em_gain or 1.0)
        self._sensor.arm(series, mode, timing.readout_s, timing.kinetic_s, self._arm_s)
        self._n_left = timing.n_frames
        self.is_acquiring, self._fault, self._is_cancelled = True, Code.SUCCESS, False
        self._started_s = self._busy_until_s = self._clock.now()
        self._cycles_from_s = math.nan
        self._coming.clear()
        self.proceed()

    def AbortAcquisition(self) -> None:
        """Stop; frames that were not read out are lost."""
        require(self.is_acquiring, Code.IDLE)
        self._finish()
        self._sensor.clear()

    def SendSoftwareTrigger(self) -> None:
        """Expose; refused during an exposure, or a read-out that cannot overlap with the next exposure."""
        require(self._timing.trigger == SOFTWARE and self._timing.runs_till_abort, Code.INVALID_MODE)
        require(self.is_acquiring, Code.IDLE)
        require(not self._is_busy(self._clock.now()), Code.ERROR_CODES)
        self._expose()

    def pulse(self, t_s: float, width_s: float) -> bool:
        """A pulse at the trigger input; False if it started no exposure, since it came too soon."""
        trigger = self._timing.trigger
        if not self.is_acquiring or self._n_left == 0 or self._is_busy(t_s):
            return False
        if trigger == EXTERNAL_START and math.isnan(self._cycles_from_s):
            self._cycles_from_s = t_s
        elif trigger in (EXTERNAL, EXTERNAL_EXPOSURE):
            self._expose(t_s, width_s if trigger == EXTERNAL_EXPOSURE else None)
        else:
            return False
        return True

    @property
    def next_cycle_s(self) -> float:
        """After an external start, when the next exposure begins, on the session's clock; else nan."""
        if not self.is_acquiring or not self._n_left:
            return math.nan
        return self._cycles_from_s + (self._timing.n_frames - self._n_left) * self._timing.kinetic_s

    def GetStatus(self) -> Code:
        """Idle, acquiring, or why the acquisition ended early."""
        self.proceed()
        idle = self._fault if self._fault != Code.SUCCESS else Code.IDLE
        return Code.ACQUIRING if self.is_acquiring else idle

    def GetNumberNewImages(self) -> tuple[int, int]:
        """Numbers of the first and the last frame that were not fetched."""
        self.proceed()
        new = [number for number in self._buffer if number > self.n_fetched]
        require(new, Code.NO_NEW_DATA)
        return new[0], new[-1]

    def GetImages16(self, first: int, last: int, pixels: int, size: int) -> tuple[int, int]:
        """Copy frames to an address with room for ``size`` pixels."""
        if self._faults.hang is not None:
            self.hangs.set()
            self._faults.hang.wait()
        require(first in self._buffer)
        require(last in self._buffer and last >= first, Code.P2INVALID)
        images = [np.ascontiguousarray(self._buffer[number].image) for number in range(first, last + 1)]
        require(size == sum(image.size for image in images), Code.P4INVALID)
        for image in images:
            ctypes.memmove(pixels, image.ctypes.data, image.nbytes)
            pixels += image.nbytes
        self.n_fetched = max(self.n_fetched, last)
        return first, last

    def _set_metadata(self, state: int) -> None:
        """No effect: there are always time stamps."""
        require(state in (0, 1))

    def GetMetaDataInfo(self, _start: Any, since_start_ms: Any, index: int) -> None:
        """Milliseconds from the start of the series to that of a frame counted from 0."""
        require(index + 1 in self._buffer, Code.P2INVALID)
        since_start_ms.contents.value = (self._buffer[index + 1].t_start_s - self._started_s) * 1e3

    def WaitForAcquisitionByHandleTimeOut(self, _handle: int, timeout_ms: int) -> None:
        """Wait in real time for a frame; on a virtual clock it is there already, or does not come."""
        deadline_s = time.monotonic() + timeout_ms / 1e3
        with self._arrived:
            while True:
                self.proceed()
                if self._n_arrived > self.n_fetched:
                    return
                left_s = deadline_s - time.monotonic()
                if self._is_cancelled or left_s <= 0:
                    self._is_cancelled = False
                    raise Refused(Code.NO_NEW_DATA)
                next_s = 1.0
                if self._coming and not self._clock.virtual:
                    next_s = max(self._coming[0][0] - self._clock.now(), 1e-4)
                self._arrived.wait(min(left_s, next_s))

    def CancelWait(self) -> None:
        """Make a wait return."""
        with self._arrived:
            self._is_cancelled = True
            self._arrived.notify_all()

    def proceed(self) -> None:
        """Do what is due by now: frames arrive; where the camera times exposures itself the next begins."""
        now_s = self._clock.now() + ROUNDING_S
        while self.is_acquiring:
            if not self._coming and self._timing.trigger == INTERNAL:
                self._expose()
            if not self._coming and self.next_cycle_s <= now_s:
                self._expose(self.next_cycle_s)
            if not self._coming or self._coming[0][0] > now_s:
                return
            self._arrive(self._coming.popleft()[1])

    def _is_busy(self, t_s: float) -> bool:
        return t_s < self._busy_until_s - ROUNDING_S

    def _expose(self, t_s: float | None = None, exposure_s: float | None = None) -> None:
        self._n_left -= 1
        if self._faults.missed_triggers > 0:
            self._faults.missed_triggers -= 1
            self._sensor.skip()
            return
        frame = self._sensor.expose(self._faults.late_s, t_s, exposure_s)
        if frame is None:
            return
        exposure_s = self._timing.exposure_s if exposure_s is None else exposure_s
        end_s, readout_s = frame.t_start_s + exposure_s, self._timing.readout_s
        self._busy_until_s = end_s if self._timing.optics.frame_transfer else end_s + readout_s
        with self._arrived:
            self._coming.append((end_s + readout_s + self._faults.late_s, frame))
            self._arrived.notify_all()

    def _arrive(self, frame: Frame) -> None:
        number = self._n_arrived + 1
        if number == self._faults.unplugged_at:
            self._faults.unplugged = True
        if number == self._faults.buffer_error_at:
            self._fault = Code.ACQ_BUFFER
            self._finish()
            return
        self._n_arrived = number
        self._buffer[number] = frame
        if len(self._buffer) > self._buffer_size:
            self._buffer.popitem(last=False)
        if not self._n_left and not self._coming:
            self._finish()

    def _finish(self) -> None:
        self.is_acquiring = False
        self._coming.clear()
