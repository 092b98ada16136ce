"""libSoapySDR, with simulated radios behind its C functions.

The driver loads the library by ctypes. :func:`install` answers that load with C function pointers of our own,
so that each call goes through ctypes as with the real one: the driver's signatures on one side, those of
SoapySDR's header on the other, with pointers, structures and memory to be freed between them. Behind them is
what the library itself does: devices by their arguments, errors, tuning by components.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from ctypes import POINTER, c_bool, c_double, c_int, c_longlong, c_size_t
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from labseq_soapy_stream import soapysdr

from labseq_soapy_sim.device import GAINS_DB, HAS_TIME, STREAM_ERROR, Clock, ComputerClock, Radio
from labseq_soapy_sim.header import HEADER, Heap, Kwargs, MisuseError, Range, StructFunction, bare

TX: Final = 0
DRIVER: Final = "capture"
FORMAT: Final = b"CF32"
VERSION: Final = b"0.8.1-3"
ERRORS: Final = (b"TIMEOUT", b"STREAM_ERROR", b"CORRUPTION", b"OVERFLOW", b"NOT_SUPPORTED", b"TIME_ERROR")
"""Names of the codes -1, -2, ..."""
STREAM_CALLS: Final = ("activatestream", "deactivatestream", "writestream", "readstreamstatus")
FAILED: Final[Mapping[Any, Any]] = {c_int: -1, c_double: math.nan, c_size_t: -1, c_longlong: -1, c_bool: True}
"""Type of a result -> what SoapySDR returns if a radio's module throws; null for pointers."""


def read_markup(markup: str) -> dict[str, str]:
    """Keys and values of a text such as "driver=uhd, type=b200", as SoapySDR reads it."""
    pairs = (part.partition("=") for part in markup.split(","))
    return {key.strip(): value.strip() for key, _, value in pairs if key.strip()}


