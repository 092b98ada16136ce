"""Cameras that pylon reaches, how to find and open them, and the acquisition of their frames."""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, Final

import numpy as np
from labseq_genicam.connection import Connection
from labseq_genicam.features import Features, Nodes
from labseq_genicam.settings import SIMULATED

from labseq.plugin import (
    Context,
    DeviceError,
    DeviceTimeoutError,
    LimitError,
    Trigger,
    format_quantity,
    wait_for,
)
from labseq.plugin.camera import ExposureResult, Series
from labseq_pylon.library import PylonNodes, Sdk, load_pypylon
from labseq_pylon.settings import PylonSettings

EMULATION: Final = "BaslerCamEmu"
"""pylon's class of emulated cameras."""

OTHERWISE: Final = "To try things without a camera, set `camera: simulated`"
IN_USE: Final = "close the pylon Viewer and other programs that use it"
READY_S: Final = 1.0
"""How long a camera may take until it accepts a trigger, in seconds."""

NANOSECONDS_PER_S: Final = 1_000_000_000
"""Ticks per second of cameras that do not report their frequency."""
BUFFER_BYTES: Final = 256 * 2**20
"""Memory for frames that were not read yet. A series that needs more reuses its buffers."""
GIGE: Final = "BaslerGigE"
MAX_GIGE_FRAMES: Final = 65535
"""GigE cameras number their frames from 1, with 16 bits."""
NO_NUMBER: Final = 2**64 - 1


def connection_for(settings: PylonSettings, context: Context) -> PylonConnection:
    """The connection that the settings choose."""
    if settings.camera == SIMULATED:
        from labseq_pylon.emulation import EmulatedConnection

        return EmulatedConnection(settings, context)
    return PylonConnection(settings, context)


