"""The order of samples on the card."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel

Words = NDArray[np.uint16]


@kernel(f"void({const('uint16', 1)}, {const('uint16', 1)}, uint32[::1])")
def interleave(first: Words, second: Words, out: NDArray[np.uint32]) -> None:
    """Interleave the samples of both outputs, as the card stores them.

    It writes whole frames of unsigned words, so that the processor can do many at a time: uint32 (n,) from
    the bits of the samples of each output, uint16 (n,), output 0 in the low word.
    """
    for i in range(len(out)):
        out[i] = np.uint32(first[i]) | (np.uint32(second[i]) << np.uint32(16))
