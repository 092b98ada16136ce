"""Andor's SDK2 by ctypes, with functions as methods that return what C writes through pointers."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from threading import RLock
from typing import Any, Final

from labseq.plugin import DeviceError
from labseq_andor.codes import TEMPERATURE_STATUS, Code, explain

OTHERWISE: Final = "To try things without a camera, set `camera: simulated`"
TEXT_BYTES: Final = 256
"""Size of the buffers for texts."""


class Capabilities(ctypes.Structure):
    """The SDK's structure of a camera's capabilities. Its numbers have 32 bits on every system."""

    _fields_ = tuple(
        (name, ctypes.c_uint32)
        for name in (
            *("ulSize", "ulAcqModes", "ulReadModes", "ulTriggerModes", "ulCameraType", "ulPixelMode"),
            *("ulSetFunctions", "ulGetFunctions", "ulFeatures", "ulPCICard", "ulEMGainCapability"),
            *("ulFTReadModes", "ulFeatures2"),
        )
    )


TYPES: Final[dict[str, Any]] = {
    "i": ctypes.c_int32,
    "u": ctypes.c_uint32,
    "l": ctypes.c_long,
    "f": ctypes.c_float,
    "p": ctypes.c_void_p,
    "c": Capabilities,
    "s": ctypes.c_char * TEXT_BYTES,
    "n": ctypes.c_char * TEXT_BYTES,
}
"""C types of the letters in :data:`SIGNATURES`."""

SIGNATURES: Final[dict[str, str]] = {
    # cameras
    "GetAvailableCameras": " i",
    "GetCameraHandle": "i i",
    "GetCurrentCamera": " i",
    "SetCurrentCamera": "i ",
    "Initialize": "p ",
    "ShutDown": " ",
    "GetVersionInfo": "i n",
    "GetHeadModel": " s",
    "GetCameraSerialNumber": " i",
    "GetHardwareVersion": " uuuuuu",
    "GetCapabilities": " c",
    "GetDetector": " ii",
    # amplifiers and speeds
    "GetNumberADChannels": " i",
    "GetBitDepth": "i i",
    "SetADChannel": "i ",
    "GetNumberAmp": " i",
    "GetAmpDesc": "i n",
    "SetOutputAmplifier": "i ",
    "GetNumberHSSpeeds": "ii i",
    "GetHSSpeed": "iii f",
    "SetHSSpeed": "ii ",
    "GetNumberPreAmpGains": " i",
    "GetPreAmpGain": "i f",
    "IsPreAmpGainAvailable": "iiii i",
    "SetPreAmpGain": "i ",
    "GetNumberVSSpeeds": " i",
    "GetVSSpeed": "i f",
    "GetFastestRecommendedVSSpeed": " if",
    "SetVSSpeed": "i ",
    "SetBaselineClamp": "i ",
    # EM gain
    "SetEMGainMode": "i ",
    "SetEMAdvanced": "i ",
    "GetEMGainRange": " ii",
    "SetEMCCDGain": "i ",
    # temperature
    "GetTemperatureRange": " ii",
    "SetTemperature": "i ",
    "GetTemperatureF": " f",
    "CoolerON": " ",
    "CoolerOFF": " ",
    "SetCoolerMode": "i ",
    "SetFanMode": "i ",
    # region and shutter
    "SetReadMode": "i ",
    "SetImage": "iiiiii ",
    "SetIsolatedCropMode": "iiiii ",
    "SetIsolatedCropModeEx": "iiiiiii ",
    "SetFrameTransferMode": "i ",
    "GetShutterMinTimes": " ii",
    "SetShutter": "iiii ",
    # times and triggers
    "GetReadOutTime": " f",
    "GetMaximumExposure": " f",
    "SetExposureTime": "f ",
    "SetAcquisitionMode": "i ",
    "SetNumberAccumulations": "i ",
    "SetNumberKinetics": "i ",
    "SetKineticCycleTime": "f ",
    "GetAcquisitionTimings": " fff",
    "SetTriggerMode": "i ",
    "SetTriggerInvert": "i ",
    "SetFastExtTrigger": "i ",
    "SetMetaData": "i ",
    # acquisition
    "PrepareAcquisition": " ",
    "StartAcquisition": " ",
    "AbortAcquisition": " ",
    "SendSoftwareTrigger": " ",
    "GetStatus": " i",
    "WaitForAcquisitionByHandleTimeOut": "li ",
    "CancelWait": " ",
    "GetNumberNewImages": " ii",
    "GetImages16": "iipu ii",
    "GetMetaDataInfo": "ppu ",
}
"""Types of the functions, by name. Letters of the arguments, a space, letters of the results by pointer.