class PylonConnection(Connection):
    """A camera that pylon reaches.

    Attributes:
        camera: pylon's ``InstantCamera``, None unless it is open.
        ready_s: How long the camera may take until it accepts a trigger, in seconds.
    """

    def __init__(self, settings: PylonSettings, context: Context) -> None:
        super().__init__(settings, context)
        self.camera: Any = None
        self.ready_s = READY_S
        self._sdk: Sdk | None = None
        self._is_gige = False
        self._ticks_per_s = NANOSECONDS_PER_S

    def warm(self) -> None:
        """Import pylon, which takes seconds."""
        with suppress(DeviceError):  # open() reports the missing package
            load_pypylon(self._name)

    def open(self) -> Nodes:
        """Open the camera that the settings name, or else the only one."""
        self._sdk = sdk = load_pypylon(self._name)
        device = self.device(sdk)
        with sdk.doing("open the camera", IN_USE):
            camera = sdk.pylon.InstantCamera(device)
            camera.Open()
        self.camera = camera
        self._is_gige = camera.GetDeviceInfo().GetDeviceClass() == GIGE
        return PylonNodes(sdk, camera.GetNodeMap())

    def device(self, sdk: Sdk) -> Any:
        """Find the camera, and return pylon's device."""
        return find_camera(sdk, self._settings.camera)

    def identity(self) -> Mapping[str, Any]:
        """Model, serial number, class of the device, and pylon's version."""
        info = self.camera.GetDeviceInfo()
        return {
            "model": info.GetModelName(),
            "serial_number": info.GetSerialNumber(),
            "connection": info.GetDeviceClass(),
            "pylon_version": ".".join(map(str, self._opened().pylon.GetPylonVersion()[:3])),
        }

    def set_packets(self, features: Features) -> Mapping[str, Any]:
        """Set size of the packets, and pause between them."""
        settings, only_gige = self._settings, "only GigE cameras have packets; leave out `{}`"
        self._ticks_per_s = features.read(int, "GevTimestampTickFrequency") or NANOSECONDS_PER_S
        if settings.packet_size is not None:
            hint = only_gige.format("packet_size")
            size = features.get("packet size", "GevSCPSPacketSize", hint=hint)
            features.set_integer("packet size", size, settings.packet_size)
        if settings.packet_delay is not None:
            delay = features.get("packet delay", "GevSCPD", hint=only_gige.format("packet_delay"))
            n_ticks = round(settings.packet_delay * self._ticks_per_s)
            features.set_integer("packet delay in ticks", delay, n_ticks)
        return {"packet_size_now": features.read(int, "GevSCPSPacketSize")}

    def close(self) -> None:
        """Release the camera."""
        camera, self.camera = self.camera, None
        if camera is not None:
            with self.doing("close the camera"), self.closing():
                camera.Close()
                camera.DestroyDevice()

    @contextmanager
    def closing(self) -> Generator[None]:
        """The camera is closed within the block."""
        yield

    def doing(self, what: str) -> AbstractContextManager[object]:
        """Turn errors of pylon into errors of labseq."""
        return self._opened().doing(what)

    def check_alive(self) -> None:
        """Raise if the camera is gone, since not every call of pylon fails then."""
        if self.camera.IsCameraDeviceRemoved():
            raise DeviceError(self._name, "the camera no longer answers; check its cable and power")

    def _opened(self) -> Sdk:
        if self._sdk is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._sdk

    # the acquisition

    def start(self, series: Series, trigger: Trigger) -> None:  # noqa: ARG002 - the camera is set to it
        """Queue the buffers and start. With the internal trigger the first exposure begins."""
        if self._is_gige and series.n_frames > MAX_GIGE_FRAMES:
            limit = f"{MAX_GIGE_FRAMES}, the highest frame number of GigE cameras"
            raise LimitError(f"{self._name}: number of frames", series.n_frames, limit)
        self.check_alive()
        with self.doing("start the series"):
            n_buffers = BUFFER_BYTES // max(1, self.camera.PayloadSize.GetValue())
            self.camera.MaxNumBuffer.SetValue(max(2, min(series.n_frames, n_buffers)))
            self.camera.StartGrabbingMax(series.n_frames, self._opened().pylon.GrabStrategy_OneByOne)

    def wait_until_ready(self) -> None:
        """Wait until the camera accepts a trigger."""
        camera, pylon = self.camera, self._opened().pylon

        def ready(seconds: float) -> bool | None:
            self.check_alive()
            return (
                camera.WaitForFrameTriggerReady(_milliseconds(seconds), pylon.TimeoutHandling_Return) or None
            )

        with self.doing("trigger"):
            can_tell = camera.CanWaitForFrameTriggerReady()
            if can_tell and wait_for(ready, self.ready_s, self._clock) is None:
                text = f"not ready for a trigger within {format_quantity(self.ready_s, 'time')}"
                hint = "leave more time between exposures than the camera needs to read a frame"
                raise DeviceTimeoutError(self._name, f"{text}; {hint}", self.ready_s)

    def fire(self) -> None:
        """Send a software trigger."""
        with self.doing("trigger"):
            self.camera.ExecuteSoftwareTrigger()

    def poll(self, seconds: float) -> ExposureResult | None:
        """Wait for the next buffer, for at most ``seconds``. None if none came."""
        with self.doing("read a frame"):
            handling = self._opened().pylon.TimeoutHandling_Return
            result = self.camera.RetrieveResult(_milliseconds(seconds), handling)
            if not result.IsValid():
                self.check_alive()
                return None
            try:
                return self._taken(result)
            finally:
                result.Release()

    def stop(self) -> None:
        """End the acquisition. Unread frames are dropped."""
        with self.doing("stop"):
            self.camera.StopGrabbing()

    def _taken(self, result: Any) -> ExposureResult:
        number = result.BlockID - int(self._is_gige)
        if result.BlockID == NO_NUMBER:
            number = result.ImageNumber - 1
        if not result.GrabSucceeded():
            code = f" (0x{result.ErrorCode:08X})" if result.ErrorCode else ""
            return ExposureResult(number, None, f"{result.ErrorDescription.rstrip('. ')}{code}")
        image = np.asarray(result.Array).astype(np.uint16, copy=False)
        time_s = result.TimeStamp / self._ticks_per_s if result.TimeStamp else math.nan
        return ExposureResult(number, image, device_time_s=time_s)


def find_camera(sdk: Sdk, serial: str | None) -> Any:
    """Find the camera with a serial number, or for None the only one.

    Emulated cameras, which pylon lists if the environment variable ``PYLON_CAMEMU`` is set, must be named.

    Returns:
        pylon's device.
    """
    with sdk.doing("search for cameras"):
        factory = sdk.pylon.TlFactory.GetInstance()
        infos = list(factory.EnumerateDevices())
    if serial is not None:
        matches = [info for info in infos if info.GetSerialNumber() == serial]
    else:
        matches = [info for info in infos if info.GetDeviceClass() != EMULATION]
    if len(matches) != 1:
        raise DeviceError(sdk.name, _why_not_one(serial, len(matches), _listed(matches or infos)))
    with sdk.doing("reach the camera", IN_USE):
        return factory.CreateDevice(matches[0])


def _why_not_one(serial: str | None, n_found: int, listed: str) -> str:
    if n_found > 1:
        return f"{n_found} cameras were found: {listed}; name the serial number of one as `camera`"
    if serial is not None:
        text = f"no camera has the serial number '{serial}' (found: {listed or 'none'})"
        return f"{text}; check its cable and power, or name another camera as `camera`"
    text = "no Basler camera was found; check its cable and power"
    return f"{text}, and its network address if it is a GigE camera. {OTHERWISE}"


def _listed(infos: list[Any]) -> str:
    return ", ".join(f"{info.GetModelName()} '{info.GetSerialNumber()}'" for info in infos)


def _milliseconds(seconds: float) -> int:
    return max(1, round(1e3 * seconds))
