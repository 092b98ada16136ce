"""What the kernels that render an axis work on."""

from __future__ import annotations

from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel
from labseq.kernels.render_comb import N_STATE
from labseq.kernels.render_paths import MAX_GROUPS, N_COEFFICIENTS
from labseq.kernels.render_tables import LANES, N_CHIRPS

Bytes = NDArray[np.int8]
Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Samples = NDArray[np.int16]
Singles = NDArray[np.float32]

FULL_SCALE: Final = 32767.0

N_SUMS: Final = 2 * N_COEFFICIENTS  # rows of the first array of Room
CUBIC_ROW: Final = N_SUMS
N_ROWS64: Final = N_SUMS + 2

SAMPLES: Final = 0  # rows of the second
BLENDED_ROW: Final = 1
WITHIN: Final = 3
V_ROW: Final = 4
N_ROWS32: Final = 6

STRIP: Final = 8192
"""Most samples of a strip that has several blocks."""

Axis: TypeAlias = tuple[
    Floats, Ints, Bytes, Bytes, Ints, Bytes, Floats, NDArray[np.int64], Floats, Floats, float, int
]
"""An axis: tones, offsets, course, path, tooth and group (see :mod:`labseq.kernels.render_paths`),
cosine and sine of each tooth over a period, each segment's first sample (and the end of the last),
the time from its start to there and its length, both in samples, the spacing of the teeth in cycles
per sample, and the samples of a block."""

Room: TypeAlias = tuple[Floats, Singles, Singles, Floats, Floats, Singles, Floats, Ints, Samples]
"""Room for one thread to work in, see :func:`new_room`."""

AXIS: Final = (
    f"Tuple(({const('float64', 2)}, {const('int32', 1)}, {const('int8', 1)}, {const('int8', 1)},"
    f" {const('int32', 1)}, {const('int8', 1)}, {const('float64', 2)}, {const('int64', 1)},"
    f" {const('float64', 1)}, {const('float64', 1)}, float64, int64))"
)
ROOM: Final = (
    "Tuple((float64[:, ::1], float32[:, ::1], float32[:, :, ::1], float64[:, :, ::1], float64[:, ::1],"
    " float32[:, :, ::1], float64[::1], int32[:, ::1], int16[::1]))"
)


@kernel("int64(int64)")
def strip_samples(block: int) -> int:
    """Samples that are worked out together: some blocks, as many as stay in the fastest cache."""
    return max(1, STRIP // block) * block


def new_room(block: int) -> Room:
    """Make room for one thread to work in, for blocks of so many samples.

    Returns:
        float64 (N_ROWS64, width): sums over a period, coefficients of a cubic.
        float32 (N_ROWS32, width): the samples, a blended table, fractions of the segment, lanes.
        float32 (MAX_GROUPS, N_SUMS, width): tables of each group.
        float64 (MAX_GROUPS, 4, LANES + 1): lanes of each group.
        float64 (MAX_GROUPS, N_STATE): state of each group.
        float32 (N_CHIRPS, 2, width), float64 (2 N_CHIRPS + 1,): chirps, and which they are.
        int32 (3, width / LANES): nodes of a tone.
        int16 (width,): a block that is repeated.
    """
    width = (strip_samples(block) // LANES + 2) * LANES
    return (
        np.zeros((N_ROWS64, width)),
        np.zeros((N_ROWS32, width), np.float32),
        np.zeros((MAX_GROUPS, N_SUMS, width), np.float32),
        np.zeros((MAX_GROUPS, 4, LANES + 1)),
        np.zeros((MAX_GROUPS, N_STATE)),
        np.zeros((N_CHIRPS, 2, width), np.float32),
        np.append(np.full(2 * N_CHIRPS, np.nan), 0.0),
        np.zeros((3, width // LANES), np.int32),
        np.zeros(width, np.int16),
    )
