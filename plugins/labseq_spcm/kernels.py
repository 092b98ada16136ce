"""Kernels: the order of samples on the card, and the commands for its DDS.

The DDS knows frequencies and amplitudes that change linearly. Each segment of a tone program is
cut into steps in which that is close enough: a depth ramp where the amplitude has covered equal
parts of its change, a transport with another speed profile at equal times, as often as the tweezers'
distance from the course wants and the rate of commands allows. At the start of each step one block of
commands takes effect.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq_spcm.limits import DDS_AMPLITUDE_SLOPE, DDS_COMMANDS_PER_S, DDS_MIN_TICKS, DDS_TICK_S

Words = NDArray[np.uint16]
Reals = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Shorts = NDArray[np.int32]

RAMP_STEPS: Final = 8
"""Steps of a depth ramp: within 1 / (4 n^2), 0.4 % of the full depth, of a linear ramp."""
SHORT_STEPS: Final = 8
"""Duration of the first step of a ramp, at least, in shortest times of the DDS: one step in 2 us."""
BENDS: Final = (0.0, 10 / math.sqrt(3), 6.0)
"""Greatest second derivative of each course (:class:`FrequencyCourse`). With n straight steps
of equal duration a tone is within bend / (8 n^2) of its way from the course."""
SAME_HZ: Final = 1.0
"""A tone that starts within this of where another ended keeps that tone's core."""
SAME_TURNS: Final = 1e-3
"""The core keeps its phase too, unless the program's phase jumps by more than this."""

FREQUENCY: Final = 603000
FREQUENCY_SLOPE: Final = 604000
AMPLITUDE: Final = 605000
AMPLITUDE_SLOPE: Final = 606000
PHASE: Final = 607000
SOURCE: Final = 608000
TIMER: Final = 608001
COMMAND: Final = 608003
"""Registers of core 0, and of all cores together, as in the vendor's header files."""
FROM_TIMER: Final = 1
FROM_CARD: Final = 2
AT_TRIGGER: Final = 2

START_HZ, END_HZ, START, END, TURNS = 0, 1, 2, 3, 4
"""Rows of the tones: frequencies, amplitudes, phase in turns."""
HZ, HZ_PER_S, AMP, AMP_PER_S = 0, 1, 2, 3
"""Rows of the present state of the cores."""

TOO_SHORT: Final = -1
TOO_MANY: Final = -2

TONES: Final = const("float64", 2)
REALS: Final = const("float64", 1)
OFFSETS: Final = const("int32", 1)
CORES: Final = const("int64", 1)


@kernel(f"void({const('uint16', 1)}, {const('uint16', 1)}, uint32[::1])")
def interleave(first: Words, second: Words, out: NDArray[np.uint32]) -> None:
    """Interleave the samples of both outputs, as the card stores them.

    It writes whole frames of unsigned words, so that the processor can do many at a time: uint32 (n,) from
    the bits of the samples of each output, uint16 (n,), output 0 in the low word.
    """
    for i in range(len(out)):
        out[i] = np.uint32(first[i]) | (np.uint32(second[i]) << np.uint32(16))


@helper_kernel("float64(int64, float64)")
def course_at(course: int, u: float) -> float:
    """Part of its change that a frequency has covered; as :meth:`FrequencyCourse.fraction`."""
    if course == 0:
        return u
    if course == 1:
        return u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
    return u * u * (3.0 - 2.0 * u)


@helper_kernel(f"float64({TONES}, int64, float64)")
def amplitude_at(tones: Reals, tone: int, u: float) -> float:
    """Amplitude of a tone after a fraction u of its segment: its square changes linearly."""
    start, end = tones[START, tone], tones[END, tone]
    return np.sqrt(start * start + (end * end - start * start) * min(1.0, max(0.0, u)))


@helper_kernel(f"void({TONES}, int64, int64, float64[::1])")
def widest_ramp(tones: Reals, first: int, last: int, widest: Reals) -> None:
    """Put the start and end amplitude of the tone that changes most into ``widest``."""
    for tone in range(first, last):
        start, end = tones[START, tone], tones[END, tone]
        if abs(end - start) > abs(widest[1] - widest[0]):
            widest[0], widest[1] = start, end


