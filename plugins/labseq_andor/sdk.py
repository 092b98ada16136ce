"""One camera behind the SDK: every call selects it, and every failure is a DeviceError."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final, Protocol

from labseq.plugin import DeviceError, LabseqError
from labseq_andor.codes import Code
from labseq_andor.errors import explain

MAX_STOP_S: Final = 0.2
"""How long to wait for a call that hangs, before the camera is stopped all the same, in seconds."""

MAX_CALL_S: Final = 2.0
"""How long to wait for another thread's call to come back, in seconds."""

LINUX_SETTINGS: Final = "/usr/local/etc/andor"
"""Where Andor's installer for Linux puts what Initialize wants to know."""


class ReportsSimulatorErrors(Protocol):
    """A stand-in, which cannot raise through C what its simulated world raised."""

    failure: LabseqError | None


class Sdk:
    """pylablib's camera, and the SDK's functions for what pylablib leaves out.

    Args:
        name: Name of the device, for errors.
        andor: pylablib's module for SDK2, bound to a library.
        stand_in: The simulated camera; None for a real one.

    Attributes:
        camera: pylablib's ``AndorSDK2Camera``, open.
        capabilities: The SDK's structure of what the camera can do.
    """

    def __init__(self, name: str, andor: Any, stand_in: ReportsSimulatorErrors | None) -> None:
        self._name = name
        self._andor = andor
        self._stand_in = stand_in
        self._lock: Any = vars(andor)["_camsel_lock"]  # the SDK has one selected camera for everybody
        self.camera: Any = None
        self.capabilities: Any = None

    def connect(self, indices: Sequence[int], serial: int, fan: str) -> None:
        """Open the camera with a serial number among some; 0: the only one.

        Raises:
            DeviceError: There is none, or none with this number.
        """
        if not indices:
            text = "no Andor camera is connected; look at its power and its cable, and close Solis"
            raise DeviceError(self._name, text)
        if serial == 0 and len(indices) > 1:
            text = f"{len(indices)} Andor cameras are connected; say which by `serial`"
            raise DeviceError(self._name, text)
        seen: list[int] = []
        for index in indices:
            self._open(index, fan)
            seen.append(int(self.camera.device_info.serial_number))
            if serial in (0, seen[-1]):
                return
            self.attempt(lambda lib: lib.SetCoolerMode(1))  # another's camera stays cold
            self.disconnect()
        numbers = " and ".join(str(number) for number in seen)
        text = f"the connected camera has the serial number {numbers}; expected {serial}"
        raise DeviceError(self._name, f"{text}; change `serial`, or connect the other one")

    def _open(self, index: int, fan: str) -> None:
        folder = "" if sys.platform == "win32" or self._stand_in is not None else LINUX_SETTINGS
        try:
            with self._translated_errors():
                # a number leaves the cooler as it is; without one pylablib would switch it on
                self.camera = self._andor.AndorSDK2Camera(index, folder, temperature=0, fan_mode=fan)
        except (TypeError, ValueError, LookupError) as error:  # it takes much for granted
            text = f"pylablib cannot open this camera: {error}"
            hint = "is it an EMCCD, and Andor's SDK2 of the newest version?"
            raise DeviceError(self._name, f"{text}; {hint}") from error
        self.capabilities = self.camera.capabilities

    def count(self) -> int:
        """How many cameras are connected."""
        with self._translated_errors():
            return int(self._andor.get_cameras_number())

    def version(self) -> str:
        """The SDK's version."""
        with self._translated_errors():
            return str(self._andor.get_SDK_version())

    @contextmanager
    def selected(self) -> Generator[Any]:
        """Within the block, pylablib's SDK functions speak to this camera.

        Raises:
            DeviceError: A function failed, or another thread hangs in one.
        """
        if not self._lock.acquire(timeout=MAX_CALL_S):
            raise DeviceError(self._name, "a call to Andor's SDK does not come back; restart labseq")
        try:
            with self._translated_errors():
                self._select()
                yield self._andor.lib
        finally:
            self._lock.release()

    def attempt(self, *actions: Callable[[Any], object]) -> DeviceError | None:
        """Do several things one after another whatever fails, also while another thread hangs in a call.

        Returns:
            The first failure; None if there was none.
        """
        first: DeviceError | None = None
        is_mine = self._lock.acquire(timeout=MAX_STOP_S)
        try:
            for action in actions:
                try:
                    with self._translated_errors():
                        self._select()
                        action(self._andor.lib)
                except DeviceError as error:
                    first = first or error
        finally:
            if is_mine:
                self._lock.release()
        return first

    def raw(self, function: str, *arguments: Any) -> None:
        """Call a function of the library that pylablib leaves out; within :meth:`selected`."""
        call = getattr(self._andor.lib.lib, function)
        code = int(call(*arguments))
        if code != Code.SUCCESS:
            raise self._andor.AndorSDK2LibError(function, code)

    def wait(self, timeout_s: float) -> bool:
        """Wait for the next frame, with everybody else let through; False if none came."""
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
        """The camera's own time of a frame, counted from 0, in seconds from the start of the series."""
        since_start_ms, start = ctypes.c_float(), (ctypes.c_uint16 * 8)()
        with self.selected():
            arguments = (ctypes.byref(start), ctypes.byref(since_start_ms), index)
            self.raw("GetMetaDataInfo", *arguments)
        return since_start_ms.value / 1e3

    def disconnect(self) -> None:
        """Let the camera go; nothing can be done any more about what fails or hangs."""
        camera, self.camera = self.camera, None
        if camera is not None and self._lock.acquire(timeout=MAX_STOP_S):
            try:
                with suppress(self._andor.AndorError):
                    camera.close()
            finally:
                self._lock.release()

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
            if self._stand_in is not None and (failure := self._stand_in.failure) is not None:
                self._stand_in.failure = None
                raise failure from error
            raise DeviceError(self._name, explain(error)) from error


def code_of(error: DeviceError) -> int:
    """The SDK's code behind an error; 0 if there is none."""
    return int(getattr(error.__cause__, "code", 0))
