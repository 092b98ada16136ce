"""Exposures of a simulated camera whose frames wait in the ring buffer of its vendor's library."""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from labseq.drivers.camera import ExposureResult, Series, SimulatedSensor
from labseq.drivers.waiting import wait_for
from labseq.model import Frame, SensorMode
from labseq.roles import Clock

ROUNDING_S: Final = 1e-9


@dataclass(slots=True)
class CameraFaults:
    """Failures of a simulated camera. They may be changed at any time.

    Attributes:
        not_connected: The camera is not connected.
        held: Another program uses the camera.
        unplugged: The camera no longer answers.
        unplugged_at: Number of the frame, from 1, at which the camera is unplugged. 0 means never.
        missed_triggers: Number of the next triggers that the camera does not see.
        late_s: Delay of each frame, in seconds.
        hang: Fetching a frame does not return until this is set. None means that it returns.
    """

    not_connected: bool = False
    held: bool = False
    unplugged: bool = False
    unplugged_at: int = 0
    missed_triggers: int = 0
    late_s: float = 0.0
    hang: threading.Event | None = None


@dataclass(frozen=True, slots=True)
class ExposureTiming:
    """Times of the exposures of a series.

    Attributes:
        readout_s: From the end of an exposure until its frame can be read, in seconds.
        period_s: From one exposure to the next if the camera times them, in seconds.
        overlaps: Whether the next exposure may begin during the read-out.
        arm_s: Time that starting a series takes, in seconds.
    """

    readout_s: float = 0.0
    period_s: float = 0.0
    overlaps: bool = False
    arm_s: float = 0.0


IDLE: Final = Series(0, 0.0, "software")


