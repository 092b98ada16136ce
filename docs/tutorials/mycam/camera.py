"""Cameras of the maker Acme."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from labseq.plugin import CameraFacts, Context, DeviceError, Duration, wait_for
from labseq.plugin.camera import CameraDriver, ExposureResult, OrientationSettings, Series


class MycamSettings(OrientationSettings):
    """Settings in the profile, next to `use: mycam`."""

    serial: str = Field(description="serial number printed on the camera")
    readout: Duration = Field(default=5e-3, description="time to read a frame out")


class MycamCamera(CameraDriver):
    """A camera of Acme, triggered by software.

    Args:
        settings: Which camera.
        context: Its name in the profile, and the session's clock.
    """

    def __init__(self, settings: MycamSettings, context: Context) -> None:
        super().__init__(context, settings.orientation)
        self._settings = settings
        self._camera: Any = None
        self._exposure_s = self._due_s = 0.0

    @property
    def facts(self) -> CameraFacts:
        """What the data sheet says."""
        return CameraFacts(
            self._settings.readout,
            max_exposure_s=60.0,
            frame_shape=self._settings.orientation.shape((512, 512)),
            triggers=("software",),
        )

    def describe(self) -> Mapping[str, Any]:
        """Details for the record of each run."""
        firmware = None if self._camera is None else self._camera.firmware
        return {"model": "Acme", "serial_number": self._settings.serial, "firmware": firmware}

    def _connect(self) -> None:
        from . import acme  # here, so that labseq can list the plugin where the library is missing

        try:
            self._camera = acme.Camera(self._settings.serial)
        except acme.AcmeError as error:
            raise DeviceError(self._name, f"{error}; check `serial` and the cable") from error

    def _disconnect(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _start(self, series: Series) -> None:
        self._exposure_s = series.exposure_s
        self._camera.set_exposure_ms(1e3 * series.exposure_s)
        self._camera.start()

    def _fire(self) -> None:
        self._camera.fire()
        self._due_s = self._clock.now() + self._exposure_s + self._settings.readout

    def _take(self, timeout_s: float) -> ExposureResult | None:
        not_yet_s = min(timeout_s, max(0.0, self._due_s - self._clock.now()))
        self._clock.sleep(not_yet_s)
        frame = wait_for(
            lambda max_wait_s: self._camera.get_frame(1e3 * max_wait_s),
            timeout_s - not_yet_s,
            self._clock,
        )
        if frame is None:
            return None
        number, pixels = frame
        return ExposureResult(number - 1, pixels)

    def _stop(self) -> None:
        self._camera.stop()