class SimulatedLibrary:
    """The C functions of SoapySDR, for simulated radios of the driver "capture".

    After a call that is undefined behaviour in C, all further calls fail and say which it was.

    Args:
        clock: Clock by which the radios play; by default the computer's.

    Attributes:
        functions: Has them as attributes, as ``ctypes.CDLL`` has.
        heap: Memory that the caller must free.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self.heap = Heap()
        self._clock = clock or ComputerClock()
        self._radios: dict[int, Radio] = {}
        self._streams: dict[int, int] = {}  # handle of a stream -> number of its channels
        self._n_handles = 0
        self._error: bytes | None = None
        self._misuse = ""
        self._callbacks: list[Any] = []
        self.functions = SimpleNamespace(**{f"SoapySDR{name}": self._exported(name) for name in HEADER})

    def _exported(self, name: str) -> Any:
        result, arguments = HEADER[name]
        is_struct = result in {Range, Kwargs}
        types: tuple[Any, ...] = (result, *arguments)
        if is_struct:
            types = None, POINTER(result), *arguments
        callback = ctypes.CFUNCTYPE(*types)(self._caught(name, result))
        self._callbacks.append(callback)
        return StructFunction(callback, ctypes.sizeof(result)) if is_struct else bare(callback)

    def _caught(self, name: str, result: Any) -> Callable[..., Any]:
        """A function that reports an exception as the C functions do: by the last status and error."""
        short = name.removeprefix("Device_").strip("_").lower()
        method: Callable[..., Any] = getattr(self, f"_{short}")
        is_call = name.startswith("Device_") and not short.startswith("last")
        failed = STREAM_ERROR if short in STREAM_CALLS else FAILED.get(result)

        def call(*arguments: Any) -> Any:
            if is_call:
                self._error = self._misuse.encode() or None
            if is_call and self._misuse:
                return failed
            try:
                return method(*arguments)
            except Exception as error:  # noqa: BLE001 - nothing may pass through C
                self._error = str(error).encode()
                if isinstance(error, MisuseError):
                    self._misuse = str(error)
                return failed

        return call

    def _radio(self, device: int | None, direction: int = TX, channel: int = 0) -> Radio:
        radio = self._radios.get(device or 0)
        if radio is None:
            raise MisuseError("a radio was used that is not open")
        radio.check()
        if direction != TX:
            raise RuntimeError("it has no channels that receive")
        radio.check_channel(channel)
        return radio

    def _streaming(self, device: int | None, stream: int | None) -> Radio:
        if (stream or 0) not in self._streams:
            raise MisuseError("a stream was used that is not set up")
        return self._radio(device)

    def _handle(self) -> int:
        self._n_handles += 1
        return 0x1000 * self._n_handles

    # The functions by their names after "SoapySDR" in small letters, with the arguments of the header

    def _errtostr(self, code: int) -> int:
        names = dict(enumerate((*ERRORS, b"UNDERFLOW"), 1))
        return self.heap.constant(names.get(-code, b"UNKNOWN"))

    def _getlibversion(self) -> int:
        return self.heap.constant(VERSION)

    def _free(self, address: int | None) -> None:
        self.heap.free(address)

    def _strings_clear(self, place: Any, _length: int) -> None:
        self.heap.free(place[0])
        place[0] = None

    def _kwargs_fromstring(self, result: Any, markup: bytes) -> None:
        self.heap.fill(result[0], read_markup(markup.decode()))

    def _kwargs_clear(self, place: Any) -> None:
        for pointer in (place[0].keys, place[0].vals):
            self.heap.free(pointer)
        place[0].size, place[0].keys, place[0].vals = 0, None, None

    def _laststatus(self) -> int:
        return 0 if self._error is None else -1

    def _lasterror(self) -> int:
        return self.heap.constant(self._error or b"")

    def _makestrargs(self, markup: bytes) -> int:
        arguments = read_markup(markup.decode())
        if arguments.get("driver") != DRIVER:
            raise RuntimeError("SoapySDR::Device::make() no match")
        radio, handle = Radio(arguments, self._clock), self._handle()
        self._radios[handle] = radio
        return handle

    def _unmake(self, device: int | None) -> int:
        radio = self._radios.pop(device or 0, None)
        if radio is None:
            raise RuntimeError("SoapySDR::Device::unmake() unknown device")
        radio.close()
        if self._streams:
            self._streams.clear()
            raise MisuseError("the radio was closed, but not its stream")
        return 0

    def _getdriverkey(self, device: int | None) -> int:
        self._radio(device)
        return self.heap.text(DRIVER)

    _gethardwarekey = _getdriverkey

    def _gethardwareinfo(self, result: Any, device: int | None) -> None:
        self._radio(device)
        self.heap.fill(result[0], {"serial": "simulated"})

    def _getnumchannels(self, device: int | None, direction: int) -> int:
        radio = self._radio(device)
        return radio.n_channels if direction == TX else 0

    def _setclocksource(self, device: int | None, source: bytes) -> int:
        self._radio(device).set_clock_source(source.decode())
        return 0

    def _setantenna(self, device: int | None, direction: int, channel: int, name: bytes) -> int:
        self._radio(device, direction, channel).set_antenna(channel, name.decode())
        return 0

    def _setsamplerate(self, device: int | None, direction: int, channel: int, rate_hz: float) -> int:
        self._radio(device, direction, channel).rate_hz = rate_hz
        return 0

    def _getsamplerate(self, device: int | None, direction: int, channel: int) -> float:
        return self._radio(device, direction, channel).rate_hz

    def _setbandwidth(self, device: int | None, direction: int, channel: int, _width_hz: float) -> int:
        self._radio(device, direction, channel)
        return 0

    def _setfrequency(
        self, device: int | None, direction: int, channel: int, frequency_hz: float, arguments: Any
    ) -> int:
        """Give the first component the frequency with the offset, the others what is left."""
        radio, given = self._radio(device, direction, channel), arguments[0]
        options = {given.keys[i]: given.vals[i] for i in range(given.size)}
        offset_hz = float(options.get(b"OFFSET", b"0"))
        left_hz = frequency_hz
        for component in radio.components:
            radio.tune(channel, component, left_hz + offset_hz)
            left_hz, offset_hz = left_hz - radio.tuned_hz(channel, component), 0.0
        return 0

    def _getfrequency(self, device: int | None, direction: int, channel: int) -> float:
        radio = self._radio(device, direction, channel)
        return sum(radio.tuned_hz(channel, component) for component in radio.components)

    def _getfrequencycomponent(self, device: int | None, direction: int, channel: int, name: bytes) -> float:
        return self._radio(device, direction, channel).tuned_hz(channel, name.decode())

    def _listfrequencies(self, device: int | None, direction: int, channel: int, length: Any) -> int:
        names = self._radio(device, direction, channel).components
        length[0] = len(names)
        return self.heap.texts(names)

    def _listsensors(self, device: int | None, length: Any) -> int:
        names = self._radio(device).sensors(None)
        length[0] = len(names)
        return self.heap.texts(names)

    def _listchannelsensors(self, device: int | None, direction: int, channel: int, length: Any) -> int:
        names = self._radio(device, direction, channel).sensors(channel)
        length[0] = len(names)
        return self.heap.texts(names)

    def _readsensor(self, device: int | None, name: bytes) -> int:
        return self.heap.text(self._radio(device).read_sensor(None, name.decode()))

    def _readchannelsensor(self, device: int | None, direction: int, channel: int, name: bytes) -> int:
        return self.heap.text(self._radio(device, direction, channel).read_sensor(channel, name.decode()))

    def _hashardwaretime(self, device: int | None, _what: bytes) -> bool:
        return self._radio(device).has_time

    def _gethardwaretime(self, device: int | None, _what: bytes) -> int:
        return self._radio(device).time_ns

    def _setgain(self, device: int | None, direction: int, channel: int, gain_db: float) -> int:
        self._radio(device, direction, channel).set_gain(channel, gain_db)
        return 0

    def _getgain(self, device: int | None, direction: int, channel: int) -> float:
        return self._radio(device, direction, channel).gain_db(channel)

    def _getgainrange(self, result: Any, device: int | None, direction: int, channel: int) -> None:
        result[0].minimum, result[0].maximum, result[0].step = math.nan, math.nan, 0.0
        self._radio(device, direction, channel)
        result[0].minimum, result[0].maximum, result[0].step = GAINS_DB

    def _setupstream(
        self,
        device: int | None,
        direction: int,
        format_name: bytes,
        channels: Any,
        n_channels: int,
        _arguments: Any,
    ) -> int:
        radio = self._radio(device, direction)
        if format_name != FORMAT:
            raise RuntimeError("it takes samples as CF32 only")
        if self._streams:
            raise RuntimeError("its channels are in use by another stream")
        radio.set_up_stream(channels[:n_channels])
        handle = self._handle()
        self._streams[handle] = n_channels
        return handle

    def _closestream(self, device: int | None, stream: int | None) -> int:
        if self._streams.pop(stream or 0, None) is None:
            raise MisuseError("a stream was closed that is not set up")
        self._radio(device)
        return 0

    def _activatestream(
        self, device: int | None, stream: int | None, _flags: int, _time_ns: int, _n_samples: int
    ) -> int:
        return self._streaming(device, stream).activate()

    def _deactivatestream(self, device: int | None, stream: int | None, _flags: int, _time_ns: int) -> int:
        return self._streaming(device, stream).deactivate()

    def _writestream(
        self,
        device: int | None,
        stream: int | None,
        buffers: Any,
        n_samples: int,
        flags: Any,
        time_ns: int,
        timeout_us: int,
    ) -> int:
        radio = self._streaming(device, stream)
        rows = [
            np.ctypeslib.as_array((ctypes.c_uint64 * n_samples).from_address(buffers[i]))
            for i in range(self._streams[stream or 0])
        ]
        start_ns = time_ns if flags[0] & HAS_TIME else None
        return radio.write(rows, start_ns, 1e-6 * timeout_us)

    def _readstreamstatus(
        self,
        device: int | None,
        stream: int | None,
        _mask: Any,
        _flags: Any,
        _time_ns: Any,
        timeout_us: int,
    ) -> int:
        return self._streaming(device, stream).read_status(1e-6 * timeout_us)


def install(library: SimulatedLibrary) -> Callable[[], None]:
    """Have the driver load a simulated library instead of the real one; gives what undoes it."""
    load = ctypes.CDLL

    def answer(name: str, *arguments: Any, **options: Any) -> Any:
        return library.functions if "SoapySDR" in str(name) else load(name, *arguments, **options)

    def undo() -> None:
        ctypes.CDLL = load
        soapysdr.library.cache_clear()

    ctypes.CDLL = answer  # pyright: ignore[reportAttributeAccessIssue] - a function in place of a class
    soapysdr.library.cache_clear()
    return undo


@contextmanager
def installed(library: SimulatedLibrary) -> Generator[SimulatedLibrary]:
    """Within the block the driver loads a simulated library, in this process."""
    undo = install(library)
    try:
        yield library
    finally:
        undo()
