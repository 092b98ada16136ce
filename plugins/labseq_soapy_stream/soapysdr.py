"""A radio that transmits, through the C interface of SoapySDR 0.8 (loaded on first use)."""

from __future__ import annotations

import ctypes
import sys
import time
from collections import Counter
from collections.abc import Sequence
from ctypes import POINTER, byref, c_bool, c_char_p, c_double, c_int, c_long, c_longlong, c_size_t, c_void_p
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq_soapy_stream.messages import LO_LOCKED, REF_LOCKED, Facts, Setup, unlocked

TX: Final = 0
FORMAT: Final = b"CF32"
TIMEOUT: Final = -1
NOT_SUPPORTED: Final = -5
ERRORS: Final = {-7: "underflows", -3: "sequence_errors", -6: "late_packets"}
"""Errors that a stream survives: UNDERFLOW, CORRUPTION and TIME_ERROR -> key of the counts."""
HAS_TIME: Final = 1 << 2
LOCK_S: Final = 2.0
"""How long they may take to lock."""
START_S: Final = 0.1
"""From setting the time of a start to the start."""

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
    """The library, the radio's module or the radio refused something; the text names it."""


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
        SoapyError: It cannot be found; the text says how to install it.
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
    raise SoapyError(f"the library SoapySDR cannot be loaded ({reason}); {advice}")


def _call(name: str, *arguments: Any) -> Any:
    """Call a function of a radio; raises SoapyError with the library's message if it fails."""
    result = getattr(library(), f"SoapySDRDevice_{name}")(*arguments)
    if library().SoapySDRDevice_lastStatus() != 0:
        text = (library().SoapySDRDevice_lastError() or b"").decode(errors="replace")
        raise SoapyError(f"{name}: {text or 'it failed without a message'}")
    return result


def _stream_error(action: str, code: int) -> SoapyError:
    return SoapyError(f"{action}: {library().SoapySDR_errToStr(code).decode()} ({code})")


class Radio:
    """One open radio; all calls come from one thread.

    Args:
        arguments: What opens it, for example "driver=uhd,serial=30AD123".

    Raises:
        SoapyError: There is no library, no such device, or it cannot be opened.
    """

    def __init__(self, arguments: str) -> None:
        self._device = _call("makeStrArgs", arguments.encode())
        if not self._device:
            raise SoapyError(f"there is no radio '{arguments}'")

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

    def gain_range(self, channel: int) -> tuple[float, float]:
        """Lowest and highest gain in dB."""
        gains = _call("getGainRange", self._device, TX, channel)
        return gains.minimum, gains.maximum

    def set(self, what: str, channel: int, value: float | str) -> None:
        """Set "Antenna", "SampleRate", "Bandwidth" or "Gain" of a channel, in Hz or dB."""
        plain = value.encode() if isinstance(value, str) else value
        _call(f"set{what}", self._device, TX, channel, plain)

    def get(self, what: str, channel: int) -> float:
        """Read a value of a channel back: "SampleRate", "Frequency" (of the samples' zero) or "Gain"."""
        return float(_call(f"get{what}", self._device, TX, channel))

    def tune(self, channel: int, frequency_hz: float, offset_hz: float) -> None:
        """Tune the local oscillator to a frequency plus an offset.

        If the radio can shift the samples digitally their zero stays at the frequency, else it shifts too.
        """
        if offset_hz and not self._tunes_digitally(channel):
            frequency_hz, offset_hz = frequency_hz + offset_hz, 0.0
        kwargs = library().SoapySDRKwargs_fromString(f"OFFSET={offset_hz!r}".encode() if offset_hz else b"")
        try:
            _call("setFrequency", self._device, TX, channel, frequency_hz, byref(kwargs))
        finally:
            library().SoapySDRKwargs_clear(byref(kwargs))

    def oscillator_hz(self, channel: int) -> float:
        """Frequency of the local oscillator, where it leaks."""
        if self._tunes_digitally(channel):
            return float(_call("getFrequencyComponent", self._device, TX, channel, b"RF"))
        return self.get("Frequency", channel)

    def locks(self, channels: Sequence[int]) -> dict[str, bool]:
        """Whether its clocks are locked to their reference, and the local oscillators of channels to them.

        Only sensors that the radio has, by the names of UHD: "ref_locked", "lo_locked" with its channel.
        """
        found: dict[str, bool] = {}
        if REF_LOCKED.encode() in self._names("listSensors"):
            found[REF_LOCKED] = self._text("readSensor", REF_LOCKED.encode()) == "true"
        for channel in channels:
            if LO_LOCKED.encode() in self._names("listChannelSensors", TX, channel):
                text = self._text("readChannelSensor", TX, channel, LO_LOCKED.encode())
                found[f"{LO_LOCKED} {channel}"] = text == "true"
        return found

    def _tunes_digitally(self, channel: int) -> bool:
        return {b"RF", b"BB"} <= self._names("listFrequencies", TX, channel)

    def _names(self, getter: str, *place: int) -> set[bytes]:
        n_names = c_size_t()
        names = c_void_p(_call(getter, self._device, *place, byref(n_names)))
        try:
            return {*ctypes.cast(names, POINTER(c_char_p))[: n_names.value]} if names else set()
        finally:
            library().SoapySDRStrings_clear(byref(names), n_names)

    def set_clock_source(self, source: str) -> None:
        """Choose the reference of its clocks."""
        _call("setClockSource", self._device, source.encode())

    def stream(self, channels: Sequence[int], arguments: str = "") -> Stream:
        """Set up a stream to these channels, in rising order."""
        kwargs = library().SoapySDRKwargs_fromString(arguments.encode())
        numbers = (c_size_t * len(channels))(*channels)
        try:
            handle = _call("setupStream", self._device, TX, FORMAT, numbers, len(channels), byref(kwargs))
        finally:
            library().SoapySDRKwargs_clear(byref(kwargs))
        return Stream(self._device, handle, len(channels))

    def close(self) -> None:
        """Close the radio."""
        _call("unmake", self._device)

    def _text(self, getter: str, *arguments: int | bytes) -> str:
        place = _call(getter, self._device, *arguments)
        text = ctypes.string_at(place).decode() if place else ""
        library().SoapySDR_free(place)
        return text


