"""The counterpart: Aravis' simulated camera, with the pixels of the simulated world."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    Context,
    DeviceError,
    Frame,
    Series,
    SimulatedSensor,
    trigger_line,
)
from labseq_genicam.acquisition import Acquisition, Start
from labseq_genicam.counterpart.fake import FakeCamera
from labseq_genicam.counterpart.faults import Faults
from labseq_genicam.counterpart.images import Request
from labseq_genicam.link import told
from labseq_genicam.settings import GenicamSettings

MAX_WAIT_S: Final = 5.0
"""How long the simulated camera may take to begin an exposure, and to send its frame, in real time."""


class SimulatedCamera:
    """A GigE Vision camera in a process of its own that shows the simulated world.

    Args:
        settings: Region, binning, read-out time, failures to rehearse.
        context: Clock, simulated world, wires.

    Raises:
        ConfigError: There is no simulated world, it does not know its sensor, or the region is beyond that.
    """

    def __init__(self, settings: GenicamSettings, context: Context) -> None:
        world = settings.simulated_world(context)
        self._name = context.name or "camera"
        self._world = world
        self._clock = context.clock
        self._is_wired = trigger_line(context.lines, "camera") is not None
        self._mode = settings.mode
        self._readout_s = settings.readout
        self._late_s = settings.faults.late_by
        faults = Faults(
            settings.faults.packet_loss,
            settings.faults.failed_frames,
            settings.faults.late_by,
            settings.faults.unplugged_at,
            is_busy=settings.faults.busy,
            ignores_triggers=settings.faults.ignores_triggers,
        )
        self._ignores_triggers = faults.ignores_triggers
        self._made: deque[Frame | None] = deque()
        self._sensor = SimulatedSensor(world, context.clock)
        self._fake = FakeCamera(self._expose, sensor_shape=world.sensor_shape, faults=faults)
        self._acquisition: Acquisition | None = None
        self._series: Series | None = None
        self._edge_s: float | None = None
        self._due: Frame | None = None
        self._n_exposed = self._n_due = 0

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """(height, width) of the simulated sensor."""
        return self._world.sensor_shape

    def warm(self) -> None:
        """Work out what all frames have in common."""
        self._world.prepare_sensor(self._mode)

    def open(self) -> str:
        """Start the camera's process.

        Returns:
            The camera's IP address.

        Raises:
            DeviceError: It does not start.
        """
        with told(self._name, "start the simulated camera"):
            self._fake.start()
        return self._fake.address

    def close(self) -> None:
        """End the camera's process; legal in any state."""
        self.clear()
        self._fake.stop()

    def start_of(self, series: Series) -> Start:
        """What starts the camera's exposures.

        A camera that runs freely does not wait for a virtual clock, and edges of lines come from the
        simulated world: in both cases it is triggered by software when it is time.
        """
        if series.trigger == "internal":
            return "software" if self._clock.virtual else "free"
        return "line" if series.trigger == "external" and not self._is_wired else "software"

    def arm(self, series: Series, period_s: float, acquisition: Acquisition) -> None:
        """Get ready for a series, before the camera starts; ``period_s`` may be nan."""
        self.clear()
        self._series, self._acquisition = series, acquisition
        self._sensor.arm(series, self._mode, self._readout_s, None if math.isnan(period_s) else period_s)
        if series.trigger == "external":
            self._world.wire("camera", self._on_edge)

    def fire(self) -> None:
        """Trigger an exposure, and return when it has begun on the session's clock.

        Its image is made before: a camera that waits for one answers nothing, and on a busy computer it would
        be taken for one that is gone.

        Raises:
            DeviceError: The camera is gone, or the world is further in time already.
        """
        assert self._acquisition is not None
        n = self._fake.n_begun
        if not self._ignores_triggers:
            self._made.append(self._sensor.expose(self._late_s, self._edge_s))
        self._acquisition.fire()
        if not self._fake.wait_for_request(n, MAX_WAIT_S, answered=True):
            self._made.clear()  # its frame will be missed
        self.raise_pending()

    def wait(self, timeout_s: float) -> float | None:
        """Wait on the session's clock until the next frame could be read.

        Returns:
            How long it may then take until it is there, in seconds of real time; None if it is not due.
        """
        series = self._series
        if series is None:
            return None
        if self.start_of(series) != "software":
            return timeout_s  # only the camera knows when it exposes
        if series.trigger == "internal" and self._n_exposed == self._n_due:
            self.fire()
        if self._due is None:
            self._take(timeout_s)
        return None if self._due is None else max(timeout_s, MAX_WAIT_S)

    def start_s(self, number: int) -> float:
        """When the exposure of a frame that has come began, on the session's clock; nan if unknown."""
        while self._n_due <= number < self._n_exposed:  # those before it never came
            self._take(math.inf)
        frame, self._due = self._due, None
        return math.nan if frame is None or self._n_due != number + 1 else frame.t_start_s

    def clear(self) -> None:
        """Forget the series."""
        self._sensor.clear()
        self._made.clear()
        self._series = self._edge_s = self._due = None
        self._n_exposed = self._n_due = 0

    def raise_pending(self) -> None:
        """Raise what went wrong when the world was exposed.

        Raises:
            DeviceError: The world is further in time already, or the camera was set wrongly.
        """
        self._fake.raise_pending()

    def _take(self, timeout_s: float) -> None:
        self._due = self._sensor.take(timeout_s)
        self._n_due += self._due is not None

    def _on_edge(self, t_s: float) -> None:
        """An edge of the line that is wired to the trigger input."""
        if self._series is not None and self._series.trigger == "external":
            self._edge_s = t_s
            self.fire()

    def _expose(self, request: Request) -> NDArray[np.uint16]:
        """What the sensor sees; black where no exposure is armed. Called by the camera's own thread."""
        if self._series is not None:
            self._check(request)
        frame = self._made.popleft() if self._made else self._sensor.expose(self._late_s, self._edge_s)
        if frame is None:
            return np.zeros((request.height, request.width), np.uint16)
        self._n_exposed += 1
        return frame.image

    def _check(self, request: Request) -> None:
        """The camera must have been set to what the world shows."""
        binning, (y, x) = self._mode.binning, (self._mode.region or (0, 0))[:2]
        wanted = (y // binning, x // binning, *self._mode.frame_shape(self.sensor_shape), (binning, binning))
        came = (request.y, request.x, request.height, request.width, request.binning)
        if came != wanted:
            text = f"the camera reads (y, x, height, width, binning) = {came}; expected {wanted}"
            raise DeviceError(self._name, text)
