"""Which of the cameras that are connected it is."""

from __future__ import annotations

from typing import Any, Final

from labseq.plugin import DeviceError
from labseq_pylon.library import Sdk
from labseq_pylon.settings import PylonSettings

EMULATION: Final = "BaslerCamEmu"
"""pylon's class of emulated cameras."""

OTHERWISE: Final = "to try things without a camera, set `camera: simulated`"
IN_USE: Final = "another program may have it: close the pylon Viewer"


def find_camera(sdk: Sdk, settings: PylonSettings) -> Any:
    """Find the camera that the settings name, or else the only one.

    Emulated cameras, which pylon shows if the environment variable ``PYLON_CAMEMU`` is set, must be named.

    Returns:
        pylon's device.

    Raises:
        DeviceError: It is not there, or it is not clear which one is meant.
    """
    with sdk.doing("look for cameras"):
        factory = sdk.pylon.TlFactory.GetInstance()
        infos = list(factory.EnumerateDevices())
    if settings.camera is not None:
        found = [info for info in infos if info.GetSerialNumber() == settings.camera]
    else:
        found = [info for info in infos if info.GetDeviceClass() != EMULATION]
    if not found and settings.camera is not None:
        there = _listed(infos) or "no camera at all"
        text = f"no camera has the serial number '{settings.camera}'; found {there}"
        raise DeviceError(sdk.name, f"{text}; look after its cable and power, or name another as `camera`")
    if not found:
        text = "no Basler camera was found; look after its cable and power"
        raise DeviceError(sdk.name, f"{text}, and its network address if it is a GigE camera; {OTHERWISE}")
    if len(found) > 1:
        text = f"{len(found)} cameras were found: {_listed(found)}"
        raise DeviceError(sdk.name, f"{text}; name the serial number of one as `camera`")
    with sdk.doing("reach the camera", IN_USE):
        return factory.CreateDevice(found[0])


def open_camera(sdk: Sdk, device: Any, model: str | None) -> Any:
    """Open a camera, and no other than the one that is meant.

    Args:
        sdk: pylon.
        device: pylon's device.
        model: Model that it must be; None: any.

    Returns:
        pylon's ``InstantCamera``, open.

    Raises:
        DeviceError: It is another model, or cannot be opened.
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
