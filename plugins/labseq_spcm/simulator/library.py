"""The vendor's library, as far as ``spcm`` uses it: C functions in front of simulated cards.

``spcm`` loads the vendor's library when it is imported, and keeps its functions. Here the
load is answered with functions of our own: plain C function pointers, so that every call of
``spcm`` takes the same way through ctypes as with the real library, real buffers included.
A call with the handle of a simulated card goes to that card. Every other call goes to the
vendor's library if there is one, so real and simulated cards can be open side by side.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from typing import Any, Final

from labseq_spcm.simulator import registers as r
from labseq_spcm.simulator.calls import SIGNATURES, Slot, list_entries, put_number, put_text, typed
from labseq_spcm.simulator.card import DRIVER_VERSION, SimulatedCard
from labseq_spcm.simulator.memory import Buffer
from labseq_spcm.simulator.rules import ErrorInfo, Number

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
        """A bare C function pointer: no argument types, as for a function of a library."""
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
        return first in self._handles  # closed ones too: the vendor's library must never see them

    # The functions, by their names in small letters, with the arguments of their signatures.

    def _hopen(self, name: bytes | None) -> int | None:
        card = self.cards.get((name or b"").decode(errors="replace"))
        if card is None or card in self._open.values():
            code = r.ERR_BOARDNOTFOUND if card is None else r.ERR_BOARDINUSE
            self._open_error = ErrorInfo(
                code, text=f"{name!r}: {'no such card' if card is None else 'in use'}"
            )
            return None
        handle = ctypes.create_string_buffer(8)
        address = ctypes.addressof(handle)
        self._handles[address] = handle
        self._open[address] = card
        return address

    def _vclose(self, handle: int | None) -> None:
        self._open.pop(handle or 0, None)

    def _write(self, handle: int | None, register: int, value: Number) -> int:
        card = self._open.get(handle or 0)
        return r.ERR_INVALIDHANDLE if card is None else card.write(register, value)

    _dwsetparam_i32 = _dwsetparam_i64 = _dwsetparam_d64 = _write

    def _dwsetparam_i64m(self, handle: int | None, register: int, high: int, low: int) -> int:
        return self._write(handle, register, high << 32 | low)

    def _dwsetparam_ptr(self, handle: int | None, register: int, address: int, n_bytes: int) -> int:
        if register == r.SPC_WRITE_TO_LOG:
            return r.ERR_OK
        card = self._open.get(handle or 0)
        if card is None:
            return r.ERR_INVALIDHANDLE
        if register != r.SPC_REGISTER_LIST:
            return r.ERR_REG
        return card.write_list(list_entries(address, n_bytes))

    def _read(self, handle: int | None, register: int) -> tuple[int, Number]:
        card = self._open.get(handle or 0)
        if card is not None:
            return card.read(register)
        if not handle and register == r.SPC_GETDRVVERSION:
            return r.ERR_OK, DRIVER_VERSION
        return r.ERR_INVALIDHANDLE, 0

    def _dwgetparam_i32(self, handle: int | None, register: int, out: int) -> int:
        code, value = self._read(handle, register)
        if not code and not -(2**31) <= value < 2**31:
            return r.ERR_EXCEEDSINT32
        return code or put_number(ctypes.c_int32, out, value)

    def _dwgetparam_i64(self, handle: int | None, register: int, out: int) -> int:
        code, value = self._read(handle, register)
        return code or put_number(ctypes.c_int64, out, value)

    def _dwgetparam_d64(self, handle: int | None, register: int, out: int) -> int:
        code, value = self._read(handle, register)
        return code or put_number(ctypes.c_double, out, value)

    def _dwgetparam_ptr(self, handle: int | None, register: int, out: int, n_bytes: int) -> int:
        card = self._open.get(handle or 0)
        if card is None:
            return r.ERR_INVALIDHANDLE
        put_text(out, card.model.name if register == r.SPC_PCITYP else "", n_bytes)
        return r.ERR_OK

    def _dwdeftransfer_i64(
        self,
        handle: int | None,
        kind: int,
        direction: int,
        notify: int,
        address: int,
        offset: int,
        n_bytes: int,
    ) -> int:
        card = self._open.get(handle or 0)
        if card is None:
            return r.ERR_INVALIDHANDLE
        return card.define_transfer(kind, direction, Buffer(address or 0, offset, n_bytes, notify))

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
            put_number(ctypes.c_uint32, register, error.register)
        if value:
            put_number(kind, value, error.value)
        if text:
            put_text(text, error.text, r.ERRORTEXTLEN)
        return error.code

    def _dwgeterrorinfo_i32(self, handle: int | None, register: int, value: int, text: int) -> int:
        return self._take_error(ctypes.c_int32, handle, register, value, text)

    def _dwgeterrorinfo_i64(self, handle: int | None, register: int, value: int, text: int) -> int:
        return self._take_error(ctypes.c_int64, handle, register, value, text)

    def _dwgeterrorinfo_d64(self, handle: int | None, register: int, value: int, text: int) -> int:
        return self._take_error(ctypes.c_double, handle, register, value, text)

    def _dwgetcontbuf_i64(self, _handle: int | None, _kind: int, _out: int, _length: int) -> int:
        return r.ERR_FNCNOTSUPPORTED

    def _dwdiscovery(self, *_: Any) -> int:
        return r.ERR_OK

    _dwsendidnrequest = _dwdiscovery
