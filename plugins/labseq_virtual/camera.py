"""The virtual camera."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from labseq.plugin import CameraFacts, Clock, ConfigError, Context, SensorMode
from labseq.plugin.camera import CameraDriver, ExposureResult, Series, SimulatedSensor, settle
from labseq.plugin.lines import trigger_line
from labseq_virtual.settings import CameraSettings
from labseq_virtual.tweezers import require_simulation

ROOM_K: Final = 293.15
"""Temperature of a sensor whose cooler is off (ours)."""

COLDEST_K: Final = 183.15
"""Lowest temperature that the cooler reaches, -90 degC (ours)."""

SWING: Final = 0.6
"""Phase of the oscillation per time constant, in radians (ours). It overshoots by exp(-pi / 0.6), 0.5 %."""


class Cooler:
    """Brings a sensor to a temperature and keeps it there, as a damped oscillation without noise.

    Args:
        setpoint_k: Temperature, in kelvins. Not reached below :data:`COLDEST_K`.
        clock: The session's clock.
    """

    def __init__(self, setpoint_k: float, clock: Clock) -> None:
        self._end_k = max(setpoint_k, COLDEST_K)
        self._clock = clock
        self._start_s: float | None = None

    def switch_on(self) -> None:
        """Start cooling. No effect if it is on."""
        if self._start_s is None:
            self._start_s = self._clock.now()

    @property
    def temperature_k(self) -> float:
        """Temperature of the sensor now, in kelvins."""
        if self._start_s is None:
            return ROOM_K
        t = (self._clock.now() - self._start_s) / 60.0  # in time constants of 60 s (ours)
        remaining = math.exp(-t) * (math.cos(SWING * t) + math.sin(SWING * t) / SWING)
        return self._end_k + (ROOM_K - self._end_k) * remaining


class VirtualCamera(CameraDriver):
    """Takes frames of the simulation, with the timing and errors of a real camera.

    A frame can be read when its exposure and read-out have passed on the clock. The shutter is open
    and the EM gain is on only during a series. The cooler runs from the first ``open()`` on, even in the
    safe state and when the camera is closed, because warming up takes longer than a run, as in reality.

    Args:
        settings: Region, binning, read-out time, EM gain, cooling and simulated failures.
        context: Clock, random numbers and the simulation.

    Raises:
        ConfigError: There is no simulation, or its sensor has no such region.
        LimitError: Its sensor has no EM register.
    """

    any_thread = True

    def __init__(self, settings: CameraSettings, context: Context) -> None:
        super().__init__(context, settings.orientation)
        self._settings = settings
        self._random = context.random
        self._simulation = require_simulation(context)
        self._sensor = SimulatedSensor(self._simulation, context.clock)
        self._is_wired = trigger_line(context.lines, "camera") is not None
        self._mode = replace(settings.mode, em_gain=settings.em_gain)
        self._idle = replace(
            self._mode, em_gain=None if settings.em_gain is None else 1.0, shutter_open=False
        )
        self._current = self._idle
        self._readout_s, self._frame_shape = settings.readout, None
        if (sensor_shape := self._simulation.sensor_shape) is not None:
            if setting_error := settings.sensor_conflict(sensor_shape):
                raise ConfigError(setting_error)
            self._readout_s *= self._simulation.readout_fraction(self._mode)
            self._frame_shape = settings.frame_shape(sensor_shape)
        self._cooling = cooling = settings.cooling
        self._cooler = None if cooling is None else Cooler(cooling.temperature_k, context.clock)
        self._opened_s = 0.0
        self._pending: deque[tuple[int, bool]] = deque()
        self._n_seen = 0

    @property
    def facts(self) -> CameraFacts:
        """Read-out time (less for a part of the sensor), longest exposure, shape of the frames, EM gain."""
        em_gain = 1.0 if self._settings.em_gain is None else self._settings.em_gain
        triggers = "software", "internal", *(("external", "external_start", "bulb") if self._is_wired else ())
        return self._settings.facts(self._readout_s, self._frame_shape, triggers, em_gain=em_gain)

    def warm(self) -> None:
        """Compute the data shared by all frames, and compile or load their kernels."""
        self._simulation.prepare_sensor(self._mode)

    @property
    def settling_timeout_s(self) -> float:
        """Longest time for cooling, in seconds. 0 without cooling."""
        return 0.0 if self._cooling is None else self._cooling.timeout_s

    def settle(self) -> None:
        """Wait until the sensor is cold.

        Raises:
            DeviceTimeoutError: The sensor does not reach its temperature in time.
            DeviceError: The camera is not open.
        """
        self._check_open()
        if self._cooling is not None:
            settle(self._cooling, lambda: self._temperature_k, self._clock, self._name)

    def describe(self) -> Mapping[str, Any]:
        """Model, settings, and the current shutter, EM gain and temperature in kelvins."""
        mode = self._current
        return {
            "model": "virtual camera",
            **self._settings.model_dump(mode="json"),
            "frame_shape": self._frame_shape,
            "shutter": "open" if mode.shutter_open else "closed",
            "em_gain_now": mode.em_gain,
            "temperature_k": round(self._temperature_k, 2),
        }

    def _connect(self) -> None:
        self._opened_s = self._clock.now()
        if self._cooler is not None:
            self._cooler.switch_on()

    def _disconnect(self) -> None:
        self._stop()

    def _start(self, series: Series) -> None:
        self._current = self._mode_of(series)
        arm_s, cycle_s = self._settings.arming_time, self._settings.cycle_time or 0.0
        self._sensor.arm(series, self._current, self._readout_s, arm_s=arm_s, cycle_s=cycle_s)
        self._pending.clear()
        self._n_seen = 0
        if series.trigger in ("external", "external_start", "bulb"):
            self._sensor.follow_line(self._expose)

    def _fire(self) -> None:
        if self._happens(self._settings.faults.missed_trigger):
            self._sensor.skip()
        else:
            self._expose()

    def _take(self, timeout_s: float) -> ExposureResult | None:
        until_s = self._clock.now() + timeout_s
        while True:
            self._sensor.expose_next(self._expose, max(0.0, until_s - self._clock.now()))
            frame = self._sensor.take(max(0.0, until_s - self._clock.now()))
            if frame is None:
                return None
            number, is_lost = self._pending.popleft()
            if not is_lost:
                break
        if self._happens(self._settings.faults.transient):
            return ExposureResult(number, None, "the frame arrived damaged (simulated failure)")
        t_start_s = frame.t_start_s
        return ExposureResult(
            number, frame.image, t_start_s=t_start_s, device_time_s=t_start_s - self._opened_s
        )

    def _stop(self) -> None:
        self._sensor.clear()
        self._pending.clear()
        self._current = self._idle

    def _expose(self, t_start_s: float | None = None, exposure_s: float | None = None) -> None:
        """Begin the next exposure. If the camera times its exposures, it waits until a frame is read."""
        faults = self._settings.faults
        late_s = faults.late_by if self._happens(faults.late) else 0.0
        is_lost = self._happens(faults.lost_in_series)
        if self._sensor.expose(late_s, t_start_s, exposure_s) is not None:
            self._pending.append((self._n_seen, is_lost))
            self._n_seen += 1

    def _mode_of(self, series: Series) -> SensorMode:
        """The mode, with the simulation's gain if the camera sets none."""
        return self._mode if self._mode.em_gain is None else replace(self._mode, em_gain=series.em_gain)

    @property
    def _temperature_k(self) -> float:
        return ROOM_K if self._cooler is None else self._cooler.temperature_k

    def _happens(self, probability: float) -> bool:
        """Draw a failure. A probability of 0 uses no random number."""
        return probability > 0 and self._random.shot.random() < probability