@helper_kernel(f"UniTuple(float64, 2)({TONES}, int64, int64, float64)")
def longest_way(tones: Reals, first: int, last: int, hz: float) -> tuple[float, float]:
    """Longest way of some tones, in units of ``hz``, and the commands that they need for each step."""
    longest, n_commands = 0.0, 0.0
    for tone in range(first, last):
        way = abs(tones[END_HZ, tone] - tones[START_HZ, tone])
        longest = max(longest, way / hz)
        n_commands += 2.0 * (way > 0.0) + 2.0 * (tones[END, tone] != tones[START, tone])
    return longest, n_commands


@helper_kernel(f"int64({TONES}, int64[::1], int64, float64, {REALS}, float64[::1])")
def cut_course(
    tones: Reals, ends: Ints, course: int, duration_s: float, within_hz: Reals, knots: Reals
) -> int:
    """Cut a segment with a curved course into steps of equal duration; as :func:`cut`.

    ``ends`` are the first and last row tone of the segment, and the first and last column tone.
    """
    rows, row_commands = longest_way(tones, ends[0], ends[1], within_hz[0])
    columns, column_commands = longest_way(tones, ends[2], ends[3], within_hz[1])
    wanted = np.ceil(np.sqrt(BENDS[course] / 8.0 * max(rows, columns)))
    by_rate = duration_s * DDS_COMMANDS_PER_S / (row_commands + column_commands + 2.0)
    by_timer = duration_s / ((DDS_MIN_TICKS + 1) * DDS_TICK_S)
    n_steps = max(1, int(min(wanted, by_rate, by_timer, len(knots) - 1.0)))
    for k in range(n_steps + 1):
        knots[k] = k / n_steps
    return n_steps


@helper_kernel("int64(float64[::1], float64, float64[::1])")
def cut(widest: Reals, duration_s: float, knots: Reals) -> int:
    """Cut a segment into steps: their ends as fractions of its duration; returns how many steps."""
    start, end = widest[0], widest[1]
    room = duration_s / ((DDS_MIN_TICKS + 1) * DDS_TICK_S)
    if abs(end - start) > 0.05 * max(start, end):
        n_steps = max(1, min(RAMP_STEPS, int(np.sqrt(room / SHORT_STEPS))))  # the first is the shortest
        for k in range(n_steps + 1):
            a = start + (end - start) * k / n_steps
            knots[k] = (a * a - start * start) / (end * end - start * start)
        return n_steps
    knots[0], knots[1] = 0.0, 1.0
    return 1


@helper_kernel(
    f"boolean({OFFSETS}, {TONES}, int64, float64, int64, int64, int64[::1], bool_[::1], bool_[::1])"
)
def assign(
    offsets: Shorts, tones: Reals, segment: int, before_s: float, first_core: int, last_core: int,
    core_of: Ints, set_phase: Bools, used: Bools,
) -> bool:  # fmt: skip
    """Assign a core to each tone of an axis in a segment: the one that it had, or a free one.

    It fills in, for each of the segment's tones, the index of its core and whether its phase must be set.
    The axis' cores are those from ``first_core`` to ``last_core``; ``before_s`` is the duration of the
    segment before, and ``used`` scratch for each core. Returns whether there are enough cores.
    """
    first, last = offsets[segment], offsets[segment + 1]
    used[:] = False
    for tone in range(first, last):
        core_of[tone] = -1
        set_phase[tone] = True
        start = offsets[segment - 1] if segment > 0 else first
        for old in range(start, first):
            if abs(tones[END_HZ, old] - tones[START_HZ, tone]) < SAME_HZ and not used[core_of[old]]:
                core_of[tone] = core_of[old]
                used[core_of[old]] = True
                turns = tones[TURNS, old] + 0.5 * before_s * (tones[START_HZ, old] + tones[END_HZ, old])
                jump = tones[TURNS, tone] - turns
                never_set = before_s == 0.0 and set_phase[old]
                set_phase[tone] = never_set or abs(jump - np.rint(jump)) > SAME_TURNS
                break
    free = first_core
    for tone in range(first, last):
        if core_of[tone] < 0:
            while free < last_core and used[free]:
                free += 1
            if free == last_core:
                return False
            core_of[tone] = free
            used[free] = True
    return True