They follow Andor's headers ``atmcd32d.h`` and, for Linux, ``atmcdLXd.h``. The letters are ``i`` int or at_32
and ``u`` unsigned int or at_u32, of 32 bits on every system, ``l`` long, which has 64 bits under 64-bit
Linux, ``f`` float, ``p`` any pointer, ``c`` :class:`Capabilities`, ``s`` text, ``n`` text whose length is
passed, too.
"""


class AndorError(Exception):
    """A function of the SDK returned another code than success.

    Attributes:
        code: The code.
    """

    def __init__(self, function: str, code: int) -> None:
        self.code = code
        super().__init__(explain(function, code))


class AndorSdk:
    """The functions in :data:`SIGNATURES` as methods. ``sdk.GetReadOutTime()`` returns the time.

    Methods return nothing, a value or a tuple of values, and raise :class:`AndorError`.

    Args:
        library: Andor's library, loaded, or the simulated one. Its attributes are the C functions.

    Attributes:
        lock: Held while a camera is selected and used, since the SDK has one selected camera.
        n_open: Number of cameras that are open.
    """

    def __init__(self, library: Any) -> None:
        self._library = library
        self.lock = RLock()
        self.n_open = 0

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name not in SIGNATURES:
            raise AttributeError(name)
        inputs, outputs = SIGNATURES[name].split(" ")
        function = getattr(self._library, name, None)
        if function is None:
            return partial(self._missing, name)
        types = [TYPES[letter] for letter in inputs]
        for letter in outputs:
            types += _pointer_types(letter)
        function.argtypes, function.restype = types, ctypes.c_uint
        method = partial(self._call, name, function, outputs)
        setattr(self, name, method)
        return method

    def _call(self, name: str, function: Callable[..., int], outputs: str, *inputs: Any) -> Any:
        places = [TYPES[letter]() for letter in outputs]
        pointers: list[Any] = []
        for letter, place in zip(outputs, places, strict=True):
            if letter == "c":
                place.ulSize = ctypes.sizeof(place)
            is_text = letter in "sn"
            pointers += [place if is_text else ctypes.pointer(place)]
            pointers += [TEXT_BYTES] if letter == "n" else []
        code = function(*inputs, *pointers)
        values = tuple(_value(place) for place in places)
        if code in TEMPERATURE_STATUS:
            return code, *values
        if code != Code.SUCCESS:
            raise AndorError(name, code)
        return values[0] if len(values) == 1 else values

    def _missing(self, name: str, *_inputs: Any) -> Any:
        raise AndorError(name, Code.NOT_SUPPORTED)


def _pointer_types(letter: str) -> list[Any]:
    if letter in "sn":
        return [ctypes.c_char_p, ctypes.c_int32][: 1 + (letter == "n")]
    return [ctypes.POINTER(TYPES[letter])]


def _value(place: Any) -> Any:
    value = getattr(place, "value", place)  # a structure has none
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def load_sdk(name: str, path: str) -> AndorSdk:
    """Load Andor's library from a file, or, without one, from where Andor's installers put it.

    Args:
        name: Name of the camera in the profile, for errors.
        path: The file, or empty to search.
    """
    try:
        return _loaded(path or _installed())
    except OSError as error:
        which = f"'{path or _installed()}' cannot be loaded ({str(error).splitlines()[0]})"
        what = "install Andor SDK2 or Solis for this system, or give the library's file as `sdk`"
        raise DeviceError(name, f"Andor's library {which}; {what}. {OTHERWISE}") from error


@lru_cache(maxsize=8)
def _loaded(path: str) -> AndorSdk:
    return AndorSdk(getattr(ctypes, "WinDLL", ctypes.CDLL)(path))


def _installed() -> str:
    if sys.platform != "win32":
        return "libandor.so"
    bits = 8 * ctypes.sizeof(ctypes.c_void_p)
    programs = Path(os.environ.get("PROGRAMFILES", r"C:\Program Files"))
    names = f"atmcd{bits}d_legacy.dll", f"atmcd{bits}d.dll"
    files = [programs / folder / name for folder in ("Andor SOLIS", "Andor SDK") for name in names]
    return str(next((file for file in files if file.is_file()), names[1]))
