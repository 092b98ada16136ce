"""pylablib, imported only when a camera is opened, and the vendor's library that it calls."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import sys
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import Any, Final

from labseq.plugin import DeviceError
from labseq.plugin.messages import install_hint, missing_package

OTHERWISE: Final = "To try things without a camera, use `interface: dcam` with `camera: simulated`"
_loading: Final = Lock()


@dataclass(frozen=True, slots=True)
class Vendor:
    """Where a vendor's library is, and where pylablib uses it.

    Attributes:
        module: pylablib's module, below ``pylablib.devices``.
        camera: Its class of cameras.
        windows: Name of the library under Windows.
        linux: Name under Linux, "" where pylablib cannot use it.
        source: Package that installs it.
        program: Program of the vendor that must be closed.
    """

    module: str
    camera: str
    windows: str
    linux: str
    source: str
    program: str


DCAM: Final = Vendor(
    "DCAM.DCAM",
    "DCAMCamera",
    "dcamapi.dll",
    "libdcamapi.so",
    "Hamamatsu's DCAM-API (dcam-api.com)",
    "HCImage",
)
SDK3: Final = Vendor(
    "Andor.AndorSDK3", "AndorSDK3Camera", "atcore.dll", "libatcore.so", "Andor SDK3 or Solis", "Solis"
)
PICAM: Final = Vendor(
    "PrincetonInstruments.picam",
    "PicamCamera",
    "picam.dll",
    "libpicam.so",
    "PICam of Princeton Instruments",
    "LightField",
)
PVCAM: Final = Vendor(
    "Photometrics.pvcam",
    "PvcamCamera",
    "pvcam64.dll",
    "libpvcam.so",
    "PVCAM of Teledyne Photometrics",
    "PVCamTest",
)
PCO: Final = Vendor("PCO.SC2", "PCOSC2Camera", "SC2_Cam.dll", "", "pco.sdk or pco.camware", "pco.camware")


def simulated_settings() -> dict[str, str] | str:
    """Settings of the simulated camera, or why there is none here."""
    missing = missing_package("pylablib", "pylablib")
    return missing or {"camera": "simulated", "serial": ""}


def load(name: str, vendor: Vendor, path: str) -> Any:
    """Pylablib's module for a vendor's cameras, which calls the library in a file.

    Args:
        name: Name of the camera in the profile, for errors.
        vendor: Vendor of the cameras.
        path: The file, empty for where the vendor's installer puts it.
    """
    if sys.platform != "win32" and not vendor.linux:
        raise DeviceError(name, f"pylablib drives these cameras ({vendor.camera}) under Windows only")
    try:
        importlib.import_module("pylablib")
        return _loaded(vendor, path)
    except ImportError as error:
        text = f"the Python package 'pylablib' cannot be imported ({_first_line(error)})"
        raise DeviceError(name, f"{text}; install it with {install_hint('pylablib')}") from error
    except OSError as error:
        which = path or (vendor.windows if sys.platform == "win32" else vendor.linux)
        text = f"the vendor's library '{which}' cannot be loaded ({_first_line(error)})"
        what = f"install {vendor.source}, or give the library's file as `sdk`"
        raise DeviceError(name, f"{text}; {what}. {OTHERWISE}") from error


@lru_cache(maxsize=8)
def _loaded(vendor: Vendor, path: str) -> Any:
    if sys.platform == "win32" and not path:
        return module_for(vendor)  # pylablib knows the folders of the installers
    kind = getattr(ctypes, "CDLL" if vendor == DCAM else "WinDLL", ctypes.CDLL)
    return module_for(vendor, kind(path or vendor.linux))


def module_for(vendor: Vendor, library: Any = None) -> Any:
    """A copy of pylablib's module for a vendor's cameras that calls a library of its own.

    pylablib keeps one library for each vendor. With a copy, simulated and real cameras can be open together.

    Args:
        vendor: Vendor of the cameras.
        library: The library, loaded, None to let pylablib look for it.
    """
    with _loading, _without_its_warnings():
        spec = importlib.util.find_spec(f"pylablib.devices.{vendor.module}")
        if spec is None or spec.loader is None:
            raise ImportError(f"it has no module {vendor.module}")
        module: Any = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.lib = type(module.lib)()
        if hasattr(module, "libctl"):
            module.libctl = module.LibraryController(module.lib)
        loader: Any = importlib.import_module("pylablib.devices.utils.load_lib")
        find = loader.load_lib

        def give(*_names: object, **_options: object) -> Any:
            return library

        if library is not None:
            loader.load_lib = give  # its own looks for the files of Windows only
        try:
            module.lib.initlib()
        finally:
            loader.load_lib = find
        return module


@contextmanager
def _without_its_warnings() -> Generator[None]:
    # a lost frame shows as a gap of the frame numbers, which labseq reports
    warnings.filterwarnings("ignore", "lost DCAM frame")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