@helper_kernel("int64(int64, float64, int32[::1], float64[::1], int64)")
def add_command(register: int, value: float, registers: Shorts, values: Reals, n: int) -> int:
    """Add a command."""
    registers[n] = register
    values[n] = value
    return n + 1


@helper_kernel(
    f"int64({CORES}, int64, float64, float64, float64, float64, float64[:, ::1], int32[::1], float64[::1],"
    " int64)"
)
def drive_core(
    cores: Ints, at: int, hz: float, hz_per_s: float, amp: float, amp_per_s: float, now: Reals,
    registers: Shorts, values: Reals, n: int,
) -> int:  # fmt: skip
    """Add the commands that bring a core from its present state into a new one."""
    core = cores[at]
    if hz_per_s != 0.0 or now[HZ_PER_S, at] != 0.0 or hz != now[HZ, at]:
        n = add_command(FREQUENCY + core, hz, registers, values, n)
    if hz_per_s != now[HZ_PER_S, at]:
        n = add_command(FREQUENCY_SLOPE + core, hz_per_s, registers, values, n)
    if amp_per_s != 0.0 or now[AMP_PER_S, at] != 0.0 or amp != now[AMP, at]:
        n = add_command(AMPLITUDE + core, amp, registers, values, n)
    if amp_per_s != now[AMP_PER_S, at]:
        n = add_command(AMPLITUDE_SLOPE + core, amp_per_s, registers, values, n)
    now[HZ, at], now[HZ_PER_S, at], now[AMP, at], now[AMP_PER_S, at] = hz, hz_per_s, amp, amp_per_s
    return n


@helper_kernel(f"int64({CORES}, bool_[::1], float64[:, ::1], int32[::1], float64[::1], int64)")
def silence(cores: Ints, keep: Bools, now: Reals, registers: Shorts, values: Reals, n: int) -> int:
    """Add the commands that silence all cores but some."""
    for at in range(len(cores)):
        if not keep[at]:
            n = drive_core(cores, at, now[HZ, at], 0.0, 0.0, 0.0, now, registers, values, n)
    return n


@helper_kernel(
    f"int64({TONES}, int64, int64, {CORES}, int64[::1], bool_[::1], int64, boolean, float64, float64,"
    " float64, float64, float64[:, ::1], int32[::1], float64[::1], int64)"
)
def drive_tones(
    tones: Reals, first: int, last: int, cores: Ints, core_of: Ints, set_phase: Bools, course: int,
    begins: bool, u: float, until: float, step_s: float, late_s: float, now: Reals, registers: Shorts,
    values: Reals, n: int,
) -> int:  # fmt: skip
    """Add the commands of some tones for one step of a segment.

    On the card the step lasts ``step_s``, from the fraction ``u`` of the segment to ``until``. It starts
    ``late_s`` later than in the program, because the card rounds times to ticks. ``now`` is the present state
    of the cores, (4, n). Returns how many commands there are then.
    """
    s0, s1 = course_at(course, u), course_at(course, until)
    for tone in range(first, last):
        at = int(core_of[tone])
        way = tones[END_HZ, tone] - tones[START_HZ, tone]
        hz = tones[START_HZ, tone] + way * s0
        a0, a1 = amplitude_at(tones, tone, u), amplitude_at(tones, tone, until)
        hz_per_s, amp_per_s = way * (s1 - s0) / step_s, (a1 - a0) / step_s
        amp_per_s = min(max(amp_per_s, -DDS_AMPLITUDE_SLOPE), DDS_AMPLITUDE_SLOPE)  # the next step sets it
        n = drive_core(cores, at, hz, hz_per_s, a0, amp_per_s, now, registers, values, n)
        if begins and set_phase[tone]:
            turns = tones[TURNS, tone] + hz * late_s + 0.25  # the card's tones are sines
            n = add_command(PHASE + cores[at], 360.0 * (turns - np.floor(turns)), registers, values, n)
    return n