class SimulatedExposures:
    """Exposes at triggers, and moves each frame into the ring buffer after its read-out.

    Frames in the ring buffer are numbered from 1. The oldest is overwritten when the buffer is full.

    Args:
        sensor: Source of the pixels.
        clock: The session's clock.
        faults: Failures to simulate.

    Attributes:
        is_acquiring: Whether a series is running.
        buffer: The frames that can be fetched, by their number.
        n_arrived: Number of the newest frame.
        n_fetched: Number of the last frame that was fetched.
        started_s: When the series was started, on the session's clock.
        hangs: Set when fetching a frame hangs.
    """

    def __init__(self, sensor: SimulatedSensor, clock: Clock, faults: CameraFaults) -> None:
        self._sensor, self._clock, self._faults = sensor, clock, faults
        self._arrival = threading.Condition()
        self.hangs = threading.Event()
        self.reset()

    def reset(self) -> None:
        """End any series and forget its frames."""
        self.is_acquiring = False
        self._series, self._timing, self._n_left = IDLE, ExposureTiming(), 0
        self._is_cancelled = False
        self._coming: deque[tuple[float, Frame]] = deque()
        self._busy_until_s = self.started_s = 0.0
        self._cycles_from_s = math.nan
        self._sensor.clear()
        self.empty_buffer()

    def empty_buffer(self, n_frames: int = 1) -> None:
        """Empty the ring buffer, and give it room for ``n_frames``."""
        self.buffer: OrderedDict[int, Frame] = OrderedDict()
        self._buffer_frames = n_frames
        self.n_arrived = self.n_fetched = 0

    def start(self, series: Series, mode: SensorMode, timing: ExposureTiming) -> None:
        """Arm the sensor. With the internal trigger the first exposure begins."""
        self._sensor.arm(series, mode, timing.readout_s, timing.period_s, timing.arm_s)
        self._series, self._timing, self._n_left = series, timing, series.n_frames
        self.is_acquiring, self._is_cancelled = True, False
        self.started_s = self._busy_until_s = self._clock.now()
        self._cycles_from_s = math.nan
        self._coming.clear()
        self.proceed()

    def abort(self) -> None:
        """Stop. Frames that were not read out are lost."""
        self.finish()
        self._sensor.clear()

    def finish(self) -> None:
        """End the series. Frames in the ring buffer stay."""
        self.is_acquiring = False
        self._coming.clear()

    @property
    def is_busy(self) -> bool:
        """True during an exposure, or during a read-out that the next exposure must wait for."""
        return self._is_busy(self._clock.now())

    def pulse(self, t_s: float | None = None, width_s: float = 1e-3) -> bool:
        """Pulse the trigger input, now or at ``t_s`` of the clock. False if that starts no exposure."""
        t_s = self._clock.now() if t_s is None else t_s
        trigger = self._series.trigger
        if not self.is_acquiring or self._n_left == 0 or self._is_busy(t_s):
            return False
        if trigger == "external_start" and math.isnan(self._cycles_from_s):
            self._cycles_from_s = t_s
        elif trigger in ("external", "bulb"):
            self.expose(t_s, width_s if trigger == "bulb" else None)
        else:
            return False
        return True

    @property
    def next_cycle_s(self) -> float:
        """Start of the next exposure after an external start, on the session's clock. Otherwise nan."""
        if not self.is_acquiring or not self._n_left:
            return math.nan
        return self._cycles_from_s + (self._series.n_frames - self._n_left) * self._timing.period_s

    def proceed(self) -> None:
        """Let frames arrive that are due by now, and begin the next exposure if the camera times it."""
        now_s = self._clock.now() + ROUNDING_S
        while self.is_acquiring:
            if not self._coming and self._series.trigger == "internal":
                self.expose()
            if not self._coming and self.next_cycle_s <= now_s:
                self.expose(self.next_cycle_s)
            if not self._coming or self._coming[0][0] > now_s:
                return
            self._arrive(self._coming.popleft()[1])

    def expose(self, t_s: float | None = None, exposure_s: float | None = None) -> None:
        """Begin an exposure, now or at ``t_s``, of ``exposure_s`` seconds or the length in the series."""
        self._n_left -= 1
        if self.is_missed():
            self._sensor.skip()
            return
        frame = self._sensor.expose(self._faults.late_s, t_s, exposure_s)
        if frame is None:
            return
        exposure_s = self._series.exposure_s if exposure_s is None else exposure_s
        end_s, readout_s = frame.t_start_s + exposure_s, self._timing.readout_s
        self._busy_until_s = end_s if self._timing.overlaps else end_s + readout_s
        with self._arrival:
            self._coming.append((end_s + readout_s + self._faults.late_s, frame))
            self._arrival.notify_all()

    def is_missed(self) -> bool:
        """True if the exposure that begins now gives no frame."""
        if self._faults.missed_triggers == 0:
            return False
        self._faults.missed_triggers -= 1
        return True

    def keep(self, number: int, frame: Frame) -> bool:
        """Put a frame that arrives into the ring buffer. False if that fails, which ends the series."""
        self.n_arrived = number
        self.buffer[number] = frame
        if len(self.buffer) > self._buffer_frames:
            self.buffer.popitem(last=False)
        return True

    def wait(self, timeout_s: float) -> bool:
        """Wait in real time for a frame that was not fetched. False if none comes or the wait is cancelled.

        On a virtual clock the frame has already arrived, or never comes.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._arrival:
            while True:
                self.proceed()
                if self.n_arrived > self.n_fetched:
                    return True
                left_s = deadline_s - time.monotonic()
                if self._is_cancelled or left_s <= 0:
                    self._is_cancelled = False
                    return False
                next_s = 1.0
                if self._coming and not self._clock.virtual:
                    next_s = max(self._coming[0][0] - self._clock.now(), 1e-4)
                self._arrival.wait(min(left_s, next_s))

    def cancel_wait(self) -> None:
        """Make a wait in progress return."""
        with self._arrival:
            self._is_cancelled = True
            self._arrival.notify_all()

    def take(self, look: Callable[[float], ExposureResult | None], timeout_s: float) -> ExposureResult | None:
        """Wait on the session's clock until a frame is due, then in real time until the driver sees it.

        Args:
            look: The driver's function that waits for a frame, for at most the given seconds.
            timeout_s: Longest total wait, in seconds.
        """
        clock, start_s = self._clock, self._clock.now()
        expected, due_s = self.n_fetched, self.next_cycle_s
        if due_s > start_s:
            clock.sleep(min(due_s - start_s, timeout_s))
        self.proceed()
        frame = self._sensor.take(max(0.0, timeout_s - (clock.now() - start_s)))
        if frame is None:
            return look(0.0)
        taken = wait_for(look, max(0.0, timeout_s - (clock.now() - start_s)), clock)
        if taken is None:
            return None
        for _ in range(self.n_fetched - expected - 1):  # lost because the ring buffer was overwritten
            frame = self._sensor.take(0.0) or frame
        return replace(taken, t_start_s=frame.t_start_s)

    def hang(self) -> None:
        """Do not return while the fault ``hang`` is on."""
        if self._faults.hang is not None:
            self.hangs.set()
            self._faults.hang.wait()

    def _is_busy(self, t_s: float) -> bool:
        return t_s < self._busy_until_s - ROUNDING_S

    def _arrive(self, frame: Frame) -> None:
        number = self.n_arrived + 1
        if number == self._faults.unplugged_at:
            self._faults.unplugged = True
        if not self.keep(number, frame) or (not self._n_left and not self._coming):
            self.finish()
