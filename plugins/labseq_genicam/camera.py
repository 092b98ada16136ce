"""GigE Vision and USB3 Vision cameras."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Final

from labseq_aravis import library_version

from labseq.plugin import CameraFacts, Context, DeviceError, wait_for
from labseq.plugin.camera import CameraDriver, ExposureResult, Series
from labseq_genicam.acquisition import Acquisition
from labseq_genicam.connection import Link, connection_for
from labseq_genicam.settings import GenicamSettings
from labseq_genicam.setup import identify, set_up, temperature_k

CHECK_PERIOD_S: Final = 0.5
"""Time without a frame after which the driver checks whether the camera still answers, in seconds."""


class GenicamCamera(CameraDriver):
    """A GigE Vision or USB3 Vision camera.

    Raises:
        ConfigError: The simulated camera is chosen, but there is no simulation, or its sensor has no such
            region.
    """

    def __init__(self, settings: GenicamSettings, context: Context) -> None:
        super().__init__(context, settings.orientation)
        self._settings = settings
        self._connection = connection_for(settings, context)
        self._link: Link | None = None
        self._acquisition: Acquisition | None = None
        self._reported: dict[str, Any] = {}

    @property
    def facts(self) -> CameraFacts:
        """Read-out time of the settings; bounds of exposures and frame shape as soon as they are known."""
        shape = self._reported.get("frame_shape") or self._settings.frame_shape(self._connection.sensor_shape)
        known = self._connection.min_exposure_s, self._settings.max_exposure
        shortest_s, longest_s = self._reported.get("exposure_bounds_s", known)
        bounds_s = {"min_exposure_s": shortest_s, "max_exposure_s": min(longest_s, known[1])}
        return self._settings.facts(self._settings.readout, shape, **bounds_s)

    def warm(self) -> None:
        """Do slow work that can be done before the camera is opened."""
        self._connection.warm()

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Those of libaravis and the camera; no real camera was tried."""
        return {
            "libaravis": (library_version(), "0.8.26"),
            "firmware": (self._reported.get("firmware", ""), ""),
        }

    def describe(self) -> Mapping[str, Any]:
        """Settings; once opened, also what the camera reports, and its temperature in kelvins."""
        described = {**self._settings.model_dump(mode="json"), "model": "GenICam camera", **self._reported}
        if self._link is not None:
            with self._link.doing("read its state") as camera:
                described["exposure_now_s"] = camera.exposure_s
                described["temperature_k"] = temperature_k(camera)
        return described

    def _connect(self) -> None:
        settings = self._settings
        name = self._connection.open()
        self._link = link = Link(self._name, name)
        self._reported = identify(link, settings) | set_up(link, settings, self._connection.packet_size)
        self._acquisition = Acquisition(link, settings)

    def _disconnect(self) -> None:
        link, self._link, self._acquisition = self._link, None, None
        try:
            if link is not None:
                link.close()
        finally:
            self._connection.close()

    def _start(self, series: Series) -> None:
        acquisition, trigger = self._opened(), self._connection.trigger_of(series)
        period_s = acquisition.prepare(series, trigger)
        self._connection.arm(series, period_s, acquisition)
        acquisition.begin(trigger)

    def _fire(self) -> None:
        self._connection.fire(self._opened())

    def _take(self, timeout_s: float) -> ExposureResult | None:
        return self._connection.wait(self._wait, timeout_s)

    def _wait(self, timeout_s: float) -> ExposureResult | None:
        """Wait for a frame, and check from time to time whether the camera still answers."""
        acquisition, link, checked_s = self._opened(), self._link, time.monotonic()
        assert link is not None

        def poll(longest_s: float) -> ExposureResult | None:
            nonlocal checked_s
            taken = acquisition.poll(longest_s)
            if taken is None and time.monotonic() - checked_s >= CHECK_PERIOD_S:
                link.check_alive()
                checked_s = time.monotonic()
            return taken

        taken = wait_for(poll, timeout_s, self._clock)
        if taken is None:
            link.check_alive()
        return taken

    def _end(self) -> None:
        """The acquisition may continue: whether it does depends on the next series."""
        self._connection.clear()

    def _stop(self) -> None:
        self._connection.clear()
        self._opened().stop()

    def _opened(self) -> Acquisition:
        if self._acquisition is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._acquisition
