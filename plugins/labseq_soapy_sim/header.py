"""The C functions of SoapySDR 0.8.1 that the driver calls, as its headers declare them."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from ctypes import POINTER, c_bool, c_char_p, c_double, c_int, c_long, c_longlong, c_size_t, c_void_p
from typing import Any, Final


class Range(ctypes.Structure):
    """SoapySDRRange."""

    _fields_ = (("minimum", c_double), ("maximum", c_double), ("step", c_double))


class Kwargs(ctypes.Structure):
    """SoapySDRKwargs."""

    _fields_ = (("size", c_size_t), ("keys", POINTER(c_char_p)), ("vals", POINTER(c_char_p)))


_DEVICE: Final = (c_void_p,)
_CHANNEL: Final = (c_void_p, c_int, c_size_t)
_STREAM: Final = (c_void_p, c_void_p)
_WRITE: Final = (POINTER(c_void_p), c_size_t, POINTER(c_int), c_longlong, c_long)
_STATUS: Final = (POINTER(c_size_t), POINTER(c_int), POINTER(c_longlong), c_long)

HEADER: Final[Mapping[str, tuple[Any, tuple[Any, ...]]]] = {
    "Device_lastStatus": (c_int, ()),
    "Device_lastError": (c_void_p, ()),
    "Device_makeStrArgs": (c_void_p, (c_char_p,)),
    "Device_unmake": (c_int, _DEVICE),
    "Device_getDriverKey": (c_void_p, _DEVICE),
    "Device_getHardwareKey": (c_void_p, _DEVICE),
    "Device_getHardwareInfo": (Kwargs, _DEVICE),
    "Device_getNumChannels": (c_size_t, (c_void_p, c_int)),
    "Device_setClockSource": (c_int, (c_void_p, c_char_p)),
    "Device_setAntenna": (c_int, (*_CHANNEL, c_char_p)),
    "Device_setSampleRate": (c_int, (*_CHANNEL, c_double)),
    "Device_getSampleRate": (c_double, _CHANNEL),
    "Device_setBandwidth": (c_int, (*_CHANNEL, c_double)),
    "Device_setFrequency": (c_int, (*_CHANNEL, c_double, POINTER(Kwargs))),
    "Device_getFrequency": (c_double, _CHANNEL),
    "Device_listFrequencies": (c_void_p, (*_CHANNEL, POINTER(c_size_t))),
    "Device_getFrequencyComponent": (c_double, (*_CHANNEL, c_char_p)),
    "Device_listSensors": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "Device_readSensor": (c_void_p, (c_void_p, c_char_p)),
    "Device_listChannelSensors": (c_void_p, (*_CHANNEL, POINTER(c_size_t))),
    "Device_readChannelSensor": (c_void_p, (*_CHANNEL, c_char_p)),
    "Device_hasHardwareTime": (c_bool, (c_void_p, c_char_p)),
    "Device_getHardwareTime": (c_longlong, (c_void_p, c_char_p)),
    "Device_setGain": (c_int, (*_CHANNEL, c_double)),
    "Device_getGain": (c_double, _CHANNEL),
    "Device_getGainRange": (Range, _CHANNEL),
    "Device_setupStream": (
        c_void_p,
        (c_void_p, c_int, c_char_p, POINTER(c_size_t), c_size_t, POINTER(Kwargs)),
    ),
    "Device_closeStream": (c_int, _STREAM),
    "Device_activateStream": (c_int, (*_STREAM, c_int, c_longlong, c_size_t)),
    "Device_deactivateStream": (c_int, (*_STREAM, c_int, c_longlong)),
    "Device_writeStream": (c_int, (*_STREAM, *_WRITE)),
    "Device_readStreamStatus": (c_int, (*_STREAM, *_STATUS)),
    "Kwargs_fromString": (Kwargs, (c_char_p,)),
    "Kwargs_clear": (None, (POINTER(Kwargs),)),
    "Strings_clear": (None, (POINTER(c_void_p), c_size_t)),
    "_errToStr": (c_void_p, (c_int,)),
    "_getLibVersion": (c_void_p, ()),
    "_free": (None, (c_void_p,)),
}
"""Name after "SoapySDR" -> type of the result, types of the arguments, from the headers of 0.8.1.

Texts that C returns are addresses here: ctypes would free those of a callback at once.
"""


class MisuseError(RuntimeError):
    """A call that is undefined behaviour in C, such as one with a handle that was closed."""


class StructFunction:
    """A C function that returns a structure, which ctypes does not allow a callback to do.

    Args:
        callback: Has a pointer to the structure as its first argument.
        n_bytes: Size of the structure in SoapySDR's header.
    """

    def __init__(self, callback: Any, n_bytes: int) -> None:
        self._callback, self._n_bytes = callback, n_bytes
        self.restype: Any = c_int
        self.argtypes: Sequence[Any] = ()

    def __call__(self, *arguments: Any) -> Any:
        """Call it; the structure is the one that the caller declared."""
        if ctypes.sizeof(self.restype) != self._n_bytes:
            raise MisuseError(f"{self.restype} has another size than in the header")
        result, function = self.restype(), bare(self._callback)
        function.restype, function.argtypes = None, (c_void_p, *self.argtypes)
        function(ctypes.addressof(result), *arguments)
        return result


def bare(callback: Any) -> Any:
    """A C function pointer without signature, as ctypes makes it for a function of a library."""
    return ctypes.CFUNCTYPE(c_int)(ctypes.cast(callback, c_void_p).value or 0)


class Heap:
    """Memory that the library allocates and its caller must free.

    Attributes:
        blocks: Address -> what was allocated there.
    """

    def __init__(self) -> None:
        self.blocks: dict[int, Any] = {}
        self._constants: dict[bytes, Any] = {}

    def constant(self, text: bytes) -> int:
        """Address of a text that stays, and must not be freed."""
        return ctypes.addressof(self._constants.setdefault(text, ctypes.create_string_buffer(text)))

    def text(self, text: str) -> int:
        """Address of a text."""
        return self._allocated(ctypes.create_string_buffer(text.encode()))

    def texts(self, texts: Sequence[str]) -> int:
        """Address of a list of texts."""
        return self._allocated((c_char_p * (len(texts) + 1))(*[text.encode() for text in texts]))

    def fill(self, target: Any, values: Mapping[str, str]) -> None:
        """Make a :class:`Kwargs` of a mapping."""
        target.size = len(values)
        target.keys, target.vals = (
            ctypes.cast(self.texts([*part]), POINTER(c_char_p)) for part in (values.keys(), values.values())
        )

    def free(self, pointer: Any) -> None:
        """Free what was allocated at an address; nothing at null.

        Raises:
            MisuseError: Nothing is, or no longer: C would damage the memory of the process.
        """
        address = ctypes.cast(pointer, c_void_p).value
        if address and self.blocks.pop(address, None) is None:
            raise MisuseError("memory was freed that the library has not allocated")

    def _allocated(self, block: Any) -> int:
        address = ctypes.addressof(block)
        self.blocks[address] = block
        return address