@kernel(
    f"int64({const('float64', 1)}, {const('int8', 1)}, {const('int32', 2)}, {TONES}, {CORES}, int64, {TONES},"
    f" {REALS}, int64, int32[::1], float64[::1], int64[::1])"
)
def compile_program(
    duration_s: Reals, course: NDArray[np.int8], offsets: Shorts, tones: Reals, cores: Ints,
    n_row_cores: int, idle: Reals, within_hz: Reals, most_steps: int, registers: Shorts, values: Reals,
    ends: Ints,
) -> int:  # fmt: skip
    """Compile a tone program into blocks of commands.

    The first block takes effect at the card's trigger, the others at ticks of the timer. The last
    but one brings all cores back into the idle state; the last switches the timer off.

    Args:
        duration_s: Of each segment.
        course: Of each segment.
        offsets: int32 (2, n_segments + 1), for the row and the column axis where each segment's tones start.
        tones: float64 (5, n): start and end frequency, start and end amplitude, phase in turns.
        cores: The cores of the row axis, then those of the column axis.
        n_row_cores: How many the row axis has.
        idle: float64 (4, n_cores): frequency, its slope, amplitude and its slope between programs; 0: silent.
        within_hz: float64 (2,), by how much a row tone and a column tone may differ from a curved course.
        most_steps: The most steps of a segment.
        registers: Result: register of each command.
        values: Result: its value.
        ends: Result: end of each block among the commands.

    Returns:
        Number of blocks; or TOO_SHORT or TOO_MANY, and ``ends[0]`` is the segment.
    """
    now, core_of = idle.copy(), np.zeros(tones.shape[1], np.int64)
    set_phase = np.ones(tones.shape[1], np.bool_)
    used, on = np.zeros(len(cores), np.bool_), np.zeros(len(cores), np.bool_)
    widest, knots, tone_ends = np.zeros(2), np.zeros(most_steps + 1), np.zeros(4, np.int64)
    n = add_command(SOURCE, FROM_TIMER, registers, values, 0)
    n_blocks, joint_s, before_s = 0, 0.0, 0.0
    for i in range(len(duration_s)):
        on[:] = False
        widest[:] = 0.0
        for axis in range(2):
            first_core, last_core = (0, n_row_cores) if axis == 0 else (n_row_cores, len(cores))
            if not assign(offsets[axis], tones, i, before_s, first_core, last_core, core_of, set_phase, used):
                ends[0] = i
                return TOO_MANY
            on |= used
            tone_ends[2 * axis : 2 * axis + 2] = offsets[axis, i : i + 2]
            widest_ramp(tones, offsets[axis, i], offsets[axis, i + 1], widest)
        before_s = duration_s[i]
        if before_s == 0.0:
            continue
        if course[i] == 0:
            n_steps = cut(widest, before_s, knots)
        else:
            n_steps = cut_course(tones, tone_ends, course[i], before_s, within_hz, knots)
        for k in range(n_steps):
            tick = np.rint((joint_s + knots[k] * before_s) / DDS_TICK_S)
            n_ticks = np.rint((joint_s + knots[k + 1] * before_s) / DDS_TICK_S) - tick
            if n_ticks < DDS_MIN_TICKS:
                ends[0] = i
                return TOO_SHORT
            step_s, late_s = n_ticks * DDS_TICK_S, tick * DDS_TICK_S - (joint_s + knots[k] * before_s)
            u = knots[k] + late_s / before_s
            until = u + step_s / before_s
            if k == 0:
                n = silence(cores, on, now, registers, values, n)
            for axis in range(2):
                n = drive_tones(
                    tones, offsets[axis, i], offsets[axis, i + 1], cores, core_of, set_phase, course[i],
                    k == 0, u, until, step_s, late_s, now, registers, values, n,
                )  # fmt: skip
            n = add_command(TIMER, step_s, registers, values, n)
            n = add_command(COMMAND, AT_TRIGGER, registers, values, n)
            ends[n_blocks] = n
            n_blocks += 1
        joint_s += before_s
    for at in range(len(cores)):
        hz = idle[HZ, at] if idle[AMP, at] > 0.0 else now[HZ, at]
        n = drive_core(cores, at, hz, 0.0, idle[AMP, at], 0.0, now, registers, values, n)
    n = add_command(TIMER, 2 * DDS_MIN_TICKS * DDS_TICK_S, registers, values, n)
    n = add_command(COMMAND, AT_TRIGGER, registers, values, n)
    ends[n_blocks] = n
    n = add_command(SOURCE, FROM_CARD, registers, values, n)
    n = add_command(COMMAND, AT_TRIGGER, registers, values, n)
    ends[n_blocks + 1] = n
    return n_blocks + 2
