"""The driver library, with simulated cards behind its C functions.

``spcm_core`` loads the vendor's library when it is imported, and keeps its functions. The simulator
answers that load with C function pointers of its own, so that every call goes through
ctypes as with the real library, buffers and pointers included. A call with the handle of a simulated
card goes to that card. Every other call goes to the vendor's library if there is one, so that real
and simulated cards can be open side by side.
"""

from __future__ import annotations

import ctypes
import importlib
import math
import os
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import partialmethod
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from labseq.plugin import Clock, DeviceError, Emergency, Simulation
from labseq.plugin.simulation import ReceivesOutput, RfSamples, RfSpan, RfTones
from labseq_spcm_sim import registers as r
from labseq_spcm_sim.card import DRIVER_VERSION, SimulatedCard
from labseq_spcm_sim.modes import Buffer
from labseq_spcm_sim.output import FULL_SCALE, SampleSpan
from labseq_spcm_sim.setup import ErrorInfo, Number

Slot = ctypes.c_int32 | ctypes.c_uint32 | ctypes.c_int64 | ctypes.c_double

_POINTER: Final = ctypes.c_void_p
_I32: Final = ctypes.c_int32
_U32: Final = ctypes.c_uint32
_I64: Final = ctypes.c_int64
_U64: Final = ctypes.c_uint64
_F64: Final = ctypes.c_double

SIGNATURES: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "spcm_hOpen": (_POINTER, (ctypes.c_char_p,)),
    "spcm_vClose": (None, (_POINTER,)),
    "spcm_dwGetErrorInfo_i32": (_U32, (_POINTER, _POINTER, _POINTER, _POINTER)),
    "spcm_dwGetErrorInfo_i64": (_U32, (_POINTER, _POINTER, _POINTER, _POINTER)),
    "spcm_dwGetErrorInfo_d64": (_U32, (_POINTER, _POINTER, _POINTER, _POINTER)),
    "spcm_dwGetParam_i32": (_U32, (_POINTER, _I32, _POINTER)),
    "spcm_dwGetParam_i64": (_U32, (_POINTER, _I32, _POINTER)),
    "spcm_dwGetParam_d64": (_U32, (_POINTER, _I32, _POINTER)),
    "spcm_dwGetParam_ptr": (_U32, (_POINTER, _I32, _POINTER, _U64)),
    "spcm_dwSetParam_i32": (_U32, (_POINTER, _I32, _I32)),
    "spcm_dwSetParam_i64": (_U32, (_POINTER, _I32, _I64)),
    "spcm_dwSetParam_d64": (_U32, (_POINTER, _I32, _F64)),
    "spcm_dwSetParam_ptr": (_U32, (_POINTER, _I32, _POINTER, _U64)),
    "spcm_dwSetParam_i64m": (_U32, (_POINTER, _I32, _I32, _U32)),
    "spcm_dwDefTransfer_i64": (_U32, (_POINTER, _U32, _U32, _U32, _POINTER, _U64, _U64)),
    "spcm_dwInvalidateBuf": (_U32, (_POINTER, _U32)),
    "spcm_dwGetContBuf_i64": (_U32, (_POINTER, _U32, _POINTER, _POINTER)),
    "spcm_dwDiscovery": (_U32, (_POINTER, _U32, _U32, _U32)),
    "spcm_dwSendIDNRequest": (_U32, (_POINTER, _U32, _U32)),
}
"""Name of each function that ``spcm_core`` needs -> type of its result, types of its arguments."""


def typed(library: Any, name: str) -> Any:
    """A function of the vendor's library, with its signature."""
    result, arguments = SIGNATURES[name]
    address = ctypes.cast(getattr(library, name), ctypes.c_void_p).value
    return ctypes.CFUNCTYPE(result, *arguments)(address or 0)


LIBRARY: Final = "spcm_win64.dll" if os.name == "nt" else "libspcm_linux.so"

Function = Callable[..., Any]


