"""The driver of a camera with the features of the GenICam standard, for any library."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

from labseq.plugin import CameraFacts, Context, DeviceError, Trigger
from labseq.plugin.camera import CameraDriver, ExposureResult, Series
from labseq_genicam.connection import Connection
from labseq_genicam.features import Features
from labseq_genicam.settings import StandardSettings
from labseq_genicam.standard import (
    TIMED_BY_CAMERA,
    frame_period_s,
    read_exposure_s,
    set_exposure,
    set_trigger,
    set_up,
    temperature_k,
)


class StandardCamera(CameraDriver):
    """A camera with the features of the GenICam standard.

    Attributes:
        connection: The library's access to the camera, or to a simulated one.
        features: The features of the camera, None unless it is open.
    """

    model_name: ClassVar[str]
    """Name of the camera until it has reported its model."""

    def __init__(self, settings: StandardSettings, context: Context, connection: Connection) -> None:
        super().__init__(context, settings.orientation)
        self._settings = settings
        self.connection = connection
        self.features: Features | None = None
        self.reported: dict[str, Any] = {}
        self._exposure_s = math.nan
        self._set_for: Trigger | None = None

    @property
    def facts(self) -> CameraFacts:
        """Read-out time of the settings, and bounds of exposures and frame shape once they are known."""
        settings, connection = self._settings, self.connection
        shape = self.reported.get("frame_shape") or settings.frame_shape(connection.sensor_shape)
        known = connection.min_exposure_s, settings.max_exposure
        shortest_s, longest_s = self.reported.get("exposure_bounds_s", known)
        bounds_s = {"min_exposure_s": shortest_s, "max_exposure_s": min(longest_s, settings.max_exposure)}
        return settings.facts(settings.readout, None if shape is None else (shape[0], shape[1]), **bounds_s)

    def warm(self) -> None:
        """Do slow work that can be done before the camera is opened."""
        self.connection.warm()

    def describe(self) -> Mapping[str, Any]:
        """Settings, and once opened also the camera's report with its present exposure and temperature."""
        described = {**self._settings.model_dump(mode="json"), "model": self.model_name, **self.reported}
        if self.features is not None:
            described["exposure_now_s"] = read_exposure_s(self.features)
            described["temperature_k"] = temperature_k(self.features)
        return described

    def _connect(self) -> None:
        connection, settings, self._set_for = self.connection, self._settings, None
        self.features = features = Features(self._name, connection.open(), connection.doing)
        connection.check_identity(model=settings.model)
        firmware = features.read(str, "DeviceFirmwareVersion", "DeviceVersion") or ""
        self.reported = {**connection.identity(), "firmware": firmware}
        self.reported |= set_up(features, settings, connection.sensor_shape)
        self.reported |= connection.set_packets(features)

    def _disconnect(self) -> None:
        self.features = None
        self.connection.close()

    def _start(self, series: Series) -> None:
        features, settings, connection = self._opened(), self._settings, self.connection
        trigger = connection.trigger_of(series)
        if not connection.goes_on(trigger):
            connection.stop()
            self._set_trigger(features, trigger, series.n_frames)
        # with bulb the pulse is the exposure
        self._exposure_s = (
            series.exposure_s if trigger == "bulb" else set_exposure(features, series.exposure_s)
        )
        period_s = math.nan
        if series.trigger in TIMED_BY_CAMERA:
            period_s = frame_period_s(features, settings, series, trigger)
        connection.arm(series, period_s)
        connection.start(series, trigger)

    def _set_trigger(self, features: Features, trigger: Trigger, n_frames: int) -> None:
        """Choose the trigger of the exposures, which takes tens of commands, unless it is set already.

        Where the camera times them it is set again, since the last frame rate would limit the exposure time.
        """
        if trigger != self._set_for:
            self._set_for = None
            set_trigger(features, self._settings, trigger, n_frames)
            self._set_for = None if trigger in TIMED_BY_CAMERA else trigger

    def _fire(self) -> None:
        self._opened()
        self.connection.trigger()

    def _take(self, timeout_s: float) -> ExposureResult | None:
        self._opened()
        taken = self.connection.wait(timeout_s)
        if taken is None:
            self.connection.check_alive()
        return None if taken is None else replace(taken, exposure_s=self._exposure_s)

    def _end(self) -> None:
        self.connection.clear()
        self.connection.end()

    def _stop(self) -> None:
        self.connection.clear()
        self.connection.stop()

    def _opened(self) -> Features:
        if self.features is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self.features
