"""How the simulated camera acquires series of frames."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, Final

from labseq.plugin import Clock, Frame, Series, SimulatedSensor
from labseq_andor.codes import EXTERNAL_TRIGGER, SOFTWARE_TRIGGER, Code
from labseq_andor.counterpart.calls import answers
from labseq_andor.counterpart.faults import Faults
from labseq_andor.counterpart.frames import FrameBuffer
from labseq_andor.counterpart.timing import Timing
from labseq_andor.counterpart.triggers import INTERNAL_TRIGGER, TriggerSettings

ROUNDING_S: Final = 1e-9


class Acquisition:
    """Starts exposures, and moves each frame into the ring buffer when it has been read.

    Args:
        sensor: Where the pixels come from.
        timing: Exposure and cycle times.
        triggers: What starts exposures.
        clock: The session's clock.
        faults: Failures to rehearse.

    Attributes:
        is_acquiring: Whether a series is on its way.
        buffer: The computer's ring buffer.
        hangs: Set when fetching a frame hangs.
    """

    def __init__(
        self,
        sensor: SimulatedSensor,
        timing: Timing,
        triggers: TriggerSettings,
        clock: Clock,
        faults: Faults,
    ) -> None:
        self._sensor, self._timing, self._triggers = sensor, timing, triggers
        self._clock, self._faults = clock, faults
        self._arrived = threading.Condition()
        self.hangs = threading.Event()
        self.buffer = FrameBuffer()
        self.reset()

    def reset(self) -> None:
        """As after Initialize."""
        self.is_acquiring = False
        self._fault: int = Code.SUCCESS
        self._n_left = 0
        self._is_cancelled = False
        self._coming: deque[tuple[float, Frame]] = deque()
        self._busy_until_s = self._started_s = 0.0
        self._sensor.clear()
        self.buffer.clear(1)

    @answers("PrepareAcquisition", "FreeInternalMemory", only_idle=True)
    def prepare(self) -> int:
        """Empty the ring buffer."""
        self.buffer.clear(self._buffer_size)
        return Code.SUCCESS

    @answers("GetSizeOfCircularBuffer")
    def get_buffer_size(self, number: Any) -> int:
        """Frames that the ring buffer holds."""
        number[0] = self._buffer_size
        return Code.SUCCESS

    @answers("StartAcquisition", only_idle=True)
    def start(self) -> int:
        """Arm the sensor; with the internal trigger the first exposure begins."""
        if not self._timing.reads_images:
            return Code.INVALID_MODE
        self.prepare()
        n_frames = self._triggers.n_frames
        kinds: dict[int, Any] = {INTERNAL_TRIGGER: "internal", EXTERNAL_TRIGGER: "external"}
        timing, mode = self._timing, self._timing.sensor_mode
        series = Series(
            n_frames, timing.exposure_s, kinds.get(self._triggers.trigger, "software"), mode.em_gain or 1.0
        )
        self._sensor.arm(series, mode, timing.readout_s, timing.kinetic_s)
        self._n_left = n_frames
        self.is_acquiring, self._fault, self._is_cancelled = True, Code.SUCCESS, False
        self._started_s = self._busy_until_s = self._clock.now()
        self._coming.clear()
        self.proceed()
        return Code.SUCCESS

    @answers("AbortAcquisition")
    def abort(self) -> int:
        """Stop; what was not read is lost."""
        if not self.is_acquiring:
            return Code.IDLE
        self._finish()
        self._sensor.clear()
        return Code.SUCCESS

    @answers("SendSoftwareTrigger")
    def trigger(self) -> int:
        """Expose; refused during an exposure, or a read-out that cannot overlap with the next exposure."""
        if self._triggers.trigger != SOFTWARE_TRIGGER or not self._triggers.runs_till_abort:
            return Code.INVALID_MODE
        if not self.is_acquiring:
            return Code.IDLE
        if self._is_busy:
            return Code.ERROR_CODES
        self._expose()
        return Code.SUCCESS

    def pulse(self) -> bool:
        """An edge at the trigger input, now.

        Returns:
            Whether it started an exposure; one that comes too soon does not, and nobody is told.
        """
        if (
            not self.is_acquiring
            or self._triggers.trigger != EXTERNAL_TRIGGER
            or self._is_busy
            or not self._n_left
        ):
            return False
        self._expose()
        return True

    @answers("GetStatus")
    def get_status(self, status: Any) -> int:
        """Idle, acquiring, or why the acquisition ended early."""
        self.proceed()
        idle = self._fault if self._fault != Code.SUCCESS else Code.IDLE
        status[0] = Code.ACQUIRING if self.is_acquiring else idle
        return Code.SUCCESS

    @answers("GetAcquisitionProgress")
    def get_progress(self, n_accumulated: Any, n_frames: Any) -> int:
        """Frames so far."""
        self.proceed()
        n_accumulated[0], n_frames[0] = 0, self.buffer.n_arrived
        return Code.SUCCESS

    @answers("GetNumberNewImages")
    def get_new(self, first: Any, last: Any) -> int:
        """Numbers, from 1, of the frames in the ring buffer that were not fetched."""
        self.proceed()
        return self.buffer.put_new(first, last)

    @answers("GetImages16", waits=True)
    def get_images(
        self, first: int, last: int, into: Any, size: int, valid_first: Any, valid_last: Any
    ) -> int:
        """Copy frames."""
        if self._faults.hang is not None:
            self.hangs.set()
            self._faults.hang.wait()
        code = self.buffer.copy(first, last, into, size)
        if code == Code.SUCCESS:
            valid_first[0], valid_last[0] = first, last
        return code

    @answers("SetMetaData", only_idle=True)
    def set_metadata(self, state: int) -> int:
        """Time stamps are always there."""
        return Code.SUCCESS if state in (0, 1) else Code.P1INVALID

    @answers("GetMetaDataInfo")
    def get_time_stamp(self, start: int | None, since_start_ms: Any, index: int) -> int:
        """Milliseconds from the start of the series to that of a frame, counted from 0."""
        del start  # the wall time of the start is not modelled
        t_start_s = self.buffer.t_start_s(index + 1)
        if t_start_s is None:
            return Code.P2INVALID
        since_start_ms[0] = (t_start_s - self._started_s) * 1e3
        return Code.SUCCESS

    @answers("WaitForAcquisitionByHandleTimeOut", waits=True)
    def wait(self, handle: int, timeout_ms: int) -> int:
        """Wait in real time for a frame; on a virtual clock it is there already, or does not come."""
        del handle
        deadline_s = time.monotonic() + timeout_ms / 1e3
        with self._arrived:
            n_before = self.buffer.n_fetched
            while True:
                self.proceed()
                if self.buffer.n_arrived > n_before:
                    return Code.SUCCESS
                left_s = deadline_s - time.monotonic()
                if self._is_cancelled or left_s <= 0:
                    self._is_cancelled = False
                    return Code.NO_NEW_DATA
                self._arrived.wait(min(left_s, self._to_next_s))

    @answers("CancelWait")
    def cancel_wait(self) -> int:
        """Let whoever waits go."""
        with self._arrived:
            self._is_cancelled = True
            self._arrived.notify_all()
        return Code.SUCCESS

    def proceed(self) -> None:
        """Do what is due by now: frames arrive; with the internal trigger the next exposure begins."""
        now_s = self._clock.now() + ROUNDING_S
        while self.is_acquiring:
            if not self._coming and self._triggers.trigger == INTERNAL_TRIGGER:
                self._expose()
            if not self._coming or self._coming[0][0] > now_s:
                return
            self._arrive(self._coming.popleft()[1])

    @property
    def _is_busy(self) -> bool:
        return self._clock.now() < self._busy_until_s - ROUNDING_S

    @property
    def _to_next_s(self) -> float:
        if self._clock.virtual or not self._coming:
            return 1.0
        return max(self._coming[0][0] - self._clock.now(), 1e-4)

    @property
    def _buffer_size(self) -> int:
        height, width = self._timing.frame_shape
        return self._faults.buffer_frames or max(2, 48 * 2**20 // (2 * height * width))

    def _expose(self) -> None:
        self._n_left -= 1
        if self._faults.missed_triggers > 0:
            self._faults.missed_triggers -= 1
            self._sensor.skip()
            return
        frame = self._sensor.expose(self._faults.late_s)
        if frame is None:
            return
        timing = self._timing
        end_s = frame.t_start_s + timing.exposure_s
        self._busy_until_s = end_s if timing.frame_transfer else end_s + timing.readout_s
        with self._arrived:
            self._coming.append((end_s + timing.readout_s + self._faults.late_s, frame))
            self._arrived.notify_all()

    def _arrive(self, frame: Frame) -> None:
        number = self.buffer.n_arrived + 1
        if number == self._faults.unplugged_at:
            self._faults.unplugged = True
        if number == self._faults.buffer_error_at:
            self._fault = Code.ACQ_BUFFER
            self._finish()
            return
        self.buffer.add(frame)
        if not self._n_left and not self._coming:
            self._finish()

    def _finish(self) -> None:
        self.is_acquiring = False
        self._coming.clear()
