"""pylablib and Andor's library, imported and loaded only when a camera is opened."""

from __future__ import annotations

import ctypes
import importlib
import sys
from functools import lru_cache, partial
from types import SimpleNamespace
from typing import Any, Final

from labseq.plugin import DeviceError
from labseq_andor.counterpart import SimulatedCamera, SimulatedSdk, simulated_sdk

OTHERWISE: Final = "to try things without a camera, set `camera: simulated`"
INSTALL: Final = 'install it with `pip install "labseq[andor]"`'
STAND_IN: Final = "stand-in"
LINUX_LIBRARY: Final = "libandor.so"


def load_pylablib(name: str) -> Any:
    """Import pylablib's module for SDK2, whose ``lib`` is the library that was bound last.

    Args:
        name: Name of the device, for the message.

    Raises:
        DeviceError: It is not installed.
    """
    try:
        return importlib.import_module("pylablib.devices.Andor.AndorSDK2")
    except ModuleNotFoundError as error:
        text = f"the Python package 'pylablib' cannot be imported ({error}); {INSTALL}"
        raise DeviceError(name, f"{text}; {OTHERWISE}") from error


def bind_sdk(name: str, andor: Any, path: str) -> None:
    """Let pylablib call Andor's library.

    Args:
        name: Name of the device, for the message.
        andor: What :func:`load_pylablib` gave.
        path: File of the library; "" for where Andor's installer puts it.

    Raises:
        DeviceError: It is not there, or a simulated camera is open in this process.
    """
    library = None
    if path or sys.platform != "win32":
        try:
            library = _load(path or LINUX_LIBRARY)
        except OSError as error:
            raise _missing(name, path or LINUX_LIBRARY, error) from error
    try:
        _bind(name, andor, path, library)
    except OSError as error:
        raise _missing(name, "atmcd64d.dll", error) from error


def bind_simulator(name: str, andor: Any, *cameras: SimulatedCamera) -> SimulatedSdk:
    """Let pylablib call the stand-in, with cameras attached.

    Raises:
        DeviceError: A real camera is open in this process.
    """
    sdk = simulated_sdk(andor.atmcd32d_lib.define_functions)
    _bind(name, andor, STAND_IN, sdk)
    sdk.attach(*cameras)
    return sdk


def _bind(name: str, andor: Any, key: str, library: Any) -> None:
    """Give pylablib a library; None: let it look for Andor's itself.

    pylablib offers no way to do that, but takes whatever its loader returns.
    """
    control, declarations = andor.libctl, andor.atmcd32d_lib
    with control.lock:
        if getattr(andor.lib, "labseq_key", None) == key:
            return
        if control.get_opened_num():
            text = "another Andor camera is open in this process, by another library"
            raise DeviceError(name, f"{text}; real and simulated ones cannot be used at the same time")
        loader = declarations.load_lib
        fresh = declarations.AndorSDK2Lib()
        if library is not None:
            declarations.load_lib = SimpleNamespace(
                load_lib=partial(_give, library),
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


def _give(library: Any, *_names: Any, **_options: Any) -> Any:
    return library


@lru_cache(maxsize=8)
def _load(path: str) -> Any:
    kind = getattr(ctypes, "WinDLL", ctypes.CDLL)
    return kind(path)


def _missing(name: str, path: str, error: OSError) -> DeviceError:
    text = f"Andor's library '{path}' cannot be loaded ({str(error).splitlines()[0]})"
    what = "install Andor SDK2 or Solis for this system, or give the library's file as `sdk`"
    return DeviceError(name, f"{text}; {what}; {OTHERWISE}")
