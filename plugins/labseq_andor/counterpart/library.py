"""The library ``atmcd`` in Python: C function pointers that pylablib calls in the place of Andor's."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Final

from labseq.plugin import LabseqError
from labseq_andor.codes import Code
from labseq_andor.counterpart.camera import FUNCTIONS, SimulatedCamera
from labseq_andor.counterpart.texts import put_text

VERSION: Final = "simulated"
FIRST_HANDLE: Final = 100


class SimulatedSdk:
    """Every camera that was attached, behind the functions of Andor's library.

    An instance stands where pylablib expects the loaded library: each function that is modelled is an
    attribute, a true C function pointer, so that arguments and buffers take the same way through ctypes as
    with Andor's. Functions that are not modelled are missing, as from an older library.

    Args:
        define_functions: pylablib's own declaration of the library's functions, made from Andor's header.
    """

    def __init__(self, define_functions: Callable[[Any], None]) -> None:
        declared = _Declarations()
        define_functions(declared)
        self._lock = threading.RLock()
        self._cameras: dict[int, SimulatedCamera] = {}
        self._next_handle = FIRST_HANDLE
        self._current: int | None = None
        self._own: dict[str, Callable[..., int]] = {
            "GetVersionInfo": self._get_version,
            "GetAvailableCameras": self._count,
            "GetCameraHandle": self._handle_of,
            "GetCurrentCamera": self._get_current,
            "SetCurrentCamera": self._set_current,
            "Initialize": self._initialize,
            "ShutDown": self._shut_down,
        }
        for name in sorted(FUNCTIONS | set(self._own)):
            setattr(self, name, self._c_function(name, declared.functions[name]))

    def attach(self, *cameras: SimulatedCamera) -> None:
        """Connect cameras to this computer."""
        with self._lock:
            for camera in cameras:
                self._cameras[self._next_handle] = camera
                self._next_handle += 1

    def detach(self, *cameras: SimulatedCamera) -> None:
        """Take them away."""
        with self._lock:
            self._cameras = {h: camera for h, camera in self._cameras.items() if camera not in cameras}
            if self._current not in self._cameras:
                self._current = None

    def indices(self, cameras: Sequence[SimulatedCamera]) -> tuple[int, ...]:
        """Places of cameras in the SDK's list."""
        return tuple(n for n, handle in enumerate(self._connected) if self._cameras[handle] in cameras)

    @property
    def _connected(self) -> list[int]:
        return [handle for handle, camera in self._cameras.items() if not camera.faults.not_connected]

    def _c_function(self, name: str, signature: SimpleNamespace) -> Any:
        def call(*arguments: Any) -> int:
            return self._call(name, arguments)

        plain = [ctypes.c_void_p if kind is ctypes.c_char_p else kind for kind in signature.argtypes]
        function: Any = ctypes.CFUNCTYPE(ctypes.c_uint, *plain)(call)
        function.__name__ = name
        return function

    def _call(self, name: str, arguments: tuple[Any, ...]) -> int:
        own = self._own.get(name)
        with self._lock:
            if own is not None:
                return int(own(*arguments))
            camera = self._cameras.get(self._current or 0)
            if name.startswith("WaitForAcquisitionByHandle"):
                camera = self._cameras.get(arguments[0])
            if camera is None:
                return Code.NOT_INITIALIZED
            answer = camera.answer(name)
            code = self._guarded(camera, lambda: camera.refusal(answer))
            if code != Code.SUCCESS or not answer.rule.waits:
                return code if code != Code.SUCCESS else self._guarded(camera, answer.call, *arguments)
        return self._guarded(camera, answer.call, *arguments)

    def _guarded(self, camera: SimulatedCamera, call: Callable[..., int], *arguments: Any) -> int:
        try:
            return int(call(*arguments))
        except LabseqError as error:  # nothing can be raised through C
            camera.failure = error
            return Code.GENERAL_ERRORS

    def _count(self, number: Any) -> int:
        number[0] = len(self._connected)
        return Code.SUCCESS

    def _handle_of(self, index: int, handle: Any) -> int:
        if not 0 <= index < len(self._connected):
            return Code.P1INVALID
        handle[0] = self._connected[index]
        return Code.SUCCESS

    def _get_current(self, handle: Any) -> int:
        handle[0] = self._current or 0
        return Code.SUCCESS

    def _set_current(self, handle: int) -> int:
        if handle not in self._cameras:
            return Code.P1INVALID
        self._current = handle
        return Code.SUCCESS

    def _get_version(self, kind: int, text: int, length: int) -> int:
        del kind
        return put_text(text, VERSION, length)

    def _initialize(self, folder: int | None) -> int:
        del folder
        camera = self._cameras.get(self._current or 0)
        return Code.ERROR_NOCAMERA if camera is None else camera.initialize()

    def _shut_down(self) -> int:
        """Let every camera go."""
        codes = [camera.shut_down() for camera in self._cameras.values()]
        return Code.SUCCESS if Code.SUCCESS in codes else Code.NOT_INITIALIZED


class _Declarations:
    """Stands for a library while its functions are declared, and notes how."""

    def __init__(self) -> None:
        self.functions: dict[str, SimpleNamespace] = {}

    def __getattr__(self, name: str) -> SimpleNamespace:
        return self.functions.setdefault(name, SimpleNamespace())


@lru_cache(maxsize=1)
def simulated_sdk(define_functions: Callable[[Any], None]) -> SimulatedSdk:
    """The one stand-in of this process: pylablib keeps the library that it was given."""
    return SimulatedSdk(define_functions)