class Stream:
    """A stream of complex samples to all channels at once."""

    def __init__(self, device: Any, handle: Any, n_channels: int) -> None:
        self._library, self._place = library(), (device, handle)
        self._buffers = (c_void_p * n_channels)()
        self._flags, self._mask, self._time = c_int(0), c_size_t(0), c_longlong(0)
        self._knows_status = True
        self._errors: Counter[str] = Counter()
        self._starts_ns = 0
        self.starts_together = False

    def activate(self) -> None:
        """Let the first samples start to play: on all channels at one time, if the radio has a clock.

        Raises:
            SoapyError: The radio refuses to transmit.
        """
        if code := _call("activateStream", *self._place, 0, 0, 0):
            raise _stream_error("starting the stream", code)
        self.starts_together = bool(_call("hasHardwareTime", self._place[0], b""))
        if self.starts_together:
            now_ns = _call("getHardwareTime", self._place[0], b"")
            self._starts_ns = now_ns + round(START_S * 1e9)
        self._activated_s = time.monotonic()

    def check_start(self) -> None:
        """Find out whether the first samples came in time; does not wait until they are played."""
        left_s = self._activated_s + START_S / 2 - time.monotonic()
        if self.starts_together and self.errors(max(0.0, left_s))["late_packets"]:
            self.starts_together = False

    def write(self, samples: NDArray[np.float32], start: int, timeout_s: float) -> int:
        """Write samples to the stream.

        Args:
            samples: float32 (n_channels, 2 n), I and Q in turn; each row in one piece.
            start: Index of the first sample to write.
            timeout_s: How long to wait for room.

        Returns:
            Number of samples that the radio took; 0 if there was no room in time.

        Raises:
            SoapyError: The stream is broken.
        """
        n_samples = samples.shape[1] // 2 - start
        for i, row in enumerate(samples):
            self._buffers[i] = row.ctypes.data + 8 * start
        self._flags.value = HAS_TIME if self._starts_ns else 0
        wait_us = round(timeout_s * 1e6)
        n_taken = self._library.SoapySDRDevice_writeStream(
            *self._place, self._buffers, n_samples, byref(self._flags), self._starts_ns, wait_us
        )
        if n_taken > 0:
            self._starts_ns = 0
        elif n_taken == NOT_SUPPORTED and self._starts_ns:  # it has a clock, but not for this
            self._starts_ns, self.starts_together = 0, False
            return self.write(samples, start, timeout_s)
        elif n_taken in ERRORS:
            self._errors[ERRORS[n_taken]] += 1
        elif n_taken not in {0, TIMEOUT}:
            raise _stream_error("writing to the stream", n_taken)
        return max(0, n_taken)

    def errors(self, timeout_s: float = 0.0) -> Counter[str]:
        """How often the radio reported each of :data:`ERRORS` since the last call; waits for the first."""
        while self._knows_status:
            code = self._library.SoapySDRDevice_readStreamStatus(
                *self._place, byref(self._mask), byref(self._flags), byref(self._time), round(timeout_s * 1e6)
            )
            if code in ERRORS:
                self._errors[ERRORS[code]] += 1
                timeout_s = 0.0
                continue
            if code == NOT_SUPPORTED:
                self._knows_status = False
            elif code < 0 and code != TIMEOUT:
                raise _stream_error("the stream's status", code)
            break
        found, self._errors = self._errors, Counter()
        return found

    def close(self) -> None:
        """Stop playing and close the stream.

        Raises:
            SoapyError: The radio does not obey: its transmitters may still be on.
        """
        try:
            code = _call("deactivateStream", *self._place, 0, 0)
        finally:
            _call("closeStream", *self._place)
        if code:
            raise _stream_error("stopping the stream", code)