class Library:
    """The C functions of the driver.

    Args:
        vendor: The vendor's library, or None.

    Attributes:
        functions: Name -> C function pointer, as ctypes makes them for a library.
        cards: Device name -> simulated card.
    """

    def __init__(self, vendor: Any) -> None:
        self.cards: dict[str, SimulatedCard] = {}
        self._open: dict[int, SimulatedCard] = {}
        self._handles: dict[int, ctypes.Array[ctypes.c_char]] = {}
        self._open_error = ErrorInfo()
        self._vendor = {} if vendor is None else {name: typed(vendor, name) for name in SIGNATURES}
        self._callbacks: list[Any] = []
        self.functions = {name: self._exported(name) for name in SIGNATURES}

    @property
    def has_vendor(self) -> bool:
        """Whether the vendor's library is there as well."""
        return bool(self._vendor)

    def _exported(self, name: str) -> Any:
        """A bare C function pointer without argument types, as for a function of a library."""
        result, arguments = SIGNATURES[name]
        callback = ctypes.CFUNCTYPE(result, *arguments)(self._routed(name))
        self._callbacks.append(callback)
        return ctypes.CFUNCTYPE(ctypes.c_int)(ctypes.cast(callback, ctypes.c_void_p).value or 0)

    def _routed(self, name: str) -> Function:
        own: Function = getattr(self, name.removeprefix("spcm").lower())
        vendor: Function | None = self._vendor.get(name)

        def call(*arguments: Any) -> Any:
            if vendor is not None and not self._is_ours(name, arguments[0]):
                return vendor(*arguments)
            try:
                return own(*arguments)
            except Exception as error:  # noqa: BLE001 - nothing may pass through C
                card = self._open.get(arguments[0])
                if card is not None:
                    card.break_down(repr(error))
                return None if SIGNATURES[name][0] is not ctypes.c_uint32 else r.ERR_INTERNAL_ERROR

        return call

    def _is_ours(self, name: str, first: Any) -> bool:
        if name == "spcm_hOpen":
            return (first or b"").decode(errors="replace") in self.cards
        return first in self._handles  # closed ones too, which the vendor's library must never see

    # The functions, by their names in small letters, with the arguments of their signatures.

    def _hopen(self, name: bytes | None) -> int | None:
        card = self.cards.get((name or b"").decode(errors="replace"))
        if card is None or not card.acquire():
            code = r.ERR_BOARDNOTFOUND if card is None else r.ERR_BOARDINUSE
            self._open_error = ErrorInfo(code, text=self._why_not((name or b"").decode(), card))
            return None
        handle = ctypes.create_string_buffer(8)
        address = ctypes.addressof(handle)
        self._handles[address] = handle
        self._open[address] = card
        return address

    def _why_not(self, name: str, card: SimulatedCard | None) -> str:
        if card is not None:
            return f"{name!r} is in use"
        if name.startswith(PREFIX) or self.has_vendor:
            return f"{name!r}: no such card"
        hint = "install Spectrum's driver, or set `card: simulated`"
        return f"there is no driver library for real cards; {hint}"

    def _vclose(self, handle: int | None) -> None:
        card = self._open.pop(handle or 0, None)
        if card is not None:
            card.release()

    def _write(self, handle: int | None, register: int, value: Number) -> int:
        card = self._open.get(handle or 0)
        return r.ERR_INVALIDHANDLE if card is None else card.write(register, value)

    _dwsetparam_i32 = _dwsetparam_i64 = _dwsetparam_d64 = _write

    def _dwsetparam_i64m(self, handle: int | None, register: int, high: int, low: int) -> int:
        return self._write(handle, register, high << 32 | low)

    def _dwsetparam_ptr(self, handle: int | None, register: int, _address: int, _n: int) -> int:
        if register == r.SPC_WRITE_TO_LOG:
            return r.ERR_OK
        return r.ERR_REG if handle in self._open else r.ERR_INVALIDHANDLE

    def _read(self, handle: int | None, register: int) -> tuple[int, Number]:
        card = self._open.get(handle or 0)
        if card is not None:
            return card.read(register)
        if not handle and register == r.SPC_GETDRVVERSION:
            return r.ERR_OK, DRIVER_VERSION
        return r.ERR_INVALIDHANDLE, 0

    def _read_into(self, kind: type[Slot], handle: int | None, register: int, out: int) -> int:
        code, value = self._read(handle, register)
        if kind is ctypes.c_int32 and not -(2**31) <= value < 2**31:
            return code or r.ERR_EXCEEDSINT32
        if not code:
            _put_number(kind, out, value)
        return code

    _dwgetparam_i32 = partialmethod(_read_into, ctypes.c_int32)
    _dwgetparam_i64 = partialmethod(_read_into, ctypes.c_int64)
    _dwgetparam_d64 = partialmethod(_read_into, ctypes.c_double)

    def _dwgetparam_ptr(self, handle: int | None, register: int, out: int, n_bytes: int) -> int:
        card = self._open.get(handle or 0)
        if card is None:
            return r.ERR_INVALIDHANDLE
        _put_text(out, card.model.name if register == r.SPC_PCITYP else "", n_bytes)
        return r.ERR_OK

    def _dwdeftransfer_i64(
        self, handle: int | None, kind: int, direction: int, notify: int, address: int, offset: int, size: int
    ) -> int:
        card = self._open.get(handle or 0)
        if card is None:
            return r.ERR_INVALIDHANDLE
        return card.define_transfer(kind, direction, offset, Buffer(address or 0, size, notify))

    def _dwinvalidatebuf(self, handle: int | None, _kind: int) -> int:
        card = self._open.get(handle or 0)
        return r.ERR_INVALIDHANDLE if card is None else card.invalidate()

    def _take_error(self, kind: type[Slot], handle: int | None, register: int, value: int, text: int) -> int:
        card = self._open.get(handle or 0)
        if card is None:
            error, self._open_error = self._open_error, ErrorInfo()
        else:
            error = card.take_error()
        if register:
            _put_number(ctypes.c_uint32, register, error.register)
        if value:
            _put_number(kind, value, error.value)
        if text:
            _put_text(text, error.text, r.ERRORTEXTLEN)
        return error.code

    _dwgeterrorinfo_i32 = partialmethod(_take_error, ctypes.c_int32)
    _dwgeterrorinfo_i64 = partialmethod(_take_error, ctypes.c_int64)
    _dwgeterrorinfo_d64 = partialmethod(_take_error, ctypes.c_double)

    def _dwgetcontbuf_i64(self, handle: int | None, _kind: int, out: int, length: int) -> int:
        card = self._open.get(handle or 0)
        if card is None:
            return r.ERR_INVALIDHANDLE
        address, n_bytes = card.continuous_buffer()
        _put_number(ctypes.c_int64, out, address)
        _put_number(ctypes.c_int64, length, n_bytes)
        return r.ERR_OK

    def _dwdiscovery(self, *_: Any) -> int:
        return r.ERR_OK

    _dwsendidnrequest = _dwdiscovery


