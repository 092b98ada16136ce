"""Calls of SpinCore's library, and how another process turns the lines off with them.

labseq's watchdog loads this file by its path after the run that used the board has died. It needs nothing but
Python's standard library. A board goes on with its program when the process that started it has died, and
holds its levels after the end.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
from collections.abc import Iterable
from functools import cache
from typing import Any

CONTINUE, BRANCH = 0, 6
HOLD_NS = 1e6
"""Length of an instruction that is repeated for ever, in nanoseconds."""


class SpinapiError(Exception):
    """A call was refused. The text comes from SpinCore's library."""


def prepare(**board: Any) -> None:
    """Load SpinCore's library without touching the board.

    Raises:
        SpinapiError: It is not there.
    """
    del board
    load()


def off(board_number: int, clock_mhz: float, flags: int) -> str:
    """Stop the board, and let it hold the flags of lines that are off.

    Returns:
        What was done.

    Raises:
        SpinapiError: The board refused.
    """
    library = load()
    connect(library, board_number, clock_mhz)
    hold(library, flags)
    call(library, "pb_close")
    return f"PulseBlaster {board_number} holds the flags {flags:#08x}"


@cache
def load() -> Any:
    """SpinCore's library, with the types of its arguments."""
    names = ("spinapi64", "spinapi") if sys.platform == "win32" else ("libspinapi.so",)
    path = next(filter(None, map(ctypes.util.find_library, names)), names[0])
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        raise SpinapiError(f"SpinCore's library cannot be loaded: {error}") from error
    library.pb_core_clock.argtypes = [ctypes.c_double]
    library.pb_core_clock.restype = None  # it returns nothing in older versions
    library.pb_inst_pbonly.argtypes = [ctypes.c_uint, ctypes.c_int, ctypes.c_int, ctypes.c_double]
    for name in ("pb_get_error", "pb_get_version"):
        getattr(library, name).restype = ctypes.c_char_p
    return library


def call(library: Any, name: str, *arguments: float) -> int:
    """Call a function that returns a negative number if it refuses.

    Raises:
        SpinapiError: It refused.
    """
    result = getattr(library, name)(*arguments)
    if result is not None and result < 0:
        raise SpinapiError(f"{name}: {library.pb_get_error().decode(errors='replace').strip()}")
    return result or 0


def connect(library: Any, board_number: int, clock_mhz: float) -> None:
    """Open a board, whose clock the library cannot find out."""
    call(library, "pb_select_board", board_number)
    call(library, "pb_init")
    call(library, "pb_core_clock", clock_mhz)


def hold(library: Any, flags: int) -> None:
    """Let the board repeat these flags for ever.

    Its outputs then do not depend on the firmware's levels after the end of a program.
    """
    write(library, [(flags, CONTINUE, 0, HOLD_NS), (flags, BRANCH, 0, HOLD_NS)])
    call(library, "pb_start")


def write(library: Any, instructions: Iterable[tuple[int, int, int, float]]) -> None:
    """Stop the board and write a program of instructions (flags, code, data and length in nanoseconds)."""
    call(library, "pb_stop")
    call(library, "pb_start_programming", 0)
    for instruction in instructions:
        call(library, "pb_inst_pbonly", *instruction)
    call(library, "pb_stop_programming")
