"""The sensor of a simulated camera: exposures of the simulated world, on the session's clock."""

from __future__ import annotations

import threading
from collections import deque

from labseq.drivers.series import Series
from labseq.model import Frame, SensorMode
from labseq.roles import Clock, Simulation


class SimulatedSensor:
    """Exposes the simulated world for a camera, and knows when each frame could be read.

    A virtual camera reads its frames here. The simulated counterpart of a real driver takes only the
    pixels from here and sends them on the way that a real camera would; its driver then waits here until
    the frame is due. Exposures may be asked for by another thread than frames.

    Args:
        world: The simulated world.
        clock: The session's clock.
    """

    def __init__(self, world: Simulation, clock: Clock) -> None:
        self._world = world
        self._clock = clock
        self._lock = threading.Lock()
        self._frames: deque[tuple[float, Frame]] = deque()
        self.clear()

    def arm(self, series: Series, mode: SensorMode, readout_s: float, period_s: float | None = None) -> None:
        """Get ready for a series; frames not yet taken are dropped.

        Args:
            series: How many, how long, and what starts them: with the internal trigger the first
                exposure begins now, the others at the ends of the read-outs before.
            mode: How the sensor is read.
            readout_s: From the end of an exposure until its frame can be read, in seconds.
            period_s: With the internal trigger, from one exposure to the next, in seconds; shorter than
                both together where they overlap.
        """
        with self._lock:
            self._frames.clear()
            self._series, self._mode, self._readout_s = series, mode, readout_s
            self._period_s = series.exposure_s + readout_s if period_s is None else period_s
            self._n_exposed = 0
            self._armed_s = self._clock.now()

    def expose(self, late_s: float = 0.0, t_start_s: float | None = None) -> Frame | None:
        """Begin the next exposure of the series.

        Args:
            late_s: How much later than it should its frame is due, in seconds: a failure to rehearse.
            t_start_s: When it begins, on the session's clock; None: now, or with the internal trigger in
                its turn.

        Returns:
            Its frame, which can be read when it is due; None if no further exposure is armed.

        Raises:
            DeviceError: The world is further in time already.
        """
        with self._lock:
            series = self._series
            if series is None or self._n_exposed == series.n_frames:
                return None
            if t_start_s is None and series.trigger == "internal":
                t_start_s = self._armed_s + self._n_exposed * self._period_s
            elif t_start_s is None:
                t_start_s = self._clock.now()
            frame = self._world.expose(t_start_s, series.exposure_s, self._mode)
            self._n_exposed += 1
            self._frames.append((t_start_s + series.exposure_s + self._readout_s + late_s, frame))
            return frame

    def skip(self) -> None:
        """Let an exposure of the series pass without a frame: a trigger that was not seen."""
        with self._lock:
            self._n_exposed += 1

    def take(self, timeout_s: float) -> Frame | None:
        """Wait on the clock for the oldest frame not yet taken.

        Returns:
            None if it is not due within ``timeout_s``, which has passed then.
        """
        with self._lock:
            due_s = self._frames[0][0] if self._frames else float("inf")
        missing_s = due_s - self._clock.now()
        self._clock.sleep(max(0.0, min(missing_s, timeout_s)))
        if missing_s > timeout_s:
            return None
        with self._lock:
            return self._frames.popleft()[1] if self._frames else None

    def clear(self) -> None:
        """Forget the series and its frames."""
        with self._lock:
            self._frames.clear()
            self._series: Series | None = None
            self._mode = SensorMode()
            self._readout_s = self._period_s = self._armed_s = 0.0
            self._n_exposed = 0
