"""The C interface of the driver: signatures, and the values behind its pointers."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq_spcm.simulator import registers as r
from labseq_spcm.simulator.rules import Number

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
"""Name of each function that ``spcm`` needs -> type of its result, types of its arguments."""

LIST_PARAM: Final = np.dtype([("register", "<i4"), ("type", "<i4"), ("value", "<i8")])
"""One entry of a register list: 16 bytes, the value an integer or a double."""


def typed(library: Any, name: str) -> Any:
    """A function of the vendor's library, with its signature."""
    result, arguments = SIGNATURES[name]
    address = ctypes.cast(getattr(library, name), ctypes.c_void_p).value
    return ctypes.CFUNCTYPE(result, *arguments)(address or 0)


def put_number(kind: type[Slot], address: int, value: Number) -> int:
    """Write a number to where a pointer points; returns "no error"."""
    slot: Any = kind.from_address(address)
    slot.value = value if kind is ctypes.c_double else int(value)
    return r.ERR_OK


def put_text(address: int, text: str, n_bytes: int) -> None:
    """Write a text with its final zero, cut to the buffer's length."""
    raw = text.encode()[: max(0, n_bytes - 1)] + b"\0"
    ctypes.memmove(address, raw, len(raw))


def list_entries(address: int, n_bytes: int) -> NDArray[np.void]:
    """A copy of a register list, ``LIST_PARAM`` (n,)."""
    raw = (ctypes.c_char * n_bytes).from_address(address)
    return np.frombuffer(memoryview(raw), LIST_PARAM).copy()


def real_values(entries: NDArray[np.void]) -> NDArray[np.float64]:
    """The values of a register list, float64 (n,), whether they are integers or real numbers."""
    whole = entries["value"]
    return np.where(entries["type"] == r.TYPE_DOUBLE, whole.copy().view(np.float64), whole)


def list_writes(entries: NDArray[np.void]) -> Iterator[tuple[int, Number]]:
    """The (register, value) of a register list."""
    doubles: list[bool] = (entries["type"] == r.TYPE_DOUBLE).tolist()
    whole: list[int] = entries["value"].tolist()
    real: list[float] = entries["value"].copy().view(np.float64).tolist()
    registers: list[int] = entries["register"].tolist()
    for i, register in enumerate(registers):
        yield register, real[i] if doubles[i] else whole[i]
