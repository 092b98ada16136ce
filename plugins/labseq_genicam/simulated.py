"""Exposures of the simulation for all simulated cameras, on the session's clock."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import replace
from typing import Final

from labseq.plugin import Context, Frame, Trigger, wait_for
from labseq.plugin.camera import ExposureResult, Series, SimulatedSensor
from labseq.plugin.lines import trigger_line
from labseq_genicam.connection import Connection
from labseq_genicam.settings import StandardSettings

MAX_WAIT_S: Final = 5.0
"""How long a simulated camera may take, in real time, for a frame that is due on the session's clock."""


class SimulatedExposures(Connection):
    """Gives the exposures of the simulation to a simulated camera, and waits until their frames are due.

    It comes before the connection of a library among the base classes. The internal trigger and the edges of
    lines in the simulation become software triggers, each at its time and with its picture, because the
    simulated cameras do not wait for a virtual clock and nothing is connected to their lines.
    """

    late_s = 0.0
    """Delay of each frame, in seconds."""

    def __init__(self, settings: StandardSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._world, self._shape = settings.simulated_world(context)
        self.sensor_shape = self._shape
        self._sensor = SimulatedSensor(self._world, context.clock)
        self._is_wired = trigger_line(context.lines, "camera") is not None
        self._forget()

    @abstractmethod
    def show(self, frame: Frame) -> None:
        """Give the camera the picture of a frame, and trigger it."""

    def warm(self) -> None:
        """Compute the common part of all frames."""
        super().warm()
        self._world.prepare_sensor(self._settings.mode)

    def trigger_of(self, series: Series) -> Trigger:
        """The software as trigger, unless edges are expected that never come."""
        is_real = series.trigger not in ("software", "internal") and not self._is_wired
        return series.trigger if is_real else "software"

    def arm(self, series: Series, period_s: float) -> None:
        """Get ready for a series, before the camera starts."""
        self.clear()
        self._series = series
        settings, goes_on = self._settings, self.goes_on(self.trigger_of(series))
        own_period_s = None if math.isnan(period_s) else period_s
        arm_s, cycle_s = 0.0 if goes_on else settings.arming_time, settings.cycle_time or 0.0
        self._sensor.arm(series, settings.mode, settings.readout, own_period_s, arm_s, cycle_s)
        if series.trigger not in ("software", "internal"):
            self._sensor.follow_line(self.expose)

    def trigger(self) -> None:
        """Trigger an exposure, and return when it has begun on the session's clock."""
        self.expose(None, None)

    def expose(self, t_s: float | None, exposure_s: float | None) -> None:
        """Begin an exposure, now or in its turn if no time of the session's clock is given."""
        if self._series is None or self._n_exposed == self._series.n_frames:
            return  # an extra edge
        self.wait_until_ready()
        frame = self._sensor.expose(self.late_s, t_s, exposure_s)
        if frame is not None:
            self._n_exposed += 1
            self.show(frame)

    def wait(self, timeout_s: float) -> ExposureResult | None:
        """Wait on the session's clock until the next frame is due, then in real time until it has come."""
        if self._series is None or self.trigger_of(self._series) != "software":
            return super().wait(timeout_s)
        start_s = self._clock.now()
        self._sensor.expose_next(self.expose, timeout_s)
        left_s = max(0.0, timeout_s - (self._clock.now() - start_s))
        if self._due is None:
            self._take_due(left_s)
        if self._due is None:
            return None
        taken = wait_for(self.poll, max(left_s, MAX_WAIT_S), self._clock)
        return None if taken is None else replace(taken, t_start_s=self._start_s(taken.number))

    def clear(self) -> None:
        """Forget the series."""
        self._sensor.clear()
        self._forget()

    def _forget(self) -> None:
        self._series: Series | None = None
        self._due: Frame | None = None
        self._n_exposed = self._n_due = 0

    def _take_due(self, timeout_s: float) -> None:
        self._due = self._sensor.take(timeout_s)
        self._n_due += self._due is not None

    def _start_s(self, number: int) -> float:
        """When the exposure of a received frame began, on the session's clock, nan if unknown."""
        while self._n_due <= number < self._n_exposed:  # the frames before it never came
            self._take_due(math.inf)
        frame, self._due = self._due, None
        return math.nan if frame is None or self._n_due != number + 1 else frame.t_start_s
