"""Basler cameras."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from importlib import metadata
from typing import Any

from labseq.plugin import CameraFacts, Context, DeviceError
from labseq.plugin.camera import CameraDriver, ExposureResult, Series
from labseq_pylon.acquisition import Acquisition
from labseq_pylon.connection import connection_for, open_camera
from labseq_pylon.library import Nodes, Sdk, load_pypylon
from labseq_pylon.settings import PylonSettings
from labseq_pylon.setup import identify, set_up, temperature_k


class PylonCamera(CameraDriver):
    """A Basler camera.

    Raises:
        ConfigError: The simulated camera is chosen, but there is no simulation, or its sensor has no such
            region.
    """

    def __init__(self, settings: PylonSettings, context: Context) -> None:
        super().__init__(context, settings.orientation)
        self._settings = settings
        self._connection = connection_for(settings, context)
        self._sdk: Sdk | None = None
        self._camera: Any = None
        self._nodes: Nodes | None = None
        self._acquisition: Acquisition | None = None
        self._reported: dict[str, Any] = {}

    @property
    def facts(self) -> CameraFacts:
        """Read-out time and longest exposure of the settings; shape of the frames as soon as it is known."""
        shape = self._reported.get("frame_shape") or self._settings.frame_shape(self._connection.sensor_shape)
        return self._settings.facts(self._settings.readout, shape)

    def warm(self) -> None:
        """Import pylon, which takes seconds."""
        with suppress(DeviceError):  # open() reports what is missing
            load_pypylon(self._name)
        self._connection.warm()

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Those of the package, pylon and the camera; no real camera was tried."""
        found = self._reported
        return {
            "package pypylon": (metadata.version("pypylon"), "26.9"),
            "pylon": (found.get("pylon_version", ""), "12.4.2"),
            "firmware": (found.get("firmware") or "", ""),
        }

    def describe(self) -> Mapping[str, Any]:
        """Settings; once opened, also what the camera reports, and its temperature in kelvins."""
        described = {**self._settings.model_dump(mode="json"), "model": "Basler camera", **self._reported}
        if self._nodes is not None:
            described["temperature_k"] = temperature_k(self._nodes)
        return described

    def _connect(self) -> None:
        settings, connection = self._settings, self._connection
        self._sdk = sdk = load_pypylon(self._name)
        self._camera = camera = open_camera(sdk, connection.device(sdk), settings.model)
        self._nodes = nodes = Nodes(sdk, camera.GetNodeMap())
        sensor_shape = connection.set_up(nodes)
        self._reported = identify(sdk, camera, nodes) | set_up(nodes, settings, sensor_shape)
        self._acquisition = Acquisition(sdk, camera, nodes, self._clock, connection.ready_s)

    def _disconnect(self) -> None:
        sdk, camera, self._camera = self._sdk, self._camera, None
        self._nodes = self._acquisition = None
        try:
            if sdk is not None and camera is not None:
                with sdk.doing("close the camera"), self._connection.closing():
                    camera.Close()
                    camera.DestroyDevice()
        finally:
            self._connection.close()

    def _start(self, series: Series) -> None:
        acquisition, settings, connection = self._opened(), self._settings, self._connection
        trigger = connection.trigger_of(series)
        acquisition.set_trigger(trigger, settings.trigger_line, settings.trigger_edge)
        acquisition.set_exposure(series.exposure_s, trigger)
        if trigger == "external_start":
            acquisition.set_cycle(series.n_frames, self.facts.cycle_s)
        connection.arm(series, self._reported["pixel_format"], acquisition)
        acquisition.start(series.n_frames)

    def _fire(self) -> None:
        self._connection.fire(self._opened())

    def _take(self, timeout_s: float) -> ExposureResult | None:
        return self._connection.wait(self._opened(), timeout_s)

    def _stop(self) -> None:
        self._connection.clear()
        self._opened().stop()

    def _opened(self) -> Acquisition:
        if self._acquisition is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._acquisition
