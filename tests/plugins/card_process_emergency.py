"""The emergency script of the real card, on a simulated card that outlives the process.

labseq's watchdog loads this file by its path; it needs nothing but Python's standard library. The script of
the driver runs unchanged: its driver library is made of C functions that ask the simulated card's process.
"""

from __future__ import annotations

import ctypes
import json
import runpy
import threading
from contextlib import suppress
from functools import cache
from multiprocessing.connection import Client
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

ADDRESS: Final = "cards.json"
"""File in the folder with the address of the process of the cards."""
HANDLE: Final = 1


class Connection:
    """A connection to a simulated card in a process of its own.

    Args:
        card: Its path.

    Raises:
        OSError: There is no such process.
    """

    def __init__(self, card: str) -> None:
        found = json.loads((Path(card).parent / ADDRESS).read_text("utf-8"))
        address = found["address"] if isinstance(found["address"], str) else tuple(found["address"])
        self._pipe: Any = Client(address, authkey=bytes.fromhex(found["key"]))
        self._lock = threading.Lock()
        self._pipe.send(Path(card).name)

    def __call__(self, method: str, *arguments: Any) -> Any:
        """Call a method of the card, or of what is connected to its outputs."""
        with self._lock:
            self._pipe.send((method, arguments))
            is_fine, value = self._pipe.recv()
        if not is_fine:
            raise RuntimeError(value)
        return value

    def close(self) -> None:
        """Close the connection; the card continues."""
        self._pipe.close()


class _Driver:
    """The functions of the driver library that the script uses, for one card."""

    def __init__(self) -> None:
        self._card: Connection | None = None
        self._reason = ""
        handle, number, answer = ctypes.c_void_p, ctypes.c_int32, ctypes.c_uint32
        self.functions = {
            "spcm_hOpen": ctypes.CFUNCTYPE(handle, ctypes.c_char_p)(self._open),
            "spcm_vClose": ctypes.CFUNCTYPE(None, handle)(self._close),
            "spcm_dwSetParam_i32": ctypes.CFUNCTYPE(answer, handle, number, number)(self._set),
            "spcm_dwGetParam_i32": ctypes.CFUNCTYPE(answer, handle, number, handle)(self._get),
            "spcm_dwGetErrorInfo_i32": ctypes.CFUNCTYPE(answer, *[handle] * 4)(self._error),
        }

    def _open(self, name: bytes) -> int | None:
        try:
            card = Connection(name.decode())
            if card("acquire"):
                self._card = card
                return HANDLE
            self._reason = "it is in use"
            card.close()
        except (OSError, EOFError, ValueError) as error:
            self._reason = f"no such card ({error})"
        return None

    def _close(self, _handle: int) -> None:
        if self._card is not None:
            with suppress(OSError, EOFError):
                self._card("release")
            self._card.close()
            self._card = None

    def _set(self, _handle: int, register: int, value: int) -> int:
        return self._card("write_all", [(register, value)]) if self._card else 1

    def _get(self, _handle: int, register: int, out: int) -> int:
        code, value = self._card("read", register) if self._card else (1, 0)
        ctypes.c_int32.from_address(out).value = int(value)
        return code

    def _error(self, _handle: int, _register: int, _value: int, text: int) -> int:
        code, reason = (0, self._reason) if self._card is None else self._card("take_error")[::3]
        raw = reason.encode()[:199] + b"\0"
        ctypes.memmove(text, raw, len(raw))
        return code


@cache
def _script(script: str) -> Any:
    """The driver's emergency script, its driver library replaced."""
    driver = _Driver()
    globals_of = SimpleNamespace(**runpy.run_path(script))
    library = globals_of.signed(SimpleNamespace(**driver.functions))

    def load(_library: str) -> Any:
        return library

    for function in (value for name, value in vars(globals_of).items() if name in ("off", "play")):
        function.__globals__["load"] = load
    return globals_of


def prepare(script: str, **arguments: Any) -> None:
    """See the driver's script."""
    _script(script).prepare(**arguments)


def off(script: str, **arguments: Any) -> str:
    """See the driver's script."""
    return _script(script).off(**arguments)


def play(script: str, **arguments: Any) -> None:
    """See the driver's script of the first contact."""
    _script(script).play(**arguments)
