"""The part of SoapySDR 0.8 that transmits, by its C interface (loaded on first use).

Each method of :class:`SoapyDevice` is one function of SoapySDR. A simulated radio has the same methods.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence
from ctypes import POINTER, byref, c_bool, c_char_p, c_double, c_int, c_long, c_longlong, c_size_t, c_void_p
from functools import cache
from typing import Any, Final

from labseq_soapy_stream.output import Samples

TX: Final = 0
FORMAT: Final = b"CF32"
TIMEOUT: Final = -1
STREAM_ERROR: Final = -2
CORRUPTION: Final = -3
NOT_SUPPORTED: Final = -5
TIME_ERROR: Final = -6
UNDERFLOW: Final = -7
HAS_TIME: Final = 1 << 2

_NAMES: Final = {
    "linux": ("libSoapySDR.so.0.8", "libSoapySDR.so"),
    "darwin": (
        "libSoapySDR.0.8.dylib",
        "libSoapySDR.dylib",
        "/opt/homebrew/lib/libSoapySDR.dylib",
        "/usr/local/lib/libSoapySDR.dylib",
    ),
    "win32": ("SoapySDR.dll",),
}
_INSTALL: Final = {
    "linux": "install it with `apt-get install libsoapysdr0.8` and the module of your radio, for example "
    "soapysdr-module-uhd",
    "darwin": "install it with `brew install soapysdr` and the module of your radio",
    "win32": "install PothosSDR, which has it and the modules of many radios, and add its bin folder to PATH",
}


class SoapyError(Exception):
    """The library, the radio's module or the radio refused something. The text names it."""


class LibraryError(SoapyError):
    """The library cannot be loaded."""


class _Range(ctypes.Structure):
    _fields_ = (("minimum", c_double), ("maximum", c_double), ("step", c_double))


class _Kwargs(ctypes.Structure):
    _fields_ = (("size", c_size_t), ("keys", POINTER(c_char_p)), ("vals", POINTER(c_char_p)))


_DEVICE: Final = (c_void_p,)
_CHANNEL: Final = (c_void_p, c_int, c_size_t)
_STREAM: Final = (c_void_p, c_void_p)

_SIGNATURES: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "Device_lastStatus": (c_int, ()),
    "Device_lastError": (c_char_p, ()),
    "Device_makeStrArgs": (c_void_p, (c_char_p,)),
    "Device_unmake": (c_int, _DEVICE),
    "Device_getDriverKey": (c_void_p, _DEVICE),
    "Device_getHardwareKey": (c_void_p, _DEVICE),
    "Device_getHardwareInfo": (_Kwargs, _DEVICE),
    "Device_getNumChannels": (c_size_t, (c_void_p, c_int)),
    "Device_setClockSource": (c_int, (c_void_p, c_char_p)),
    "Device_setAntenna": (c_int, (*_CHANNEL, c_char_p)),
    "Device_setSampleRate": (c_int, (*_CHANNEL, c_double)),
    "Device_getSampleRate": (c_double, _CHANNEL),
    "Device_setBandwidth": (c_int, (*_CHANNEL, c_double)),
    "Device_setFrequency": (c_int, (*_CHANNEL, c_double, POINTER(_Kwargs))),
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
    "Device_getGainRange": (_Range, _CHANNEL),
    "Device_setupStream": (
        c_void_p,
        (c_void_p, c_int, c_char_p, POINTER(c_size_t), c_size_t, POINTER(_Kwargs)),
    ),
    "Device_closeStream": (c_int, _STREAM),
    "Device_activateStream": (c_int, (*_STREAM, c_int, c_longlong, c_size_t)),
    "Device_deactivateStream": (c_int, (*_STREAM, c_int, c_longlong)),
    "Device_writeStream": (
        c_int,
        (*_STREAM, POINTER(c_void_p), c_size_t, POINTER(c_int), c_longlong, c_long),
    ),
    "Device_readStreamStatus": (
        c_int,
        (*_STREAM, POINTER(c_size_t), POINTER(c_int), POINTER(c_longlong), c_long),
    ),
    "Kwargs_fromString": (_Kwargs, (c_char_p,)),
    "Kwargs_clear": (None, (POINTER(_Kwargs),)),
    "Strings_clear": (None, (POINTER(c_void_p), c_size_t)),
    "_errToStr": (c_char_p, (c_int,)),
    "_getLibVersion": (c_char_p, ()),
    "_free": (None, (c_void_p,)),
}
"""Name after "SoapySDR" -> type of the result, types of the arguments."""


