"""Calls of C from compiled code, and clocks, signals and thread priorities without Python."""

from __future__ import annotations

from labseq.kernels.kernel import c_address, n_cores
from labseq.kernels.native import (
    N_SIGNAL,
    N_TIMER,
    WakeSignal,
    call_c,
    carray,
    new_timer,
    now_ns,
    pointer,
    set_signal,
    sleep_ns,
    swap,
    wait_signal,
)
from labseq.realtime import raise_priority

__all__ = [
    "N_SIGNAL",
    "N_TIMER",
    "WakeSignal",
    "c_address",
    "call_c",
    "carray",
    "n_cores",
    "new_timer",
    "now_ns",
    "pointer",
    "raise_priority",
    "set_signal",
    "sleep_ns",
    "swap",
    "wait_signal",
]
