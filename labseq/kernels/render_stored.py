"""The paper's way to make samples, as a baseline: stored waveforms are picked and summed."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel

STORED_BLOCK: Final = 4096


@kernel(f"void({const('int16', 2)}, int64[::1], int64, int16[::1])")
def sum_stored(
    stored: NDArray[np.int16], picked: NDArray[np.int64], first: int, out: NDArray[np.int16]
) -> None:
    """Sum stored waveforms, block by block so that the sums stay in the fastest cache.

    Args:
        stored: int16 (n_tones, >= first + n_samples).
        picked: int64 (n_picked,), which of them.
        first: First sample.
        out: Result, int16 (n_samples,).
    """
    for start in range(0, len(out), STORED_BLOCK):
        part = out[start : start + STORED_BLOCK]
        part[:] = 0
        for k in picked:
            one = stored[k, first + start : first + start + STORED_BLOCK]
            for j in range(len(part)):
                part[j] += one[j]
