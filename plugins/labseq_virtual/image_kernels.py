"""Kernels that draw integers from tabulated distributions, and photoelectrons onto pixels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel

WORDS = const("uint32", 1)
STARTS = const("int32", 1)
COUNTS = const("int64", 1)
PLACES = const("float64", 2)

START_BITS = 12
"""Leading bits of a random word that select where the search in a table starts."""
_SHIFT = 32 - START_BITS


@helper_kernel()
def place(word: np.uint32, edges: NDArray[np.uint32], starts: NDArray[np.int32]) -> int:
    """Index of the first edge of a table that is not below a word."""
    j = int(starts[word >> _SHIFT])
    while edges[j] < word:
        j += 1
    return j


@kernel([f"void({WORDS}, {WORDS}, {STARTS}, int64, {dtype}[::1])" for dtype in ("uint16", "int32")])
def draw(
    words: NDArray[np.uint32],
    edges: NDArray[np.uint32],
    starts: NDArray[np.int32],
    first: int,
    drawn: NDArray[np.uint16] | NDArray[np.int32],
) -> None:
    """Draw one number for each random word, which is ``first`` plus the word's index in the table."""
    for i in range(len(words)):
        drawn[i] = first + place(words[i], edges, starts)


@kernel(f"void({WORDS}, {WORDS}, {STARTS}, int64, {COUNTS}, int64[::1])")
def draw_sums(
    words: NDArray[np.uint32],
    edges: NDArray[np.uint32],
    starts: NDArray[np.int32],
    first: int,
    n_each: NDArray[np.int64],
    sums: NDArray[np.int64],
) -> None:
    """Draw sums of ``n_each`` numbers, with one word for every number of every sum."""
    i = 0
    for group in range(len(n_each)):
        total = n_each[group] * first
        for _ in range(n_each[group]):
            total += place(words[i], edges, starts)
            i += 1
        sums[group] = total


@kernel(f"void({const('float32', 2)}, {PLACES}, {COUNTS}, int64, int64, int64, int32[:, ::1])")
def scatter(
    offset: NDArray[np.float32],
    centres: NDArray[np.float64],
    n_each: NDArray[np.int64],
    top: int,
    left: int,
    binning: int,
    light: NDArray[np.int32],
) -> None:
    """Count the photoelectrons on each pixel, and ignore those outside the frame.

    Args:
        offset: Distance of each from the centre of its spot, (y, x) in pixels of the sensor (n, 2).
        centres: Centre of each spot on the sensor, (y, x) (n_spots, 2).
        n_each: Photoelectrons of each spot (n_spots,), n in all.
        top: First row of the sensor that is read.
        left: First column.
        binning: Pixels of the sensor per pixel of the frame, along each axis.
        light: Photoelectrons on each pixel of the frame. Added to in place.
    """
    height, width = light.shape[0] * binning, light.shape[1] * binning
    i = 0
    for spot in range(len(n_each)):
        middle_y, middle_x = centres[spot, 0] - top + 0.5, centres[spot, 1] - left + 0.5
        for _ in range(n_each[spot]):
            y, x = middle_y + offset[i, 0], middle_x + offset[i, 1]
            i += 1
            if 0.0 <= y < height and 0.0 <= x < width:
                light[math.floor(y) // binning, math.floor(x) // binning] += 1