@cache
def library() -> Any:
    """The library, its functions with their signatures.

    Raises:
        LibraryError: It cannot be found. The text says how to install it.
    """
    reason = ""
    for name in _NAMES.get(sys.platform, _NAMES["linux"]):
        try:
            found = ctypes.CDLL(name)
        except OSError as error:
            reason = reason or str(error)
            continue
        for function, (result, arguments) in _SIGNATURES.items():
            getattr(found, f"SoapySDR{function}").restype = result
            getattr(found, f"SoapySDR{function}").argtypes = arguments
        return found
    advice = _INSTALL.get(sys.platform, _INSTALL["linux"])
    raise LibraryError(f"the library SoapySDR cannot be loaded ({reason}); {advice}")


def _call(name: str, *arguments: Any) -> Any:
    """Call a function of a radio. Raises SoapyError with the library's message if it fails."""
    result = getattr(library(), f"SoapySDRDevice_{name}")(*arguments)
    if library().SoapySDRDevice_lastStatus() != 0:
        text = (library().SoapySDRDevice_lastError() or b"").decode(errors="replace")
        raise SoapyError(f"{name}: {text or 'it failed without a message'}")
    return result


class SoapyDevice:
    """One open radio. All calls come from one thread.

    Args:
        arguments: Its arguments, for example "driver=uhd,serial=30AD123".

    Raises:
        SoapyError: There is no library, no such device, or it cannot be opened. Methods raise this if the
            radio's module fails.
    """

    def __init__(self, arguments: str) -> None:
        self._device = _call("makeStrArgs", arguments.encode())
        if not self._device:
            raise SoapyError(f"there is no radio '{arguments}'")
        self._stream: Any = None
        self._buffers: Any = None
        self._write, self._status = (
            library().SoapySDRDevice_writeStream,
            library().SoapySDRDevice_readStreamStatus,
        )
        self._flags, self._mask, self._time = c_int(0), c_size_t(0), c_longlong(0)

    def close(self) -> None:
        """Close the radio. Its stream must be closed."""
        _call("unmake", self._device)

    def identify(self) -> dict[str, str]:
        """Driver, hardware, serial number and the like."""
        info = _call("getHardwareInfo", self._device)
        details = {info.keys[i].decode(): info.vals[i].decode() for i in range(info.size)}
        library().SoapySDRKwargs_clear(byref(info))
        own = {"driver": self._text("getDriverKey"), "hardware": self._text("getHardwareKey")}
        return {**own, "SoapySDR": library().SoapySDR_getLibVersion().decode(), **details}

    @property
    def n_channels(self) -> int:
        """Number of channels that transmit."""
        return int(_call("getNumChannels", self._device, TX))

    def set_clock_source(self, source: str) -> None:
        """Choose the reference of its clocks."""
        _call("setClockSource", self._device, source.encode())

    def set(self, what: str, channel: int, value: float | str) -> None:
        """Set "Antenna", "SampleRate", "Bandwidth" or "Gain" of a channel, in Hz or dB."""
        plain = value.encode() if isinstance(value, str) else value
        _call(f"set{what}", self._device, TX, channel, plain)

    def get(self, what: str, channel: int) -> float:
        """Read "SampleRate", "Frequency" (of the samples' zero) or "Gain" of a channel back."""
        return float(_call(f"get{what}", self._device, TX, channel))

    def gain_range(self, channel: int) -> tuple[float, float]:
        """Lowest and highest gain in dB."""
        gains = _call("getGainRange", self._device, TX, channel)
        return gains.minimum, gains.maximum

    def set_frequency(self, channel: int, frequency_hz: float, offset_hz: float) -> None:
        """Tune the component RF to a frequency plus an offset, and the other components to the rest."""
        kwargs = library().SoapySDRKwargs_fromString(f"OFFSET={offset_hz!r}".encode() if offset_hz else b"")
        try:
            _call("setFrequency", self._device, TX, channel, frequency_hz, byref(kwargs))
        finally:
            library().SoapySDRKwargs_clear(byref(kwargs))

    def components(self, channel: int) -> set[str]:
        """Components of the frequency."""
        return self._names("listFrequencies", TX, channel)

    def component_hz(self, channel: int, name: str) -> float:
        """A component of the frequency."""
        return float(_call("getFrequencyComponent", self._device, TX, channel, name.encode()))

    def sensors(self, channel: int | None) -> set[str]:
        """Sensors of a channel, or of the whole radio."""
        return (
            self._names("listSensors") if channel is None else self._names("listChannelSensors", TX, channel)
        )

    def read_sensor(self, channel: int | None, name: str) -> str:
        """Value of a sensor."""
        if channel is None:
            return self._text("readSensor", name.encode())
        return self._text("readChannelSensor", TX, channel, name.encode())

    @property
    def has_time(self) -> bool:
        """Whether it has a clock that can be read."""
        return bool(_call("hasHardwareTime", self._device, b""))

    @property
    def time_ns(self) -> int:
        """Time of the radio's clock."""
        return int(_call("getHardwareTime", self._device, b""))

    def set_up_stream(self, channels: Sequence[int], arguments: str) -> None:
        """Set up a stream of complex samples to these channels, in rising order."""
        kwargs = library().SoapySDRKwargs_fromString(arguments.encode())
        numbers = (c_size_t * len(channels))(*channels)
        try:
            self._stream = _call(
                "setupStream", self._device, TX, FORMAT, numbers, len(channels), byref(kwargs)
            )
        finally:
            library().SoapySDRKwargs_clear(byref(kwargs))
        self._buffers = (c_void_p * len(channels))()

    def close_stream(self) -> None:
        """Close the stream."""
        _call("closeStream", self._device, self._stream)

    def activate(self) -> int:
        """Switch the transmitters on, and return a code."""
        return int(_call("activateStream", self._device, self._stream, 0, 0, 0))

    def deactivate(self) -> int:
        """Switch the transmitters off, and return a code."""
        return int(_call("deactivateStream", self._device, self._stream, 0, 0))

    def write(self, samples: Samples, start: int, start_ns: int | None, timeout_s: float) -> int:
        """Send samples.

        Args:
            samples: float32 (n_channels, 2 n), I and Q in turn, each row in one piece.
            start: Index of the first sample to send.
            start_ns: Time of the radio's clock at which it is played, None for right after the sample before.
            timeout_s: How long to wait for room.

        Returns:
            Number of samples that were taken, or a code.
        """
        for i, row in enumerate(samples):
            self._buffers[i] = row.ctypes.data + 8 * start
        self._flags.value = 0 if start_ns is None else HAS_TIME
        n_samples, wait_us = samples.shape[1] // 2 - start, round(timeout_s * 1e6)
        place = self._device, self._stream, self._buffers
        return int(self._write(*place, n_samples, byref(self._flags), start_ns or 0, wait_us))

    def read_status(self, timeout_s: float) -> int:
        """Wait for an event of the stream, and return its code."""
        places = byref(self._mask), byref(self._flags), byref(self._time)
        return int(self._status(self._device, self._stream, *places, round(timeout_s * 1e6)))

    def code_text(self, code: int) -> str:
        """A code with its name."""
        return f"{library().SoapySDR_errToStr(code).decode()} ({code})"

    def _names(self, getter: str, *place: int) -> set[str]:
        n_names = c_size_t()
        names = c_void_p(_call(getter, self._device, *place, byref(n_names)))
        try:
            texts = ctypes.cast(names, POINTER(c_char_p))[: n_names.value] if names else []
            return {text.decode() for text in texts}
        finally:
            library().SoapySDRStrings_clear(byref(names), n_names)

    def _text(self, getter: str, *arguments: int | bytes) -> str:
        place = _call(getter, self._device, *arguments)
        text = ctypes.string_at(place).decode() if place else ""
        library().SoapySDR_free(place)
        return text
