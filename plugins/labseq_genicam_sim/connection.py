"""The simulated camera as the driver uses it: exposures of the simulation, on the session's clock."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from labseq_genicam.acquisition import Acquisition
from labseq_genicam.connection import CameraConnection, translated_errors
from labseq_genicam.settings import GenicamSettings
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError, Frame, Trigger
from labseq.plugin.camera import ExposureResult, Series, SimulatedSensor
from labseq.plugin.lines import trigger_line
from labseq_genicam_sim.description import EXPOSURE_US
from labseq_genicam_sim.fake import FakeCamera
from labseq_genicam_sim.messages import Exposure, Faults

MAX_WAIT_S: Final = 5.0
"""How long the simulated camera may take to begin an exposure, and to send its frame, in real time."""

PACKET_SIZE: Final = 15800
"""Bytes of the packets if the settings name no size: large, since each packet takes the same time."""


class SimulatedConnection(CameraConnection):
    """A GigE Vision camera in a separate process that shows the simulation."""

    def __init__(self, settings: GenicamSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._world, self._shape = settings.simulated_world(context)
        self.sensor_shape = self._shape
        self.min_exposure_s = 1e-6 * EXPOSURE_US[0]
        self.packet_size = settings.packet_size or PACKET_SIZE
        self._clock = context.clock
        self._is_wired = trigger_line(context.lines, "camera") is not None
        self._mode = settings.mode
        self._readout_s = settings.readout
        self._arm_s = settings.arming_time
        self._late_s = settings.faults.late_by
        self._ignores_triggers = settings.faults.ignores_triggers
        self._made: deque[Frame | None] = deque()
        self._sensor = SimulatedSensor(self._world, context.clock)
        self._fake = FakeCamera(
            self._expose,
            sensor_shape=self._shape,
            faults=Faults(**settings.faults.model_dump()),
        )
        self._acquisition: Acquisition | None = None
        self._series: Series | None = None
        self._edge_s: float | None = None
        self._width_s: float | None = None
        self._cycle_s = settings.cycle_time or 0.0
        self._due: Frame | None = None
        self._n_exposed = self._n_due = 0

    def warm(self) -> None:
        """Compute what all frames have in common."""
        self._world.prepare_sensor(self._mode)

    def open(self) -> str:
        """Start the camera's process; returns its IP address."""
        with translated_errors(self._name, "start the simulated camera"):
            self._fake.start()
        return self._fake.address

    def close(self) -> None:
        """End the camera's process."""
        self.clear()
        self._fake.stop()

    def trigger_of(self, series: Series) -> Trigger:
        """What starts the camera's exposures.

        A camera that runs without a trigger does not wait for a virtual clock, and edges of lines come from
        the simulation: in both cases the camera is triggered by software at the right time.
        """
        is_timed = series.trigger == "internal" and self._clock.virtual
        by_line = series.trigger not in ("software", "internal") and self._is_wired
        return "software" if is_timed or by_line else series.trigger

    def arm(self, series: Series, period_s: float, acquisition: Acquisition) -> None:
        """Get ready for a series, before the camera starts."""
        self.clear()
        self._series, self._acquisition = series, acquisition
        arm_s = 0.0 if acquisition.is_running else self._arm_s
        own_period_s = None if math.isnan(period_s) else period_s
        self._sensor.arm(series, self._mode, self._readout_s, own_period_s, arm_s, self._cycle_s)
        if series.trigger not in ("software", "internal"):
            self._sensor.follow_line(self._fire_at)

    def fire(self, acquisition: Acquisition) -> None:
        """Trigger an exposure, and return when it has begun on the session's clock.

        Its image is made before the trigger is sent: the camera answers nothing while it waits for an image,
        and on a busy computer it would seem to be gone.
        """
        n, n_stops = self._fake.n_made, self._fake.n_stops
        if not self._ignores_triggers:
            self._made.append(self._sensor.expose(self._late_s, self._edge_s, self._width_s))
        acquisition.fire()
        if not self._fake.wait_for_image(n, MAX_WAIT_S, n_stops):
            self._made.clear()  # its frame will be missing
        self._fake.raise_pending()

    def wait(self, wait: Callable[[float], ExposureResult | None], timeout_s: float) -> ExposureResult | None:
        """Wait on the session's clock until the next frame is due, then in real time until it has come."""
        max_wait_s = self._wait_until_due(timeout_s)
        taken = None if max_wait_s is None else wait(max_wait_s)
        self._fake.raise_pending()
        return None if taken is None else replace(taken, t_start_s=self._start_s(taken.number))

    def clear(self) -> None:
        """Forget the series; a trigger in another thread waits no longer."""
        self._fake.note_stop()
        self._sensor.clear()
        self._made.clear()
        self._series = self._edge_s = self._width_s = self._due = None
        self._n_exposed = self._n_due = 0

    def _wait_until_due(self, timeout_s: float) -> float | None:
        """Returns how long the frame may then take, in seconds of real time; None if it is not due."""
        series = self._series
        if series is None or self._acquisition is None:
            return None
        if self.trigger_of(series) != "software":
            return timeout_s  # only the camera knows when it exposes
        start_s = self._clock.now()
        self._sensor.expose_next(self._fire_at, timeout_s)
        timeout_s = max(0.0, timeout_s - (self._clock.now() - start_s))
        if self._due is None:
            self._take(timeout_s)
        return None if self._due is None else max(timeout_s, MAX_WAIT_S)

    def _start_s(self, number: int) -> float:
        """When the exposure of a received frame began, on the session's clock; nan if unknown."""
        while self._n_due <= number < self._n_exposed:  # the frames before it never came
            self._take(math.inf)
        frame, self._due = self._due, None
        return math.nan if frame is None or self._n_due != number + 1 else frame.t_start_s

    def _take(self, timeout_s: float) -> None:
        self._due = self._sensor.take(timeout_s)
        self._n_due += self._due is not None

    def _fire_at(self, t_s: float | None, exposure_s: float | None) -> None:
        """Begin an exposure at a time of the session's clock, None for now or its turn."""
        if self._acquisition is not None:
            self._edge_s, self._width_s = t_s, exposure_s
            self.fire(self._acquisition)

    def _expose(self, exposure: Exposure) -> NDArray[np.uint16]:
        """What the sensor sees; black if no exposure is armed. Called by the camera's own thread."""
        if self._series is not None:
            self._check(exposure)
        frame = self._made.popleft() if self._made else self._sensor.expose(self._late_s, self._edge_s)
        if frame is None:
            return np.zeros((exposure.height, exposure.width), np.uint16)
        self._n_exposed += 1
        return frame.image

    def _check(self, exposure: Exposure) -> None:
        """Raise if the camera is not set to what the simulation shows."""
        binning, (y, x) = self._mode.binning, (self._mode.region or (0, 0))[:2]
        height, width = self._mode.frame_shape(self._shape)
        wanted = (y // binning, x // binning, height, width, (binning, binning), (0, 0))
        came = (
            exposure.y,
            exposure.x,
            exposure.height,
            exposure.width,
            (exposure.binning_y, exposure.binning_x),
            (exposure.reverse_y, exposure.reverse_x),
        )
        if came != wanted:
            text = f"the camera reads (y, x, height, width, binning, reverse) = {came}; expected {wanted}"
            raise DeviceError(self._name, text)