def _put_number(kind: type[Slot], address: int, value: Number) -> None:
    """Write a number to where a pointer points."""
    slot: Any = kind.from_address(address)
    slot.value = value if kind is ctypes.c_double else int(value)


def _put_text(address: int, text: str, n_bytes: int) -> None:
    """Write a text with its final zero, cut to the buffer's length."""
    raw = text.encode()[: max(0, n_bytes - 1)] + b"\0"
    ctypes.memmove(address, raw, len(raw))


PREFIX: Final = "simulated"
"""Device names that begin like this belong to simulated cards. The vendor's never do."""

_LOCK: Final = threading.Lock()
_LIBRARIES: Final[list[Library]] = []
"""The library of this process, once there is one. ``spcm_core`` keeps it until the process ends."""


class SimulatedLibrary:
    """``spcm_core`` with a simulated card, which the driver opens instead of the vendor's library.

    Args:
        name: "simulated" for a new card at each ``connect``, another name for a card that :func:`install`
            made available.
        clock: The session's time.
        simulation: Receives the card's output, if it implements ``ReceivesOutput``.
        row_channel: Channel that drives the row axis.
        column_channel: Channel that drives the columns, None for the other of 0 and 1.
        new_card: Makes the card. Takes the arguments of :class:`SimulatedCard`.

    Attributes:
        card: The new card in this process, while connected.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        simulation: Simulation | None,
        row_channel: int,
        column_channel: int | None = None,
        new_card: Callable[..., SimulatedCard] = SimulatedCard,
    ) -> None:
        self._name = name
        self._new_card = new_card
        self._column_channel = column_channel
        self._clock = clock
        self._simulation = simulation
        self._row_channel = row_channel
        self.card: SimulatedCard | None = None

    def load(self) -> Any:
        """Import ``spcm_core`` so that it finds simulated cards."""
        with _LOCK:
            _library()
        return importlib.import_module("spcm_core")

    def warm(self) -> None:
        """Compile the kernels with which the simulation evaluates the outputs."""
        if self._name == PREFIX and isinstance(self._simulation, ReceivesOutput):
            self._simulation.warm()

    def connect(self) -> str:
        """Make the card available, and return its device name."""
        if self._name != PREFIX:
            return self._name
        received = isinstance(self._simulation, ReceivesOutput)
        self.card = card = self._new_card(self._clock, keep_history=received)
        self.wire(card)
        return install(card)

    def wire(self, card: SimulatedCard) -> None:
        """Connect a card's trigger input to the simulation, and its outputs if that looks at them."""
        if self._simulation is not None:
            self._simulation.wire("mobile_tweezers", lambda t_s, _width_s: card.trigger_at(t_s))
        if isinstance(self._simulation, ReceivesOutput):
            outputs = CardOutputs(card, self._row_channel, self._column_channel)
            self._simulation.connect_outputs("mobile_tweezers", outputs)

    def disconnect(self) -> None:
        """Remove the card."""
        for library in _LIBRARIES:
            library.cards = {name: card for name, card in library.cards.items() if card is not self.card}
        self.card = None

    def functions(self) -> tuple[int, int]:
        """Addresses of the C functions that read and write a register of 64 bits."""
        functions = _library().functions
        read, write = (
            ctypes.cast(functions[name], ctypes.c_void_p).value or 0
            for name in ("spcm_dwGetParam_i64", "spcm_dwSetParam_i64")
        )
        return read, write

    def call_in_virtual_time(self, step: Callable[[], float | None] | None) -> bool:
        """Have the card call a driver's step whenever it is due. False if time is real."""
        card = self.card or _library().cards.get(self._name)
        if not self._clock.virtual or card is None:
            return False
        card.call(step)
        return True

    def step_time_s(self) -> float:
        """The time of the step that is being called, which may be earlier than the clock's."""
        card = self.card or _library().cards[self._name]
        return card.step_time_s

    def emergency(self, script: Path, n_outputs: int) -> Emergency | None:  # noqa: ARG002 - for a real card
        """None, since the card is in this process, and dies with it."""
        return None


