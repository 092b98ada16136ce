"""The connection to a camera: which one it is, and how its exposures start."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Final

from labseq.plugin import Context, DeviceError, Trigger, wait_for
from labseq.plugin.camera import ExposureResult, Series
from labseq_pylon.acquisition import Acquisition
from labseq_pylon.library import Nodes, Sdk
from labseq_pylon.settings import SIMULATED, PixelFormat, PylonSettings
from labseq_pylon.setup import sensor_shape

EMULATION: Final = "BaslerCamEmu"
"""pylon's class of emulated cameras."""

OTHERWISE: Final = "to try things without a camera, set `camera: simulated`"
IN_USE: Final = "another program may use it: close the pylon Viewer"
READY_S: Final = 1.0
"""How long a camera may take until it accepts a trigger, in seconds."""


class CameraConnection:
    """A connected camera; pylon's emulated camera overrides all of it.

    Attributes:
        sensor_shape: (height, width) of the sensor if it is known before the camera is opened.
        ready_s: How long the camera may take until it accepts a trigger, in seconds.
    """

    def __init__(self, settings: PylonSettings, context: Context) -> None:
        self._settings = settings
        self._clock = context.clock
        self.sensor_shape: tuple[int, int] | None = None
        self.ready_s = READY_S

    def warm(self) -> None:
        """Do slow work that can be done before the camera is opened."""

    def device(self, sdk: Sdk) -> Any:
        """Pylon's device for the camera."""
        return find_camera(sdk, self._settings)

    def set_up(self, nodes: Nodes) -> tuple[int, int]:
        """Called when the camera is open; returns (height, width) of its sensor."""
        return sensor_shape(nodes)

    def trigger_of(self, series: Series) -> Trigger:
        """What starts the camera's exposures in a series."""
        return series.trigger

    def arm(self, series: Series, pixel_format: PixelFormat, acquisition: Acquisition) -> None:
        """Called before a series starts."""

    def fire(self, acquisition: Acquisition) -> None:
        """Start an exposure of a series with the software trigger."""
        acquisition.wait_until_ready()
        acquisition.trigger()

    def wait(self, acquisition: Acquisition, timeout_s: float) -> ExposureResult | None:
        """Wait for a frame on the session's clock; None if none came in time."""
        return wait_for(acquisition.poll, timeout_s, self._clock)

    def clear(self) -> None:
        """Forget the series."""

    @contextmanager
    def closing(self) -> Generator[None]:
        """The camera is closed within the block."""
        yield

    def close(self) -> None:
        """Release everything; legal in any state."""


def connection_for(settings: PylonSettings, context: Context) -> CameraConnection:
    """The connection that the settings choose."""
    if settings.camera == SIMULATED:
        from labseq_pylon.emulation import EmulatedCamera

        return EmulatedCamera(settings, context)
    return CameraConnection(settings, context)


def find_camera(sdk: Sdk, settings: PylonSettings) -> Any:
    """Find the camera that the settings name, or else the only one.

    Emulated cameras, which pylon lists if the environment variable ``PYLON_CAMEMU`` is set, must be named.

    Returns:
        pylon's device.
    """
    with sdk.doing("search for cameras"):
        factory = sdk.pylon.TlFactory.GetInstance()
        infos = list(factory.EnumerateDevices())
    if settings.camera is not None:
        found = [info for info in infos if info.GetSerialNumber() == settings.camera]
    else:
        found = [info for info in infos if info.GetDeviceClass() != EMULATION]
    if not found and settings.camera is not None:
        there = _listed(infos) or "no camera at all"
        text = f"no camera has the serial number '{settings.camera}'; found {there}"
        raise DeviceError(sdk.name, f"{text}; check its cable and power, or name another as `camera`")
    if not found:
        text = "no Basler camera was found; check its cable and power"
        raise DeviceError(sdk.name, f"{text}, and its network address if it is a GigE camera; {OTHERWISE}")
    if len(found) > 1:
        text = f"{len(found)} cameras were found: {_listed(found)}"
        raise DeviceError(sdk.name, f"{text}; name the serial number of one as `camera`")
    with sdk.doing("reach the camera", IN_USE):
        return factory.CreateDevice(found[0])


def open_camera(sdk: Sdk, device: Any, model: str | None) -> Any:
    """Open a camera, after checking that it is the right one.

    Returns:
        pylon's ``InstantCamera``, open.
    """
    with sdk.doing("open the camera", IN_USE):
        camera = sdk.pylon.InstantCamera(device)
        info = camera.GetDeviceInfo()
        if model is not None and info.GetModelName() != model:
            text = f"the camera {info.GetSerialNumber()} is an {info.GetModelName()}; expected an {model}"
            raise DeviceError(sdk.name, f"{text}: name another one as `camera`")
        camera.Open()
    return camera


def _listed(infos: list[Any]) -> str:
    return ", ".join(f"{info.GetModelName()} '{info.GetSerialNumber()}'" for info in infos)
