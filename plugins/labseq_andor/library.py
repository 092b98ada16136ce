"""pylablib and the library that it calls: Andor's, or a simulated one."""

from __future__ import annotations

import ctypes
import importlib
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import lru_cache
from importlib import metadata
from types import SimpleNamespace
from typing import Any, Final

from labseq.plugin import Context, DeviceError, wait_for
from labseq.plugin.camera import ExposureResult
from labseq.plugin.messages import install_hint, missing_package
from labseq_andor.settings import SIMULATED, AndorSettings

OTHERWISE: Final = "to try things without a camera, set `camera: simulated`"
LINUX_LIBRARY: Final = "libandor.so"
LINUX_FOLDER: Final = "/usr/local/etc/andor"
"""Where Andor's installer for Linux puts the files that Initialize reads."""


class AndorLibrary:
    """Andor's library as the driver uses it; the simulated library overrides all of it.

    Attributes:
        head: Head of the camera if it is known before the camera is opened.
        sensor_shape: (height, width) of its sensor, likewise.
        folder: Folder for the SDK's function Initialize.
    """

    def __init__(self, settings: AndorSettings, context: Context) -> None:
        self.head = settings.head
        self.sensor_shape = None if self.head is None else self.head.sensor_shape
        self.folder = "" if sys.platform == "win32" else LINUX_FOLDER
        self._path = settings.sdk
        self._name = context.name or "camera"
        self._clock = context.clock

    def warm(self, em_gain: float) -> None:
        """Do slow work that can be done before the camera is opened."""

    def connect(self, andor: Any) -> tuple[int, ...] | None:
        """Load the library and make pylablib call it.

        Returns:
            Places of the usable cameras in the SDK's list; None for all.
        """
        path, library = self._path, None
        if not path and sys.platform != "win32":
            path = LINUX_LIBRARY
        try:
            if path:
                library = load_file(path)
            bind(self._name, andor, path, library)
        except OSError as error:
            which = f"'{path or 'atmcd64d.dll'}' cannot be loaded ({str(error).splitlines()[0]})"
            what = "install Andor SDK2 or Solis for this system, or give the library's file as `sdk`"
            raise DeviceError(self._name, f"Andor's library {which}; {what}; {OTHERWISE}") from error

    def disconnect(self) -> None:
        """Release what ``connect`` took; legal in any state. Andor's library stays loaded."""

    def wait(self, look: Callable[[float], ExposureResult | None], timeout_s: float) -> ExposureResult | None:
        """Wait for a frame."""
        return wait_for(look, timeout_s, self._clock)


def library_for(settings: AndorSettings, context: Context) -> AndorLibrary:
    """The library that the settings choose."""
    if settings.camera == SIMULATED:
        from labseq_andor_sim import SimulatedAndorLibrary

        return SimulatedAndorLibrary(settings, context)
    return AndorLibrary(settings, context)


def simulated_settings() -> dict[str, str | int] | str:
    """Settings of a simulated camera, or why there is none here."""
    return missing_package("pylablib", "andor") or {"camera": "simulated", "serial": 0}


def load_pylablib(name: str) -> Any:
    """Import pylablib's module for SDK2, whose ``lib`` is the library that was bound last."""
    try:
        with _compiled_on_first_use():
            return importlib.import_module("pylablib.devices.Andor.AndorSDK2")
    except ModuleNotFoundError as error:
        text = f"the Python package 'pylablib' cannot be imported ({error})"
        install = f"install it with {install_hint('andor')}"
        raise DeviceError(name, f"{text}; {install}; {OTHERWISE}") from error


def pylablib_version() -> str:
    """Version of the package, which has two names; "" if it was not installed as one."""
    found = {one.name: one.version for one in metadata.distributions() if one.name.startswith("pylablib")}
    return found.get("pylablib") or found.get("pylablib-lightweight", "")


@contextmanager
def _compiled_on_first_use() -> Generator[None]:
    """With its SDK2, pylablib imports that for SDK3, which compiles a function for a second or two."""
    numba: Any = importlib.import_module("numba")  # which takes long too; pylablib needs it
    njit = numba.njit

    def later(*_signature: Any, **options: Any) -> Any:
        return njit(**options)

    numba.njit = later
    try:
        yield
    finally:
        numba.njit = njit


@lru_cache(maxsize=8)
def load_file(path: str) -> Any:
    """Load a C library from a file."""
    return getattr(ctypes, "WinDLL", ctypes.CDLL)(path)


def bind(name: str, andor: Any, key: str, library: Any) -> None:
    """Make pylablib call a library, or, with None, the one that it finds itself.

    pylablib has no option for this, but it uses whatever its loader returns.
    """
    control, declarations = andor.libctl, andor.atmcd32d_lib

    def return_library(*_names: Any, **_options: Any) -> Any:
        return library

    with control.lock:
        if getattr(andor.lib, "labseq_key", None) == key:
            return
        if control.get_opened_num():
            text = "another Andor camera is open in this process, by another library"
            raise DeviceError(name, f"{text}; real and simulated ones cannot be used at the same time")
        loader, fresh = declarations.load_lib, declarations.AndorSDK2Lib()
        if library is not None:
            declarations.load_lib = SimpleNamespace(
                load_lib=return_library,
                get_program_files_folder=loader.get_program_files_folder,
                par_error_message="",
            )
        try:
            fresh.initlib()
        finally:
            declarations.load_lib = loader
        fresh.labseq_key = key
        andor.lib = control.lib = fresh
        control.initialized = True
