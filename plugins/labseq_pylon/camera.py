"""The driver."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import replace
from typing import Any, Final

from labseq.plugin import (
    CameraDriver,
    CameraFacts,
    Context,
    DeviceError,
    ExposureResult,
    Series,
    Trigger,
    wait_for,
)
from labseq_pylon.acquisition import READY_S, Acquisition
from labseq_pylon.emulation import EmulatedCamera, shown
from labseq_pylon.finding import find_camera, open_camera
from labseq_pylon.library import Sdk, load_pypylon
from labseq_pylon.nodes import Nodes
from labseq_pylon.sensor import sensor_shape
from labseq_pylon.settings import SIMULATED, PylonSettings
from labseq_pylon.setup import identify, set_up, temperature_k

MAX_WAIT_S: Final = 5.0
"""How long the emulated camera may take for a frame that is due on the session's clock, and until it would
see a trigger, in seconds: it has no more of a busy computer than others have."""


class PylonCamera(CameraDriver):
    """A Basler camera, or the emulated one that sees the simulated world.

    Args:
        settings: Which camera, and how it is set up.
        context: Clock, and the simulated world for the emulated camera.

    Raises:
        ConfigError: The simulated camera is asked for, but there is no simulated world, or its sensor has
            no such region.
    """

    def __init__(self, settings: PylonSettings, context: Context) -> None:
        super().__init__(context)
        self._settings = settings
        self._emulation = EmulatedCamera(settings, context) if settings.camera == SIMULATED else None
        self._sdk: Sdk | None = None
        self._camera: Any = None
        self._nodes: Nodes | None = None
        self._acquisition: Acquisition | None = None
        self._found: dict[str, Any] = {}

    @property
    def facts(self) -> CameraFacts:
        """Read-out time and longest exposure of the settings; shape of the frames as soon as it is known."""
        mode, shape = self._settings.mode, self._found.get("frame_shape")
        if shape is None and self._emulation is not None:
            shape = mode.frame_shape(self._emulation.sensor_shape)
        elif shape is None and mode.region is not None:
            shape = mode.frame_shape(mode.region[2:])
        triggers = ("software", "internal", "external")
        return CameraFacts(self._settings.readout, self._settings.max_exposure, shape, triggers=triggers)

    def warm(self) -> None:
        """Import pylon, which takes seconds; work out what all simulated frames have in common."""
        with suppress(DeviceError):  # open() says what is missing
            load_pypylon(self._name)
        if self._emulation is not None:
            self._emulation.warm()

    def describe(self) -> Mapping[str, Any]:
        """Settings; once opened, also what the camera is, what it took, and its temperature in kelvins."""
        described = {**self._settings.model_dump(mode="json"), "model": "Basler camera", **self._found}
        if self._nodes is not None:
            described["temperature_k"] = temperature_k(self._nodes)
        return described

    def _connect(self) -> None:
        settings = self._settings
        self._sdk = sdk = load_pypylon(self._name)
        device = find_camera(sdk, settings) if self._emulation is None else self._emulation.device(sdk)
        self._camera = camera = open_camera(sdk, device, settings.model)
        self._nodes = nodes = Nodes(sdk, camera.GetNodeMap())
        if self._emulation is not None:
            self._emulation.set_up(nodes)
            shape = self._emulation.sensor_shape
        else:
            shape = sensor_shape(nodes)
        self._found = identify(sdk, camera, nodes) | set_up(sdk, nodes, settings, shape)
        ready_s = READY_S if self._emulation is None else MAX_WAIT_S
        self._acquisition = Acquisition(sdk, camera, nodes, self._clock, ready_s)

    def _disconnect(self) -> None:
        sdk, camera, self._camera = self._sdk, self._camera, None
        self._nodes = self._acquisition = None
        try:
            if sdk is not None and camera is not None:
                # One that pylon does not show any more would leave its pipes open.
                with sdk.doing("close the camera"), shown() if self._emulation else nullcontext():
                    camera.Close()
                    camera.DestroyDevice()
        finally:
            if self._emulation is not None:
                self._emulation.close()

    def _start(self, series: Series) -> None:
        acquisition, settings = self._opened(), self._settings
        acquisition.set_exposure(series.exposure_s)
        acquisition.set_trigger(self._trigger_of(series), settings.trigger_line, settings.trigger_edge)
        if self._emulation is not None:
            self._emulation.arm(series, self._found["pixel_format"])
        acquisition.start(series.n_frames)

    def _fire(self) -> None:
        acquisition = self._opened()
        acquisition.wait_until_ready()
        if self._emulation is None or self._emulation.expose():
            acquisition.trigger()

    def _take(self, timeout_s: float) -> ExposureResult | None:
        acquisition, emulation = self._opened(), self._emulation
        if emulation is None or emulation.waits_for_wire:
            return wait_for(acquisition.poll, timeout_s, self._clock)
        if emulation.runs_by_itself:
            self._fire()
        frame = emulation.wait(timeout_s)
        taken = None if frame is None else wait_for(acquisition.poll, MAX_WAIT_S, self._clock)
        if frame is None or taken is None:
            return None
        emulation.drop(taken.number)
        return replace(taken, t_start_s=frame.t_start_s)

    def _stop(self) -> None:
        if self._emulation is not None:
            self._emulation.clear()
        self._opened().stop()

    def _trigger_of(self, series: Series) -> Trigger:
        """By itself the emulated camera would not wait for its pictures, so it is always triggered."""
        is_ours = self._emulation is not None and series.trigger == "internal"
        return "software" if is_ours else series.trigger

    def _opened(self) -> Acquisition:
        if self._acquisition is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._acquisition
