"""A separate process that plays on the card until it is killed, for the first contact.

It needs nothing but Python's standard library, and loads the driver library by ``emergency.py`` in this
folder. It repeats the content of the card's memory at the lowest amplitude.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

_EMERGENCY = runpy.run_path(str(Path(__file__).with_name("emergency.py")))
load = _EMERGENCY["load"]
signed = _EMERGENCY["signed"]

SPC_M2CMD, SPC_CARDMODE = 100, 9500
SPC_MEMSIZE, SPC_LOOPS, SPC_CHENABLE, SPC_SAMPLERATE = 10000, 10020, 11000, 20000
SPC_AMP0, SPC_AMP1 = 30010, 30110
SPC_ENABLEOUT0, SPC_ENABLEOUT1 = 30091, 30191
SPC_TRIG_ORMASK, SPC_TRIG_ANDMASK = 40410, 40430
SPC_REP_STD_SINGLE = 0x100
M2CMD_START, M2CMD_ENABLETRIGGER, M2CMD_FORCETRIGGER = 0x4, 0x8, 0x10
LOWEST_MV = 80
TONE_SAMPLES = 1 << 16
"""Samples per channel that are repeated."""


def play(library: str, card: str, rate_hz: int, relays: bool) -> None:
    """Play the content of the memory until the process is killed. It prints "playing" when it has begun."""
    functions = load(library)
    handle = functions.spcm_hOpen(card.encode())
    if not handle:
        sys.exit(f"the card {card!r} cannot be opened: {_EMERGENCY['_error'](functions, None)}")
    settings: list[tuple[int, int]] = [
        (SPC_CHENABLE, 3),
        (SPC_CARDMODE, SPC_REP_STD_SINGLE),
        (SPC_MEMSIZE, TONE_SAMPLES),
        (SPC_LOOPS, 0),
        (SPC_SAMPLERATE, rate_hz),
        (SPC_TRIG_ORMASK, 0),
        (SPC_TRIG_ANDMASK, 0),
        (SPC_AMP0, LOWEST_MV),
        (SPC_AMP1, LOWEST_MV),
        (SPC_ENABLEOUT0, int(relays)),
        (SPC_ENABLEOUT1, int(relays)),
        (SPC_M2CMD, M2CMD_START | M2CMD_ENABLETRIGGER | M2CMD_FORCETRIGGER),
    ]
    for register, value in settings:
        if functions.spcm_dwSetParam_i32(handle, register, value):
            _refused(functions, handle, register)
    print("playing", flush=True)  # noqa: T201 - read by the process that kills this one
    sys.stdin.read()  # until it is killed, or the other process dies


def _refused(functions: Any, handle: Any, register: int) -> None:
    sys.exit(f"register {register}: {_EMERGENCY['_error'](functions, handle)}")
