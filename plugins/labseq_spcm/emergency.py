"""Switches a Spectrum card off from another process, with the vendor's library alone.

labseq's watchdog loads this file by its path after the run that used the card has died. It needs nothing
but Python's standard library. It stops the card, so that the outputs go to their stop level of 0 V, and sets
the lowest amplitude. Then it opens the output relays, which only takes effect with WRITESETUP. Last it resets
the card, which disables the outputs even if the library, new in this process, takes them for disabled.
"""

from __future__ import annotations

import ctypes
import sys
import time
from functools import cache
from typing import Any

SPC_M2CMD, SPC_M2STATUS = 100, 110
SPC_AMP0, SPC_ENABLEOUT0, NEXT_OUTPUT = 30010, 30091, 100
M2CMD_CARD_RESET, M2CMD_CARD_WRITESETUP = 0x1, 0x2
M2CMD_CARD_STOP, M2CMD_DATA_STOPDMA = 0x40, 0x40000
M2STAT_CARD_READY = 0x4

LOWEST_MV = 80
HELD_S = 2.0
"""How long another process may still hold the card, in seconds. A dying process gives it back by then."""


class EmergencyError(Exception):
    """The card could not be switched off. The text says why."""


def prepare(library: str, card: str, n_outputs: int = 2) -> None:
    """Load the driver library without touching the card.

    Raises:
        EmergencyError: Wrong arguments, or there is no such library.
    """
    if not card or type(card) is not str:
        raise EmergencyError(f"the card's device name is {card!r}; expected a text such as '/dev/spcm0'")
    if type(n_outputs) is not int or not 2 <= n_outputs <= 4:
        raise EmergencyError(f"the card's number of outputs is {n_outputs!r}; expected 2 to 4")
    load(library)


def off(library: str, card: str, n_outputs: int = 2) -> str:
    """Stop the card, disable its outputs, and close it. A card that is off stays off.

    Args:
        library: The driver library.
        card: The card's device name.
        n_outputs: How many outputs it has.

    Returns:
        What was done.

    Raises:
        EmergencyError: The card cannot be opened, or refuses. The text comes from the driver library.
    """
    prepare(library, card, n_outputs)
    device = _Card(load(library), card, n_outputs)
    try:
        return device.switch_off()
    finally:
        device.close()


@cache
def load(library: str) -> Any:
    """The driver library, its functions with their signatures."""
    try:
        cdll: Any = ctypes.WinDLL(library) if sys.platform == "win32" else ctypes.CDLL(library)
    except (OSError, TypeError) as error:
        raise EmergencyError(f"the driver library {library!r} cannot be loaded: {error}") from error
    return signed(cdll)


def signed(library: Any) -> Any:
    """The functions that are used here, with their signatures."""
    handle, number = ctypes.c_void_p, ctypes.c_int32
    library.spcm_hOpen.restype, library.spcm_hOpen.argtypes = handle, [ctypes.c_char_p]
    library.spcm_vClose.restype, library.spcm_vClose.argtypes = None, [handle]
    for name, value in (("Set", number), ("Get", handle)):
        function = getattr(library, f"spcm_dw{name}Param_i32")
        function.restype, function.argtypes = ctypes.c_uint32, [handle, number, value]
    library.spcm_dwGetErrorInfo_i32.restype = ctypes.c_uint32
    library.spcm_dwGetErrorInfo_i32.argtypes = [handle] * 4
    return library


class _Card:
    """The open card."""

    def __init__(self, library: Any, name: str, n_outputs: int) -> None:
        self._library, self._outputs = library, range(n_outputs)
        deadline_s = time.monotonic() + HELD_S
        while not (handle := library.spcm_hOpen(name.encode())):
            reason = _error(library, None)
            if time.monotonic() > deadline_s:
                raise EmergencyError(f"the card {name!r} cannot be opened for {HELD_S:g} s: {reason}")
            time.sleep(1e-3)
        self._handle = handle

    def switch_off(self) -> str:
        """Do all steps, even after a refused one, then check that the card took them."""
        steps: list[tuple[int, int, str]] = [
            (SPC_M2CMD, M2CMD_CARD_STOP | M2CMD_DATA_STOPDMA, "stop"),
            *(
                (SPC_AMP0 + NEXT_OUTPUT * n, LOWEST_MV, f"lowest amplitude of output {n}")
                for n in self._outputs
            ),
            *((SPC_ENABLEOUT0 + NEXT_OUTPUT * n, 0, f"disabling output {n}") for n in self._outputs),
            (SPC_M2CMD, M2CMD_CARD_WRITESETUP, "writing the set-up"),
            (SPC_M2CMD, M2CMD_CARD_RESET, "reset of the card"),
        ]
        refused: dict[str, str] = {}
        for register, value, step in steps:
            # try again after an error, which may be an earlier one that blocked the library until it was read
            if self._write(register, value) and (reason := self._write(register, value)):
                refused[step] = reason
        reasons = "; ".join(f"{step}: {reason}" for step, reason in refused.items())
        if len(refused) > 1 and "reset of the card" in refused:
            raise EmergencyError(reasons)
        status = self._read(SPC_M2STATUS)
        enabled = [n for n in self._outputs if self._read(SPC_ENABLEOUT0 + NEXT_OUTPUT * n)]
        if enabled or not status & M2STAT_CARD_READY:
            text = f"the card reads status {status:#x} and enabled outputs {enabled}"
            raise EmergencyError(f"{text}; {reasons}" if reasons else text)
        *first, last = map(str, self._outputs)
        outcome = f"card stopped, outputs {', '.join(first)} and {last} disabled"
        how = "" if "reset of the card" in refused else " by its reset"
        return f"{outcome}{how}; refused: {reasons}" if refused else outcome

    def close(self) -> None:
        """Give the card back."""
        self._library.spcm_vClose(self._handle)

    def _write(self, register: int, value: int) -> str:
        """Write a register, and return why it was refused."""
        if self._library.spcm_dwSetParam_i32(self._handle, register, value):
            return _error(self._library, self._handle)
        return ""

    def _read(self, register: int) -> int:
        value = ctypes.c_int32()
        if self._library.spcm_dwGetParam_i32(self._handle, register, ctypes.addressof(value)):
            raise EmergencyError(f"reading register {register}: {_error(self._library, self._handle)}")
        return value.value


def _error(library: Any, handle: int | None) -> str:
    """The pending error's text. Reading it unlocks the library."""
    text = ctypes.create_string_buffer(256)  # the driver library writes at most 200 characters
    code = library.spcm_dwGetErrorInfo_i32(handle, None, None, ctypes.addressof(text))
    return (text.value.decode(errors="replace").strip().splitlines() or [f"error {code:#x}"])[0]
