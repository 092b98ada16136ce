"""One camera of the SDK. Each call selects it, and each failure is a DeviceError."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from typing import Final

from labseq.plugin import Context, DeviceError, wait_for
from labseq.plugin.camera import ExposureResult
from labseq_andor.codes import Code, Features
from labseq_andor.sdk import AndorError, AndorSdk, Capabilities, load_sdk
from labseq_andor.settings import SIMULATED, AndorSettings

LINUX_FOLDER: Final = b"/usr/local/etc/andor"
"""Where Andor's installer for Linux puts the files that Initialize reads."""

MAX_STOP_S: Final = 0.2
"""How long to wait for a call that hangs before the camera is stopped regardless, in seconds."""

MAX_CALL_S: Final = 2.0
"""How long to wait for another thread's call to return, in seconds."""


def simulated_settings() -> dict[str, str | int]:
    """Settings of a simulated camera."""
    return {"camera": SIMULATED, "serial": 0}


def connection_for(settings: AndorSettings, context: Context) -> AndorConnection:
    """The connection that the settings choose."""
    if settings.camera == SIMULATED:
        from labseq_andor_sim import SimulatedConnection

        return SimulatedConnection(settings, context)
    return AndorConnection(settings, context)


class AndorConnection:
    """A camera through Andor's library. The simulated camera overrides which library that is.

    Attributes:
        name: Name of the camera in the profile.
        settings: Its settings.
        head: Head of the camera if it is known before the camera is opened.
        sensor_shape: (height, width) of its sensor, if known before the camera is opened.
        is_open: Whether the camera is open.
        capabilities: Capabilities of the open camera.
        serial: Its serial number.
    """

    def __init__(self, settings: AndorSettings, context: Context) -> None:
        self.name = context.name or "camera"
        self.settings = settings
        self._clock = context.clock
        self.head = settings.head
        self.sensor_shape = None if self.head is None else self.head.sensor_shape
        self.capabilities = Capabilities()
        self.serial = 0
        self._sdk: AndorSdk | None = None
        self._handle: int | None = None

    @property
    def is_open(self) -> bool:
        """Whether the camera is open."""
        return self._handle is not None

    def warm(self, em_gain: float) -> None:
        """Do slow work that can be done before the camera is opened."""

    def load(self) -> AndorSdk:
        """Andor's library."""
        return load_sdk(self.name, self.settings.sdk)

    def open(self) -> None:
        """Open the camera with the serial number of the settings, the only one for 0."""
        self._sdk, serial, seen = self.load(), self.settings.serial, list[int]()
        with self._translated_errors() as sdk:
            indices = range(sdk.GetAvailableCameras())
        if not indices:
            text = "no Andor camera is connected; check its power and cable, and close Solis"
            raise DeviceError(self.name, text)
        if serial == 0 and len(indices) > 1:
            text = f"{len(indices)} Andor cameras are connected; choose one by `serial`"
            raise DeviceError(self.name, text)
        for index in indices:
            self._initialize(index)
            seen.append(self.serial)
            if serial in (0, self.serial):
                return
            self.attempt(lambda sdk: sdk.SetCoolerMode(1))  # leave the other camera cold
            self._shut_down()
        numbers = " and ".join(str(number) for number in seen)
        text = f"the connected camera has the serial number {numbers}, not {serial}"
        raise DeviceError(self.name, f"{text}; change `serial`, or connect the other camera")

    def _initialize(self, index: int) -> None:
        with self._translated_errors() as sdk, sdk.lock:
            handle = sdk.GetCameraHandle(index)
            sdk.SetCurrentCamera(handle)
            sdk.Initialize(b"" if sys.platform == "win32" else LINUX_FOLDER)
            sdk.n_open += 1
            self._handle = handle
            self.serial = sdk.GetCameraSerialNumber()
            self.capabilities = sdk.GetCapabilities()
            if self.capabilities.ulFeatures & Features.FANCONTROL:
                sdk.SetFanMode(("full", "low", "off").index(self.settings.fan))

    def close(self) -> None:
        """Release the camera, with the cooler as the settings say. Legal in any state."""
        if self._handle is not None:
            self.attempt(self._leave_cooler)
        self._shut_down()

    def _leave_cooler(self, sdk: AndorSdk) -> None:
        keep = self.settings.cooler_after_close == "keep"
        sdk.SetCoolerMode(int(keep))
        if not keep:
            sdk.CoolerOFF()

    def _shut_down(self) -> None:
        """Release the camera. Failures are ignored, since nothing can be done about them."""
        sdk, handle, self._handle = self._sdk, self._handle, None
        if sdk is None or handle is None or not sdk.lock.acquire(timeout=MAX_STOP_S):
            return
        try:
            sdk.n_open -= 1
            if sdk.n_open == 0:  # it releases all cameras
                with suppress(AndorError):
                    sdk.ShutDown()
        finally:
            sdk.lock.release()

    @contextmanager
    def selected(self) -> Generator[AndorSdk]:
        """Within the block, the SDK's functions act on this camera."""
        with self._translated_errors() as sdk:
            if not sdk.lock.acquire(timeout=MAX_CALL_S):
                raise DeviceError(self.name, "a call to Andor's SDK does not return; restart labseq")
            try:
                self._select(sdk)
                yield sdk
            finally:
                sdk.lock.release()

    def attempt(self, *actions: Callable[[AndorSdk], object]) -> DeviceError | None:
        """Run all actions even if some fail, also while another thread hangs in a call.

        Returns:
            The first failure, None if there was none.
        """
        first: DeviceError | None = None
        lock = None if self._sdk is None else self._sdk.lock
        has_lock = lock is not None and lock.acquire(timeout=MAX_STOP_S)
        try:
            for action in actions:
                try:
                    with self._translated_errors() as sdk:
                        self._select(sdk)
                        action(sdk)
                except DeviceError as error:
                    first = first or error
        finally:
            if lock is not None and has_lock:
                lock.release()
        return first

    def wait_in_sdk(self, timeout_s: float) -> bool:
        """Wait for the next frame without blocking other calls. False if none came."""
        try:
            with self._translated_errors() as sdk:
                sdk.WaitForAcquisitionByHandleTimeOut(self._handle, round(timeout_s * 1e3))
        except DeviceError as error:
            if code_of(error) == Code.NO_NEW_DATA:
                return False
            raise
        return True

    def wait(self, look: Callable[[float], ExposureResult | None], timeout_s: float) -> ExposureResult | None:
        """Wait for a frame on the session's clock. None if none came in time."""
        return wait_for(look, timeout_s, self._clock)

    def time_stamp_s(self, index: int) -> float:
        """The camera's time stamp of a frame counted from 0, in seconds from the start of the series."""
        since_start_ms, start = ctypes.c_float(), (ctypes.c_uint16 * 8)()
        with self.selected() as sdk:
            sdk.GetMetaDataInfo(ctypes.pointer(start), ctypes.pointer(since_start_ms), index)
        return since_start_ms.value / 1e3

    def _select(self, sdk: AndorSdk) -> None:
        if self._handle is None:
            raise DeviceError(self.name, "not open; call open() first")
        if sdk.GetCurrentCamera() != self._handle:
            sdk.SetCurrentCamera(self._handle)

    @contextmanager
    def _translated_errors(self) -> Generator[AndorSdk]:
        if self._sdk is None:
            raise DeviceError(self.name, "not open; call open() first")
        try:
            yield self._sdk
        except AndorError as error:
            raise DeviceError(self.name, str(error)) from error


def code_of(error: DeviceError) -> int:
    """The SDK's return code that caused an error, 0 if there is none."""
    return int(getattr(error.__cause__, "code", 0))
