"""Kernels of what collides in a segment: tones with tones, and mobile tweezers with standing atoms.

``row``, ``col``, ``state``, ``depth``, ``work``, ``ways``: see ``_kernels_transport.py``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel
from labseq_virtual.axis_tones import AT_REST, DARK, EMPTY, END, HELD, MIXING, ON_END, ON_START, START

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
States = NDArray[np.int8]
Mask = NDArray[np.bool_]

TABLE = const("float64", 2)

N_WAY = 5
"""Columns of a way: row and column at its start, the steps along both, and the square of its length."""


@kernel(f"boolean({TABLE})")
def moves(tones: Floats) -> bool:
    """Whether any tone moves."""
    furthest = 0.0
    for tone in range(len(tones)):
        furthest = max(furthest, abs(tones[tone, END] - tones[tone, START]))
    return furthest > AT_REST


@kernel(f"boolean({TABLE})")
def crowded(tones: Floats) -> bool:
    """Whether a tone is too near to the next in the list; if not, none mix."""
    for k in range(1, len(tones)):
        for at in (START, END):
            if tones[k, at] - tones[k - 1, at] < MIXING:
                return True
    return False


@kernel(f"boolean[::1]({TABLE})")
def find_mixed(tones: Floats) -> Mask:
    """Which tones come too near to another, or pass it (n_tones,)."""
    mixed = np.zeros(len(tones), np.bool_)
    for k in range(len(tones)):
        for m in range(k):
            before, after = tones[k, START] - tones[m, START], tones[k, END] - tones[m, END]
            near = abs(before) < MIXING or abs(after) < MIXING or before * after < 0.0
            one_on = tones[k, ON_START] + tones[k, ON_END] > 0.0
            if near and one_on and tones[m, ON_START] + tones[m, ON_END] > 0.0:
                mixed[k] = mixed[m] = True
    return mixed


@kernel(f"int64({TABLE}, {TABLE}, int8[:, ::1])")
def mix(row: Floats, col: Floats, state: States) -> int:
    """Rule 3: the atoms on tones that mix are lost; returns how many."""
    if not (crowded(row) or crowded(col)):
        return 0
    n_lost = 0
    by_row, by_col = find_mixed(row), find_mixed(col)
    for i in range(len(row)):
        for j in range(len(col)):
            if state[i, j] == HELD and (by_row[i] or by_col[j]):
                state[i, j] = EMPTY
                n_lost += 1
    return n_lost


@kernel(f"int64({TABLE}, {TABLE}, int8[:, ::1], {TABLE}, float64, float64[:, ::1], int64[::1])")
def find_ways(
    row: Floats, col: Floats, state: States, depth: Floats, min_depth: float, ways: Floats, work: Ints
) -> int:
    """Find the crossings that move and are deep enough to throw atoms out; returns how many."""
    n = 0
    for i in range(len(row)):
        down = row[i, END] - row[i, START]
        for j in range(len(col)):
            right = col[j, END] - col[j, START]
            still = abs(down) <= AT_REST and abs(right) <= AT_REST
            if still or state[i, j] == DARK or depth[i, j] <= min_depth:
                continue
            ways[n, 0], ways[n, 1], ways[n, 2], ways[n, 3] = row[i, START], col[j, START], down, right
            ways[n, 4] = down * down + right * right
            work[n] = i * len(col) + j
            n += 1
    return n


@kernel(f"UniTuple(int64, 2)({TABLE}, int64, int64, int64, float64)")
def span(ways: Floats, n: int, axis: int, n_sites: int, tolerance: float) -> tuple[int, int]:
    """The first of the rows (axis 0) or columns (1) that n ways come near to, and the one after the last."""
    low, high = math.inf, -math.inf
    for k in range(n):
        start, end = ways[k, axis], ways[k, axis] + ways[k, 2 + axis]
        low, high = min(low, start, end), max(high, start, end)
    first, last = math.floor(low - tolerance), math.ceil(high + tolerance)
    return max(first, 0), min(last + 1, n_sites)


@kernel(f"int64({TABLE}, int64, int64, int64, float64)")
def first_to_hit(ways: Floats, n: int, r: int, c: int, tolerance: float) -> int:
    """Which of n ways comes first over an atom at a site; -1: none."""
    first, soonest = -1, math.inf
    for k in range(n):
        to_r, to_c, down, right = r - ways[k, 0], c - ways[k, 1], ways[k, 2], ways[k, 3]
        when = min(max((to_r * down + to_c * right) / ways[k, 4], 0.0), 1.0)
        miss_r, miss_c = to_r - when * down, to_c - when * right
        if miss_r * miss_r + miss_c * miss_c <= tolerance * tolerance and when < soonest:
            first, soonest = k, when
    return first


@kernel(
    f"int64(boolean[:, ::1], {TABLE}, {TABLE}, int8[:, ::1], {TABLE}, float64, float64, float64[:, ::1], "
    "int64[::1])"
)
def sweep(
    occupied: Mask,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    min_depth: float,
    tolerance: float,
    ways: Floats,
    work: Ints,
) -> int:
    """Rule 4: moving crossings throw out standing atoms; returns how many atoms are lost.

    Judged on straight lines between the two ends of a segment. The first crossing to arrive loses its
    own atom too.
    """
    n_lost = 0
    n = find_ways(row, col, state, depth, min_depth, ways, work)
    top, bottom = span(ways, n, 0, occupied.shape[0], tolerance) if n > 0 else (0, 0)
    left, right = span(ways, n, 1, occupied.shape[1], tolerance) if n > 0 else (0, 0)
    for r in range(top, bottom):
        for c in range(left, right):
            first = first_to_hit(ways, n, r, c, tolerance) if occupied[r, c] else -1
            if first < 0:
                continue
            occupied[r, c] = False
            n_lost += 1
            i, j = work[first] // len(col), work[first] % len(col)
            if state[i, j] == HELD:
                state[i, j] = EMPTY
                n_lost += 1
    return n_lost
