"""Cameras that pylablib drives."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from labseq.plugin import CameraFacts, ConfigError, Context, DeviceError
from labseq.plugin.camera import ExposureResult, Series
from labseq.plugin.sdk_camera import SdkCamera, without_rounding
from labseq.plugin.units import ZERO_CELSIUS_K
from labseq_pylablib.connection import RawFrame
from labseq_pylablib.interfaces import connection_for
from labseq_pylablib.settings import PylablibSettings

ROUNDING = 1e-3
"""Relative difference of exposures that counts as rounding, since cameras expose for whole rows."""


class PylablibCamera(SdkCamera):
    """A camera through pylablib (Hamamatsu DCAM, Andor SDK3, PICam, Photometrics, PCO).

    These cameras have no EM gain here, and no shutter. The cooler stays on in the safe state and after the
    camera is closed.

    Attributes:
        connection: The camera through its vendor's library, or a simulated one.

    Raises:
        ConfigError: The region does not fit the sensor, or the simulated camera has no simulation.
    """

    def __init__(self, settings: PylablibSettings, context: Context) -> None:
        super().__init__(settings, settings.cooling, context)
        self._settings = settings
        self.connection = connection_for(settings, context)
        self._sensor_shape = self.connection.sensor_shape
        if self._sensor_shape is not None and (conflict := settings.sensor_conflict(self._sensor_shape)):
            raise ConfigError(conflict)
        self._readout_s = self.connection.expected_readout_s
        self._triggers: tuple[str, ...] | None = None
        self._reported: dict[str, Any] = {}
        self._set_for: tuple[str, float] | None = None
        self._exposure_s = math.nan
        self._first_stamp: int | None = None

    @property
    def facts(self) -> CameraFacts:
        """Limits of the camera. Read-out time and triggers are the camera's once it was opened."""
        shape = self._settings.frame_shape(self._sensor_shape)
        if self._triggers is None:
            return self._settings.facts(self._readout_s, shape)
        return self._settings.facts(self._readout_s, shape, self._triggers)

    def warm(self) -> None:
        """Import pylablib."""
        self.connection.warm()

    def describe(self) -> Mapping[str, Any]:
        """Settings, and once opened also the camera's report and its temperature."""
        settings = self._settings.model_dump(mode="json")
        described = {**settings, "model": self._settings.model or "camera of pylablib", **self._reported}
        described |= {"readout_s": self._readout_s, "frame_shape": self.facts.frame_shape}
        if self._is_open:
            described["temperature_k"] = None
            with suppress(DeviceError):  # some cameras tell it only between series
                described["temperature_k"] = round(self._read_temperature_k(), 2)
        return described

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Version of the firmware. No real camera was tried."""
        return {"firmware": (self._reported.get("firmware", ""), "")}

    # open and close

    def _connect(self) -> None:
        connection, self._set_for = self.connection, None
        connection.open()
        self._reported = connection.set_up()
        height, width = self._reported["sensor_shape"]
        self._sensor_shape = (height, width)
        with connection.doing():
            self._readout_s = connection.readout_s
            triggers = connection.triggers()
        self._check_line_trigger(triggers)
        self._triggers = triggers

    def _disconnect(self) -> None:
        self.connection.close()

    def _read_temperature_k(self) -> float:
        with self.connection.doing():
            celsius = self.connection.read_temperature_c()
        if celsius is None:
            raise DeviceError(self._name, "this camera does not tell the temperature of its sensor")
        return celsius + ZERO_CELSIUS_K

    # a series

    def _start(self, series: Series) -> None:
        self.connection.stop()
        self._set_series(series)
        self._first_stamp = None
        self.connection.start(series.n_frames)

    def _set_series(self, series: Series) -> None:
        """Set trigger and exposure, unless they are set already.

        After an external start they are set again, because the start makes DCAM cameras change their source.
        """
        wanted = series.trigger, series.exposure_s
        if wanted == self._set_for:
            return
        self._set_for = None
        connection, exposure_s = self.connection, series.exposure_s
        with connection.doing() as camera:
            connection.set_trigger(series.trigger)
            if series.trigger != "bulb":  # the line makes it, whatever is set
                made_s = float(camera.set_exposure(exposure_s))
                exposure_s = without_rounding(made_s, exposure_s, ROUNDING)
            self._check_exposure(exposure_s, series.exposure_s, "the camera cannot make a shorter one")
            if series.trigger == "external_start":
                self._check_cycle(connection.set_cycle(self.facts.cycle_s))
        self._exposure_s = exposure_s
        self._set_for = None if series.trigger == "external_start" else wanted

    def _fire(self) -> None:
        self.connection.fire()

    def _take(self, timeout_s: float) -> ExposureResult | None:
        return self.connection.take(self._look, timeout_s)

    def _look(self, wait_s: float) -> ExposureResult | None:
        """Read the oldest frame, and wait for it for at most ``wait_s`` seconds."""
        frame = self.connection.read()
        if frame is None and wait_s > 0:
            if fault := self.connection.wait_in_sdk(wait_s):
                return ExposureResult(self._n_read, None, fault)
            frame = self.connection.read()
        return None if frame is None else self._numbered(frame)

    def _numbered(self, frame: RawFrame) -> ExposureResult:
        """Number a frame as the camera does, from 0, so that a lost frame leaves a gap."""
        number = frame.index
        if frame.stamp is not None:
            if self._first_stamp is None:
                self._first_stamp = frame.stamp - frame.index
            number = frame.stamp - self._first_stamp
        return ExposureResult(number, frame.image, exposure_s=self._exposure_s, device_time_s=frame.time_s)

    def _stop(self) -> None:
        self.connection.stop()
