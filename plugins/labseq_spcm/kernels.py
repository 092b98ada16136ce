"""The order of samples on the card, and the lock of the driver library's calls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel
from labseq.plugin.native import sleep_ns, swap

Words = NDArray[np.uint16]
Longs = NDArray[np.int64]


@kernel(f"void({const('uint16', 1)}, {const('uint16', 1)}, uint32[::1])")
def interleave(first: Words, second: Words, out: NDArray[np.uint32]) -> None:
    """Interleave the samples of both outputs, as the card stores them.

    It writes whole frames of unsigned words, so that the processor can do many at a time. They are uint32
    (n,), from the bits of the samples of each output, uint16 (n,), output 0 in the low word.
    """
    for i in range(len(out)):
        out[i] = np.uint32(first[i]) | (np.uint32(second[i]) << np.uint32(16))


@kernel("void(int64, int64[::1])")
def take(lock: int, timer: Longs) -> None:
    """Wait until the int64 at an address is 0, and make it 1.

    It sleeps in between, since on one core a thread with priority would keep the owner from giving it back.
    """
    while swap(lock, 1):
        sleep_ns(timer, 2_000)


@kernel("void(int64)")
def give(lock: int) -> None:
    """Make the int64 at an address 0 again."""
    swap(lock, 0)