class CardOutputs:
    """The two output connectors of a simulated card, for a simulation that receives their signals.

    Implements ``labseq.plugin.simulation.RfSource``. Each span is reported once and then dropped by the card.

    Args:
        card: The card.
        row_channel: Channel that drives the row axis.
        column_channel: Channel that drives the columns, None for the other of 0 and 1.
    """

    def __init__(self, card: SimulatedCard, row_channel: int, column_channel: int | None = None) -> None:
        self._card = card
        self._channels = row_channel, 1 - row_channel if column_channel is None else column_channel
        self._reported_s = -math.inf

    def played(self, until_s: float) -> tuple[list[RfSpan], list[RfSpan]]:
        """The spans that the row output and the column output played since the last call, in time's order."""
        rows, columns = (self._since(channel, until_s) for channel in self._channels)
        self._card.forget(until_s)
        self._reported_s = max(self._reported_s, until_s)
        return rows, columns

    def _since(self, channel: int, until_s: float) -> list[RfSpan]:
        spans = (
            (span, span.between(max(span.start_s, self._reported_s), min(span.end_s, until_s)))
            for span in self._card.played(channel)
            if span.end_s > self._reported_s and span.start_s < until_s
        )
        return [_rf_span(part, span) for span, part in spans if part.end_s > part.start_s]


