"""One camera of the SDK: each call selects the camera, and each failure is a DeviceError."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

from labseq.plugin import DeviceError
from labseq_andor.codes import Code, explain

MAX_STOP_S: Final = 0.2
"""How long to wait for a call that hangs before the camera is stopped regardless, in seconds."""

MAX_CALL_S: Final = 2.0
"""How long to wait for another thread's call to return, in seconds."""


class Sdk:
    """pylablib's camera, and the SDK functions that pylablib does not wrap.

    Attributes:
        camera: pylablib's ``AndorSDK2Camera``; None unless it is open.
        capabilities: The SDK's structure of the camera's capabilities.
    """

    def __init__(self, name: str, andor: Any, folder: str) -> None:
        self._name = name
        self._andor = andor
        self._folder = folder
        self._lock: Any = vars(andor)["_camsel_lock"]  # the SDK has one selected camera per process
        self.camera: Any = None
        self.capabilities: Any = None

    def connect(self, indices: Sequence[int] | None, serial: int, fan: str) -> None:
        """Open the camera with a serial number; 0: the only one. ``indices`` are places in the SDK's list."""
        with self._translated_errors():
            indices = range(int(self._andor.get_cameras_number())) if indices is None else indices
        if not indices:
            text = "no Andor camera is connected; look at its power and its cable, and close Solis"
            raise DeviceError(self._name, text)
        if serial == 0 and len(indices) > 1:
            text = f"{len(indices)} Andor cameras are connected; choose one by `serial`"
            raise DeviceError(self._name, text)
        seen: list[int] = []
        for index in indices:
            self._open(index, fan)
            seen.append(int(self.camera.device_info.serial_number))
            if serial in (0, seen[-1]):
                return
            self.attempt(lambda lib: lib.SetCoolerMode(1))  # leave the other camera cold
            self.disconnect()
        numbers = " and ".join(str(number) for number in seen)
        text = f"the connected camera has the serial number {numbers}; expected {serial}"
        raise DeviceError(self._name, f"{text}; change `serial`, or connect the other one")

    def _open(self, index: int, fan: str) -> None:
        try:
            with self._translated_errors():
                # temperature=0 leaves the cooler as it is; without it pylablib would switch the cooler on
                self.camera = self._andor.AndorSDK2Camera(index, self._folder, temperature=0, fan_mode=fan)
        except (TypeError, ValueError, LookupError) as error:  # pylablib does not check what the SDK returns
            text = f"pylablib cannot open this camera: {error}"
            hint = "is it an EMCCD, and Andor's SDK2 of the newest version?"
            raise DeviceError(self._name, f"{text}; {hint}") from error
        self.capabilities = self.camera.capabilities

    def disconnect(self) -> None:
        """Release the camera; failures are ignored, since nothing can be done about them."""
        camera, self.camera = self.camera, None
        if camera is not None and self._lock.acquire(timeout=MAX_STOP_S):
            try:
                with suppress(self._andor.AndorError):
                    camera.close()
            finally:
                self._lock.release()

    @contextmanager
    def selected(self) -> Generator[Any]:
        """Within the block, pylablib's SDK functions act on this camera."""
        if not self._lock.acquire(timeout=MAX_CALL_S):
            raise DeviceError(self._name, "a call to Andor's SDK does not return; restart labseq")
        try:
            with self._translated_errors():
                self._select()
                yield self._andor.lib
        finally:
            self._lock.release()

    def attempt(self, *actions: Callable[[Any], object]) -> DeviceError | None:
        """Run all actions even if some fail, also while another thread hangs in a call.

        Returns:
            The first failure; None if there was none.
        """
        first: DeviceError | None = None
        has_lock = self._lock.acquire(timeout=MAX_STOP_S)
        try:
            for action in actions:
                try:
                    with self._translated_errors():
                        self._select()
                        action(self._andor.lib)
                except DeviceError as error:
                    first = first or error
        finally:
            if has_lock:
                self._lock.release()
        return first

    def raw(self, function: str, *arguments: Any) -> None:
        """Call a function of the library that pylablib does not wrap; within :meth:`selected`."""
        code = int(getattr(self._andor.lib.lib, function)(*arguments))
        if code != Code.SUCCESS:
            raise self._andor.AndorSDK2LibError(function, code)

    def wait(self, timeout_s: float) -> bool:
        """Wait for the next frame without blocking other calls; False if none came."""
        try:
            with self._translated_errors():
                handle = self.camera.handle
                self._andor.lib.WaitForAcquisitionByHandleTimeOut(handle, round(timeout_s * 1e3))
        except DeviceError as error:
            if code_of(error) == Code.NO_NEW_DATA:
                return False
            raise
        return True

    def time_stamp_s(self, index: int) -> float:
        """The camera's time stamp of a frame counted from 0, in seconds from the start of the series."""
        since_start_ms, start = ctypes.c_float(), (ctypes.c_uint16 * 8)()
        with self.selected():
            self.raw("GetMetaDataInfo", ctypes.byref(start), ctypes.byref(since_start_ms), index)
        return since_start_ms.value / 1e3

    def version(self) -> str:
        """The SDK's version."""
        with self._translated_errors():
            return str(self._andor.get_SDK_version())

    def _select(self) -> None:
        if self.camera is None:
            raise DeviceError(self._name, "not connected")
        lib, handle = self._andor.lib, self.camera.handle
        if lib.GetCurrentCamera() != handle:
            lib.SetCurrentCamera(handle)

    @contextmanager
    def _translated_errors(self) -> Generator[None]:
        try:
            yield
        except self._andor.AndorError as error:
            code = getattr(error, "code", None)
            if not isinstance(code, int):
                raise DeviceError(self._name, str(error) or type(error).__name__) from error
            function, code_name = str(getattr(error, "func", "a function")), str(getattr(error, "name", ""))
            raise DeviceError(self._name, explain(function, code, code_name)) from error


def code_of(error: DeviceError) -> int:
    """The SDK's return code that caused an error; 0 if there is none."""
    return int(getattr(error.__cause__, "code", 0))
