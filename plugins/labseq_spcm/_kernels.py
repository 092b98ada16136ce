"""The order of samples on the card."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel


@kernel(f"void({const('int16', 2)}, int64, int16[:, ::1])")
def interleave(chunk: NDArray[np.int16], row_channel: int, out: NDArray[np.int16]) -> None:
    """Put the samples of both axes side by side, as the card wants them.

    Args:
        chunk: int16 (2, n): row axis, column axis.
        row_channel: The output of the row axis, 0 or 1.
        out: Result, int16 (m, 2) with m <= n: a column per output.
    """
    first, second = chunk[row_channel], chunk[1 - row_channel]
    for i in range(len(out)):
        out[i, 0] = first[i]
        out[i, 1] = second[i]
