"""The order of samples on the card."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel

Words = NDArray[np.uint16]


@kernel(f"void({const('uint16', 1)}, {const('uint16', 1)}, uint32[::1])")
def interleave(first: Words, second: Words, out: NDArray[np.uint32]) -> None:
    """Put the samples of both outputs side by side, as the card wants them.

    Whole frames are written, and the signs do not matter: both let the processor do many at a time.

    Args:
        first: uint16 (n,): the samples of output 0, bit by bit.
        second: uint16 (n,): of output 1.
        out: Result, uint32 (n,): the frames; output 0 comes first in the memory of a little-endian computer.
    """
    for i in range(len(out)):
        out[i] = np.uint32(first[i]) | (np.uint32(second[i]) << np.uint32(16))
