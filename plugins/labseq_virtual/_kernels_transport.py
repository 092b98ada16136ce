"""Kernels that carry atoms by tone programs, by the rules of ``transport.py``.

Some arrays stand for several numbers:

- ``law``, ``reach``: see ``_kernels_handover.py``.
- ``row``, ``col``: the tones of a segment, with the columns of ``axis_tones.py`` (n_tones, N_COLUMNS).
- ``state``, ``depth``, ``risk``: what each crossing of these tones is, its depth in kelvin, and the
  probability that an atom fell out of it on the way; at least as many rows and columns as there are tones.
- ``work``: room for a whole number for each crossing; ``ways`` likewise for N_WAY numbers.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel
from labseq_virtual._kernels_collisions import N_WAY, mix, moves, sweep
from labseq_virtual._kernels_handover import mobile_depth, pick_up, set_down, shallow
from labseq_virtual.axis_tones import (
    DARK,
    END,
    HELD,
    NEW,
    ON_END,
    ON_START,
    POWER_END,
    POWER_START,
    START,
)
from labseq_virtual.handover import SPACING, STATIC_DEPTH, TOLERANCE
from labseq_virtual.transport import COLLISION, PROGRAM

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Offsets = NDArray[np.int32]
States = NDArray[np.int8]
Mask = NDArray[np.bool_]

TABLE = const("float64", 2)
LIST = const("float64", 1)
OFFSETS = const("int32", 1)
SITES = "boolean[:, ::1]"
STATES = "int8[:, ::1]"
OWN = "float64[:, ::1]"
NUMBERS = "int64[::1]"

INSTANT_S = 1e-12
"""Duration that a segment without one is taken for."""


@kernel(f"int64({TABLE}, int64, int64)")
def count_on(tones: Floats, one: int, other: int) -> int:
    """How many tones are on in both of two columns (start and end; or twice the same)."""
    n = 0
    for tone in range(len(tones)):
        n += tones[tone, one] * tones[tone, other] > 0.0
    return n


@kernel(f"int64({TABLE})")
def count_lit(tones: Floats) -> int:
    """How many tones are on at the start or at the end."""
    n = 0
    for tone in range(len(tones)):
        n += tones[tone, ON_START] + tones[tone, ON_END] > 0.0
    return n


@kernel(f"boolean({TABLE}, {TABLE})")
def any_lit(row: Floats, col: Floats) -> bool:
    """Whether any crossing is on at the start or at the end."""
    at_start = count_on(row, ON_START, ON_START) * count_on(col, ON_START, ON_START)
    return at_start + count_on(row, ON_END, ON_END) * count_on(col, ON_END, ON_END) > 0


@kernel(f"int64({TABLE}, {OFFSETS}, {TABLE}, {OFFSETS}, int64)")
def most_let_go(
    rows: Floats, row_offsets: Offsets, cols: Floats, col_offsets: Offsets, n_segments: int
) -> int:
    """How many crossings go out within the first segments: no more atoms are let go."""
    n = 0
    for k in range(n_segments):
        row, col = rows[row_offsets[k] : row_offsets[k + 1]], cols[col_offsets[k] : col_offsets[k + 1]]
        n += count_on(row, ON_START, ON_START) * count_on(col, ON_START, ON_START)
        n -= count_on(row, ON_START, ON_END) * count_on(col, ON_START, ON_END)
    return n


@kernel(f"int64({STATES}, {TABLE}, {TABLE})")
def count_held(state: States, row: Floats, col: Floats) -> int:
    """How many crossings hold an atom."""
    n = 0
    for i in range(len(row)):
        for j in range(len(col)):
            n += state[i, j] == HELD
    return n


@kernel(f"boolean({TABLE}, {TABLE}, float64)")
def unchanged(before: Floats, now: Floats, tolerance: float) -> bool:
    """Whether the tones are the same in the same order: nearly always so."""
    if len(before) != len(now):
        return False
    furthest = 0.0
    for tone in range(len(now)):
        furthest = max(furthest, abs(now[tone, START] - before[tone, END]))
    return furthest <= tolerance


@kernel(f"{NUMBERS}({TABLE}, {TABLE}, float64)")
def match(before: Floats, now: Floats, tolerance: float) -> Ints:
    """For each tone the nearest of the segment before (n_tones,); -1 where none is near enough.

    One that is the nearest of several goes on as the nearest of these, or the first of them.
    """
    nearest, distance = np.full(len(now), -1), np.empty(len(now))
    for tone in range(len(now)):
        least = math.inf
        for other in range(len(before)):
            away = abs(now[tone, START] - before[other, END])
            if away < least:
                least = away
                nearest[tone] = other if away <= tolerance else -1
        distance[tone] = least
        for rival in range(tone):
            if nearest[rival] == nearest[tone]:
                nearest[tone if distance[rival] <= least else rival] = -1
    return nearest


@kernel(f"void({TABLE}, {TABLE}, {STATES}, {OWN}, {TABLE}, {TABLE}, {STATES}, {OWN}, float64)")
def follow(
    old_row: Floats,
    old_col: Floats,
    old_state: States,
    old_risk: Floats,
    row: Floats,
    col: Floats,
    state: States,
    risk: Floats,
    tolerance: float,
) -> None:
    """Rule 1: tweezers that were on before and still are keep their atoms; others are new or dark."""
    if unchanged(old_row, row, tolerance) and unchanged(old_col, col, tolerance):
        from_row, from_col = np.arange(len(row)), np.arange(len(col))
    else:
        from_row, from_col = match(old_row, row, tolerance), match(old_col, col, tolerance)
    for i in range(len(row)):
        for j in range(len(col)):
            on = row[i, ON_START] * col[j, ON_START] > 0.0
            m, n = from_row[i], from_col[j]
            if on and m >= 0 and n >= 0 and old_state[m, n] != DARK:
                state[i, j], risk[i, j] = old_state[m, n], old_risk[m, n]
            else:
                lit = on or row[i, ON_END] * col[j, ON_END] > 0.0
                state[i, j], risk[i, j] = NEW if lit else DARK, 0.0


@kernel(f"void({TABLE}, {TABLE}, {STATES}, {TABLE}, {OWN}, int64, float64, {LIST})")
def run_risks(
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    risk: Floats,
    n_further: int,
    speed: float,
    law: Floats,
) -> None:
    """The risk of tweezers too shallow for their speed; ``speed``: of one that moves by 1 m."""
    for i in range(len(row)):
        for j in range(len(col)):
            if state[i, j] != HELD:
                continue
            down, right = row[i, END] - row[i, START], col[j, END] - col[j, START]
            speed_m_s = math.hypot(down, right) * law[SPACING] * speed
            if speed_m_s > 0.0:
                risk[i, j] = max(risk[i, j], shallow(depth[i, j], speed_m_s, n_further, law))


@kernel(f"int64({OFFSETS}, int64)")
def max_tones(offsets: Offsets, n_segments: int) -> int:
    """The most tones of an axis in one of the first segments."""
    most = 0
    for k in range(n_segments):
        most = max(most, offsets[k + 1] - offsets[k])
    return most


@kernel(
    f"int64({SITES}, {TABLE}, {TABLE}, {TABLE}, {STATES}, {OWN}, {OWN}, float64, float64, float64, {TABLE}, "
    f"int64, {LIST}, {TABLE}, {OWN}, {NUMBERS}, {NUMBERS})"
)
def play(
    occupied: Mask,
    static: Floats,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    risk: Floats,
    duration_s: float,
    fastest: float,
    factor: float,
    draws: Floats,
    n_drawn: int,
    law: Floats,
    reach: Floats,
    ways: Floats,
    work: Ints,
    lost: Ints,
) -> int:
    """Rules 2 to 5 for a segment; returns how many draws are used up by now."""
    n_further = count_lit(row) + count_lit(col) - 2
    for i in range(len(row)):
        for j in range(len(col)):
            start, end = row[i, POWER_START] * col[j, POWER_START], row[i, POWER_END] * col[j, POWER_END]
            depth[i, j] = mobile_depth(max(start, end), n_further, law)
    pick_up(occupied, static, row, col, state, depth, law, reach)
    lost[COLLISION] += mix(row, col, state)
    if moves(row) or moves(col):
        lost[COLLISION] += sweep(
            occupied, row, col, state, depth, law[STATIC_DEPTH], law[TOLERANCE], ways, work
        )
        speed = fastest / max(duration_s, INSTANT_S)
        run_risks(row, col, state, depth, risk, n_further, speed, law)
    return set_down(
        occupied, static, row, col, state, depth, risk, n_further, duration_s, factor, draws, n_drawn, law,
        work, lost,
    )  # fmt: skip


@kernel(
    f"{NUMBERS}({SITES}, {TABLE}, {TABLE}, {OFFSETS}, {TABLE}, {OFFSETS}, {LIST}, {LIST}, int64, "
    f"float64, {TABLE}, {LIST}, {TABLE})"
)
def carry_atoms(
    occupied: Mask,
    static: Floats,
    rows: Floats,
    row_offsets: Offsets,
    cols: Floats,
    col_offsets: Offsets,
    duration_s: Floats,
    fastest: Floats,
    n_segments: int,
    factor: float,
    draws: Floats,
    law: Floats,
    reach: Floats,
) -> Ints:
    """Carry atoms by the first segments of a program.

    Args:
        occupied: Sites that hold an atom (n_rows, n_cols); changed in place.
        static: Depths of the static tweezers (n_rows, n_cols).
        rows: Row tones of all segments (n_row_tones, N_COLUMNS).
        row_offsets: The first of each segment (at least n_segments + 1,).
        cols: Column tones, likewise.
        col_offsets: Likewise.
        duration_s: Durations of the segments.
        fastest: Their greatest speeds over the mean.
        n_segments: How many segments are played.
        factor: The shot's factor on the transport loss.
        draws: Uniform random numbers (at least :func:`most_let_go`, 3).
        law: The constants.
        reach: The distances of merging.

    Returns:
        How many atoms were lost by each cause (5,).
    """
    shape = max_tones(row_offsets, n_segments), max_tones(col_offsets, n_segments)
    old_state, state = np.zeros(shape, np.int8), np.zeros(shape, np.int8)
    old_risk, risk, depth = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    ways = np.zeros((shape[0] * shape[1], N_WAY))
    work, lost, n_drawn = np.zeros(shape[0] * shape[1], np.int64), np.zeros(5, np.int64), 0
    old_row, old_col = rows[:0], cols[:0]
    for k in range(n_segments):
        row, col = rows[row_offsets[k] : row_offsets[k + 1]], cols[col_offsets[k] : col_offsets[k + 1]]
        lost[PROGRAM] += count_held(old_state, old_row, old_col)
        if any_lit(row, col):
            follow(old_row, old_col, old_state, old_risk, row, col, state, risk, law[TOLERANCE])
            lost[PROGRAM] -= count_held(state, row, col)
            n_drawn = play(
                occupied, static, row, col, state, depth, risk, duration_s[k], fastest[k], factor, draws,
                n_drawn, law, reach, ways, work, lost,
            )  # fmt: skip
            old_row, old_col, old_state, old_risk, state, risk = row, col, state, risk, old_state, old_risk
        else:
            old_row, old_col = row[:0], col[:0]
    lost[PROGRAM] += count_held(old_state, old_row, old_col)
    return lost
