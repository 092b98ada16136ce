"""From a tone program to the commands of the card's DDS.

The card knows frequencies and amplitudes that change linearly. Each segment is cut into
steps in which that is near enough: a ramp of the depth where the amplitude has made equal
parts of its way, a transport that is not linear at equal times. At the start of each step
one block of commands takes effect.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel
from labseq_spcm._kernels_dds_steps import (
    COURSE_STEPS,
    END_HZ,
    MIN_TICKS,
    START_HZ,
    TICK_S,
    TONES,
    TURNS,
    amplitude_at,
    course_at,
    cut,
    widest_ramp,
)

Reals = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Shorts = NDArray[np.int32]

MAX_CORES: Final = 20
SAME_HZ: Final = 1.0
"""A tone that goes on at its frequency, from one segment to the next, keeps its core."""
SAME_TURNS: Final = 1e-3
"""And its phase, unless the program makes it jump by more than this."""

FREQUENCY: Final = 603000
FREQUENCY_SLOPE: Final = 604000
AMPLITUDE: Final = 605000
AMPLITUDE_SLOPE: Final = 606000
PHASE: Final = 607000
SOURCE: Final = 608000
TIMER: Final = 608001
COMMAND: Final = 608003
FROM_TIMER: Final = 1
FROM_CARD: Final = 2
AT_TRIGGER: Final = 2

# Rows of what an axis' cores do.
HZ, HZ_PER_S, AMP, AMP_PER_S = 0, 1, 2, 3

TOO_SHORT: Final = -1
TOO_MANY: Final = -2

OFFSETS: Final = const("int32", 1)
CORES: Final = const("int64", 1)


@kernel(f"int64({OFFSETS}, {TONES}, int64, float64, {CORES}, int64[::1], bool_[::1], bool_[::1])")
def assign(
    offsets: Shorts, tones: Reals, segment: int, before_s: float, cores: Ints, core_of: Ints, fresh: Bools,
    used: Bools,
) -> int:  # fmt: skip
    """Give each tone of a segment a core: the one that it had, or a free one.

    Args:
        offsets: Where each segment's tones start.
        tones: The axis' tones.
        segment: The segment.
        before_s: Duration of the segment before it.
        cores: The axis' cores.
        core_of: For all tones, which of the cores they have (an index); filled in for the segment's.
        fresh: For all tones, whether their phase must be set; likewise.
        used: (2 MAX_CORES,): scratch.

    Returns:
        0, or TOO_MANY.
    """
    first, last = offsets[segment], offsets[segment + 1]
    used[:] = False
    for tone in range(first, last):
        core_of[tone] = -1
        fresh[tone] = True
        start = offsets[segment - 1] if segment > 0 else first
        for old in range(start, first):
            if abs(tones[END_HZ, old] - tones[START_HZ, tone]) < SAME_HZ and not used[core_of[old]]:
                core_of[tone] = core_of[old]
                used[core_of[old]] = True
                turns = tones[TURNS, old] + 0.5 * before_s * (tones[START_HZ, old] + tones[END_HZ, old])
                jump = tones[TURNS, tone] - turns
                unheard = before_s == 0.0 and fresh[old]
                fresh[tone] = unheard or abs(jump - np.rint(jump)) > SAME_TURNS
                break
    free = 0
    for tone in range(first, last):
        if core_of[tone] < 0:
            while free < len(cores) and used[free]:
                free += 1
            if free == len(cores):
                return TOO_MANY
            core_of[tone] = free
            used[free] = True
    return 0


@kernel("int64(int32, float64, int32[::1], float64[::1], int64)")
def put(register: int, value: float, registers: Shorts, values: Reals, n: int) -> int:
    """Add a command."""
    registers[n] = register
    values[n] = value
    return n + 1


@kernel(
    "int64(int64, float64, float64, float64, float64, float64[:, ::1], int64, int32[::1], float64[::1],"
    " int64)"
)
def drive_core(
    core: int, hz: float, hz_per_s: float, amp: float, amp_per_s: float, now: Reals, at: int,
    registers: Shorts, values: Reals, n: int,
) -> int:  # fmt: skip
    """Add the commands for what a core does from now on, where it is not what it does already."""
    if hz_per_s != 0.0 or now[HZ_PER_S, at] != 0.0 or hz != now[HZ, at]:
        n = put(FREQUENCY + core, hz, registers, values, n)
    if hz_per_s != now[HZ_PER_S, at]:
        n = put(FREQUENCY_SLOPE + core, hz_per_s, registers, values, n)
    if amp_per_s != 0.0 or now[AMP_PER_S, at] != 0.0 or amp != now[AMP, at]:
        n = put(AMPLITUDE + core, amp, registers, values, n)
    if amp_per_s != now[AMP_PER_S, at]:
        n = put(AMPLITUDE_SLOPE + core, amp_per_s, registers, values, n)
    now[HZ, at], now[HZ_PER_S, at], now[AMP, at], now[AMP_PER_S, at] = hz, hz_per_s, amp, amp_per_s
    return n


@kernel(
    f"int64({OFFSETS}, {TONES}, int64, {CORES}, int64[::1], bool_[::1], int64, boolean, float64, float64,"
    " float64, float64, float64[:, ::1], int32[::1], float64[::1], int64)"
)
def drive_axis(
    offsets: Shorts, tones: Reals, segment: int, cores: Ints, core_of: Ints, fresh: Bools, course: int,
    begins: bool, u: float, until: float, step_s: float, late_s: float, now: Reals, registers: Shorts,
    values: Reals, n: int,
) -> int:  # fmt: skip
    """Add the commands of one axis for one step of a segment, from fraction u of it until another.

    Args:
        offsets: Where each segment's tones start.
        tones: The axis' tones.
        segment: The segment.
        cores: The axis' cores.
        core_of: For all tones, which of the cores they have.
        fresh: For all tones, whether their phase must be set.
        course: The segment's course.
        begins: Whether it is the segment's first step.
        u: Where the step starts on the card.
        until: Where it ends on the card.
        step_s: How long it takes on the card.
        late_s: By how much it starts late there, because the card's times stand on a grid.
        now: What the axis' cores do, (4, MAX_CORES).
        registers: The commands' registers.
        values: Their values.
        n: How many commands there are.

    Returns:
        How many commands there are now.
    """
    first, last = offsets[segment], offsets[segment + 1]
    if begins:
        for at in range(len(cores)):
            on = False
            for tone in range(first, last):
                on = on or core_of[tone] == at
            if not on:
                n = drive_core(cores[at], now[HZ, at], 0.0, 0.0, 0.0, now, at, registers, values, n)
    s0, s1 = course_at(course, u), course_at(course, until)
    for tone in range(first, last):
        at = int(core_of[tone])
        way = tones[END_HZ, tone] - tones[START_HZ, tone]
        hz = tones[START_HZ, tone] + way * s0
        a0, a1 = amplitude_at(tones, tone, u), amplitude_at(tones, tone, until)
        hz_per_s, amp_per_s = way * (s1 - s0) / step_s, (a1 - a0) / step_s
        n = drive_core(cores[at], hz, hz_per_s, a0, amp_per_s, now, at, registers, values, n)
        if begins and fresh[tone]:
            turns = tones[TURNS, tone] + hz * late_s + 0.25  # the card's tones are sines
            n = put(PHASE + cores[at], 360.0 * (turns - np.floor(turns)), registers, values, n)
    return n


@kernel(
    f"int64({const('float64', 1)}, {const('int8', 1)}, {OFFSETS}, {TONES}, {CORES}, {OFFSETS}, {TONES},"
    f" {CORES}, int32[::1], float64[::1], int64[::1])"
)
def compile_program(
    duration_s: Reals, course: NDArray[np.int8], row_offsets: Shorts, row: Reals, row_cores: Ints,
    column_offsets: Shorts, column: Reals, column_cores: Ints, registers: Shorts, values: Reals, ends: Ints,
) -> int:  # fmt: skip
    """Compile a program into blocks of commands.

    The first block takes effect at the card's trigger, the others at ticks of the timer. The last
    but one silences all; the last takes the timer away.

    Args:
        duration_s: Of each segment.
        course: Of each segment.
        row_offsets: Where each segment's row tones start.
        row: float64 (5, n): start and end frequency, start and end amplitude, phase in turns.
        row_cores: The cores of the row axis.
        column_offsets: The same for the column axis.
        column: Likewise.
        column_cores: Likewise.
        registers: Result: register of each command.
        values: Result: its value.
        ends: Result: end of each block among the commands.

    Returns:
        How many blocks; or TOO_SHORT or TOO_MANY, and ``ends[0]`` is the segment.
    """
    row_now, column_now = np.zeros((4, MAX_CORES)), np.zeros((4, MAX_CORES))
    row_core, column_core = np.zeros(row.shape[1], np.int64), np.zeros(column.shape[1], np.int64)
    row_fresh, column_fresh = np.ones(row.shape[1], np.bool_), np.ones(column.shape[1], np.bool_)
    used, widest, knots = np.zeros(2 * MAX_CORES, np.bool_), np.zeros(2), np.zeros(COURSE_STEPS + 1)
    n = put(SOURCE, FROM_TIMER, registers, values, 0)
    n_blocks, joint_s, before_s = 0, 0.0, 0.0
    for i in range(len(duration_s)):
        fault = assign(row_offsets, row, i, before_s, row_cores, row_core, row_fresh, used)
        fault += assign(column_offsets, column, i, before_s, column_cores, column_core, column_fresh, used)
        before_s = duration_s[i]
        if fault < 0:
            ends[0] = i
            return TOO_MANY
        if before_s == 0.0:
            continue
        widest[:] = 0.0
        widest_ramp(row, row_offsets[i], row_offsets[i + 1], widest)
        widest_ramp(column, column_offsets[i], column_offsets[i + 1], widest)
        n_steps = cut(widest, course[i], before_s, knots)
        for k in range(n_steps):
            tick = np.rint((joint_s + knots[k] * before_s) / TICK_S)
            n_ticks = np.rint((joint_s + knots[k + 1] * before_s) / TICK_S) - tick
            if n_ticks < MIN_TICKS:
                ends[0] = i
                return TOO_SHORT
            step_s, late_s = n_ticks * TICK_S, tick * TICK_S - (joint_s + knots[k] * before_s)
            u = knots[k] + late_s / before_s
            until = u + step_s / before_s
            n = drive_axis(
                row_offsets, row, i, row_cores, row_core, row_fresh, course[i], k == 0, u, until, step_s,
                late_s, row_now, registers, values, n,
            )  # fmt: skip
            n = drive_axis(
                column_offsets, column, i, column_cores, column_core, column_fresh, course[i], k == 0, u,
                until, step_s, late_s, column_now, registers, values, n,
            )  # fmt: skip
            n = put(TIMER, step_s, registers, values, n)
            n = put(COMMAND, AT_TRIGGER, registers, values, n)
            ends[n_blocks] = n
            n_blocks += 1
        joint_s += before_s
    for at in range(len(row_cores)):
        n = drive_core(row_cores[at], row_now[HZ, at], 0.0, 0.0, 0.0, row_now, at, registers, values, n)
    for at in range(len(column_cores)):
        n = drive_core(
            column_cores[at], column_now[HZ, at], 0.0, 0.0, 0.0, column_now, at, registers, values, n
        )
    n = put(TIMER, 2 * MIN_TICKS * TICK_S, registers, values, n)
    n = put(COMMAND, AT_TRIGGER, registers, values, n)
    ends[n_blocks] = n
    n = put(SOURCE, FROM_CARD, registers, values, n)
    n = put(COMMAND, AT_TRIGGER, registers, values, n)
    ends[n_blocks + 1] = n
    return n_blocks + 2