def open_radio(setup: Setup) -> Radio:
    """Open the radio.

    Raises:
        SoapyError: There is none, another program has it, or it has too few channels.
    """
    library()
    try:
        radio = Radio(setup.device)
    except SoapyError as error:
        hint = "`SoapySDRUtil --find` lists the radios that are connected"
        raise SoapyError(f"'{setup.device}' cannot be opened: {error}; {hint}") from error
    n_channels, needed = radio.n_channels, max(setup.channels) + 1
    if n_channels < needed:
        radio.close()
        text = f"it has {n_channels} channel(s) that transmit; expected {needed}, one for each AOD"
        raise SoapyError(text)
    return radio


def set_up(radio: Radio, setup: Setup) -> Stream:
    """Set up both channels and their stream.

    Raises:
        SoapyError: The radio refuses something.
    """
    if setup.clock_source:
        radio.set_clock_source(setup.clock_source)
    for channel, gain_db in zip(setup.channels, setup.gain_db, strict=True):
        radio.set("SampleRate", channel, setup.rate_hz)
        if setup.bandwidth_hz is not None:
            radio.set("Bandwidth", channel, setup.bandwidth_hz)
        if setup.antenna:
            radio.set("Antenna", channel, setup.antenna)
        radio.tune(channel, setup.oscillator_hz, setup.lo_offset_hz)
        lowest, highest = radio.gain_range(channel)
        if gain_db is not None and not lowest <= gain_db <= highest:
            text = f"a gain of {gain_db:g} dB; channel {channel} has {lowest:g} to {highest:g} dB"
            raise SoapyError(text)
        radio.set("Gain", channel, lowest if gain_db is None else gain_db)
    return radio.stream(sorted(setup.channels), setup.stream)


def read_back(radio: Radio, setup: Setup) -> Facts:
    """Read the values of both channels back, after the stream is set up: some radios change them then.

    Raises:
        SoapyError: Its channels have different rates.
    """
    rates = [radio.get("SampleRate", channel) for channel in setup.channels]
    if rates[0] != rates[1]:
        raise SoapyError(f"its channels have different sample rates: {rates[0]:.10g} and {rates[1]:.10g} Hz")
    end_s = time.monotonic() + LOCK_S
    while unlocked(locks := radio.locks(setup.channels), setup.clock_source) and time.monotonic() < end_s:
        time.sleep(LOCK_S / 100)
    return Facts(
        radio=radio.identify(),
        rate_hz=rates[0],
        zero_hz=[radio.get("Frequency", channel) for channel in setup.channels],
        oscillator_hz=[radio.oscillator_hz(channel) for channel in setup.channels],
        gain_db=[radio.get("Gain", channel) for channel in setup.channels],
        locks=locks,
    )


def lower_gains(device: str, channels: Sequence[int]) -> None:
    """Open a radio that a killed process left transmitting, set the lowest gains, and close it.

    Raises:
        SoapyError: It cannot be opened, or refuses something.
    """
    radio = Radio(device)
    try:
        for channel in channels:
            radio.set("Gain", channel, radio.gain_range(channel)[0])
    finally:
        radio.close()