def _rf_span(span: SampleSpan, whole: SampleSpan) -> RfSpan:
    if whole.n_samples > len(whole.samples):
        return _loop_tones(span)
    return RfSamples(span.start_s, span.sample_rate_hz, span.values(), span.amplitude_v / FULL_SCALE)


def _loop_tones(span: SampleSpan) -> RfTones:
    """Samples that repeat, as their tones, except tones lost in their rounding."""
    n = len(span.samples)
    spectrum = np.fft.rfft(np.roll(span.samples, -span.first)) * (2 / n)
    bins = np.flatnonzero(np.abs(spectrum) > 1.0)
    zeros, found = np.zeros(len(bins)), spectrum[bins]
    hz, volts = bins * span.sample_rate_hz / n, np.abs(found) * span.amplitude_v / FULL_SCALE
    return RfTones(span.start_s, span.end_s, hz, zeros, volts, zeros, np.angle(found))


def install(card: SimulatedCard, name: str = "") -> str:
    """Make a simulated card available under a device name.

    Args:
        card: The card.
        name: Its device name, which begins with "simulated", by default a free one.

    Returns:
        The device name, for ``spcm.Card(name)``.

    Raises:
        DeviceError: The name is taken, or could be a real card's.
    """
    with _LOCK:
        library = _library()
        if not name:
            name = next(free for n in range(10**6) if (free := f"{PREFIX}{n}") not in library.cards)
        if not name.startswith(PREFIX) or name in library.cards:
            reason = "is taken" if name in library.cards else f"does not begin with {PREFIX!r}"
            raise DeviceError(
                "spcm simulator", f"the device name {name!r} {reason}; leave it out to get a free one"
            )
        library.cards[name] = card
        return name


@contextmanager
def installed(card: SimulatedCard, name: str = "") -> Generator[str]:
    """Make the card available within the block, and give its device name."""
    name = install(card, name)
    try:
        yield name
    finally:
        for library in _LIBRARIES:
            library.cards.pop(name, None)


def vendor_library_found() -> bool:
    """Whether the vendor's library is installed, so that real cards can be opened."""
    for library in _LIBRARIES:
        return library.has_vendor
    return _vendor() is not None


def _loader() -> Any:
    return ctypes.cdll if sys.platform != "win32" else ctypes.windll


def _vendor() -> Any:
    """The vendor's library, or None."""
    try:
        return _loader().LoadLibrary(LIBRARY)
    except OSError:
        return None


def _library() -> Library:
    """The library of this process. The first call imports ``spcm_core``, even if it was imported before."""
    if not _LIBRARIES:
        library = Library(_vendor())
        for name in [name for name in sys.modules if name.partition(".")[0] in ("spcm", "spcm_core")]:
            del sys.modules[name]  # an importer of the old one keeps the vendor's functions
        with _answered(library):
            importlib.import_module("spcm_core")
        _LIBRARIES.append(library)
    return _LIBRARIES[0]


@contextmanager
def _answered(library: Library) -> Generator[None]:
    """Within the block a load of the vendor's library gets ours."""
    loader = _loader()
    load = loader.LoadLibrary

    def answer(name: str) -> Any:
        return SimpleNamespace(**library.functions) if name == LIBRARY else load(name)

    loader.LoadLibrary = answer
    try:
        yield
    finally:
        loader.LoadLibrary = load
