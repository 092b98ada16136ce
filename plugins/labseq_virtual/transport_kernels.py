"""Kernels of the rules in ``transport.py``: hand-over, flight and collisions, for one program.

Arguments that occur in several kernels:

- ``constants``: the constants of the simulation, see :func:`labseq_virtual.handover.constants`.
- ``merging``: the logarithm of the ratio of mobile to static depth, and the distance in metres below which
  the two wells are one (2, n).
- ``row``, ``col``: the tones of a segment, with the columns of ``handover.py`` (n_tones, N_COLUMNS).
- ``state``, ``depth``, ``course``: the state of each crossing of these tones, its depth in kelvin, and its
  course since it switched on (N_COURSE numbers); at least as many rows and columns as tones.
- ``work``: scratch space, one integer for each crossing; ``paths``: N_PATH numbers for each.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq_virtual.handover import (
    ADIABATIC_DEPTH,
    AT_REST,
    DARK,
    DEPTH_DROP,
    EMPTY,
    END,
    HELD,
    INTERMODULATION,
    MIXING,
    MOBILE_DEPTH,
    NEW,
    ON_END,
    ON_START,
    PER_TONE,
    POWER_END,
    POWER_START,
    REFERENCE_SPEED_M_S,
    REFERENCE_TONES,
    SHALLOW_LOSS,
    SKEW,
    SLOW,
    SPACING,
    START,
    STATIC_DEPTH,
    STATIC_WAIST,
    SUDDEN_S,
    TEMPERATURE,
    TOLERANCE,
    TRANSPORT_LOSS,
)
from labseq_virtual.transport import COLLISION, EJECTED, HAND_OVER, PROGRAM, TRANSPORT

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
States = NDArray[np.int8]
Mask = NDArray[np.bool_]

TABLE = const("float64", 2)

RISK, PEAK, RISE_S, FALL_S = range(4)
"""Columns of a course: the probability that an atom fell out, the greatest depth in kelvin, and the durations
of the ramps at its start and at its end."""
N_COURSE = 4
RAMP = 0.7
"""Ratio of the powers at the two ends of a segment below which it is part of a ramp: tones that give depths
that differ from site to site change less."""
N_PATH = 5
"""Columns of a path: row and column at its start, the displacement along both, and its length squared."""


@kernel(f"boolean({TABLE})")
def moves(tones: Floats) -> bool:
    """Whether any tone moves."""
    furthest = 0.0
    for tone in range(len(tones)):
        furthest = max(furthest, abs(tones[tone, END] - tones[tone, START]))
    return furthest > AT_REST


@helper_kernel(f"boolean({TABLE})")
def crowded(tones: Floats) -> bool:
    """Whether any tone is too close to the next one in the list."""
    for k in range(1, len(tones)):
        for at in (START, END):
            if tones[k, at] - tones[k - 1, at] < MIXING:
                return True
    return False


@helper_kernel(f"boolean[::1]({TABLE})")
def find_mixed(tones: Floats) -> Mask:
    """Which tones come too close to another, or pass it (n_tones,)."""
    mixed = np.zeros(len(tones), np.bool_)
    for k in range(len(tones)):
        for m in range(k):
            before, after = tones[k, START] - tones[m, START], tones[k, END] - tones[m, END]
            near = abs(before) < MIXING or abs(after) < MIXING or before * after < 0.0
            one_on = tones[k, ON_START] + tones[k, ON_END] > 0.0
            if near and one_on and tones[m, ON_START] + tones[m, ON_END] > 0.0:
                mixed[k] = mixed[m] = True
    return mixed


@helper_kernel(f"int64({TABLE}, {TABLE}, int8[:, ::1])")
def mix(row: Floats, col: Floats, state: States) -> int:
    """Rule 3: atoms on tones that mix are lost; returns their number."""
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


@helper_kernel(f"int64({TABLE}, {TABLE}, int8[:, ::1], {TABLE}, float64, float64[:, ::1], int64[::1])")
def find_paths(
    row: Floats, col: Floats, state: States, depth: Floats, min_depth: float, paths: Floats, work: Ints
) -> int:
    """Find the moving crossings deep enough to knock atoms out; returns their number."""
    n = 0
    for i in range(len(row)):
        down = row[i, END] - row[i, START]
        for j in range(len(col)):
            right = col[j, END] - col[j, START]
            still = abs(down) <= AT_REST and abs(right) <= AT_REST
            if still or state[i, j] == DARK or depth[i, j] <= min_depth:
                continue
            paths[n, 0], paths[n, 1], paths[n, 2], paths[n, 3] = row[i, START], col[j, START], down, right
            paths[n, 4] = down * down + right * right
            work[n] = i * len(col) + j
            n += 1
    return n


@helper_kernel(f"UniTuple(int64, 2)({TABLE}, int64, int64, int64, float64)")
def span(paths: Floats, n: int, axis: int, n_sites: int, tolerance: float) -> tuple[int, int]:
    """Range of the rows (axis 0) or columns (axis 1) that n paths come close to: first, last + 1."""
    low, high = math.inf, -math.inf
    for k in range(n):
        start, end = paths[k, axis], paths[k, axis] + paths[k, 2 + axis]
        low, high = min(low, start, end), max(high, start, end)
    first, last = math.floor(low - tolerance), math.ceil(high + tolerance)
    return max(first, 0), min(last + 1, n_sites)


@helper_kernel(f"int64({TABLE}, int64, int64, int64, float64)")
def first_to_hit(paths: Floats, n: int, r: int, c: int, tolerance: float) -> int:
    """Which of n paths passes over a site first; -1 if none does."""
    first, soonest = -1, math.inf
    for k in range(n):
        to_r, to_c, down, right = r - paths[k, 0], c - paths[k, 1], paths[k, 2], paths[k, 3]
        when = min(max((to_r * down + to_c * right) / paths[k, 4], 0.0), 1.0)
        miss_r, miss_c = to_r - when * down, to_c - when * right
        if miss_r * miss_r + miss_c * miss_c <= tolerance * tolerance and when < soonest:
            first, soonest = k, when
    return first


@helper_kernel(
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
    paths: Floats,
    work: Ints,
) -> int:
    """Rule 4: moving crossings knock out atoms on sites; returns the number of atoms lost.

    The motion is a straight line from the start to the end of a segment. The first crossing to arrive
    loses its own atom too.
    """
    n_lost = 0
    n = find_paths(row, col, state, depth, min_depth, paths, work)
    top, bottom = span(paths, n, 0, occupied.shape[0], tolerance) if n > 0 else (0, 0)
    left, right = span(paths, n, 1, occupied.shape[1], tolerance) if n > 0 else (0, 0)
    for r in range(top, bottom):
        for c in range(left, right):
            first = first_to_hit(paths, n, r, c, tolerance) if occupied[r, c] else -1
            if first < 0:
                continue
            occupied[r, c] = False
            n_lost += 1
            i, j = work[first] // len(col), work[first] % len(col)
            if state[i, j] == HELD:
                state[i, j] = EMPTY
                n_lost += 1
    return n_lost


VECTOR = const("float64", 1)
SITES = "boolean[:, ::1]"
STATES = "int8[:, ::1]"
NUMBERS = "int64[::1]"
COURSES = "float64[:, :, ::1]"


@helper_kernel(f"float64(float64, {TABLE})")
def interpolate(x: float, table: Floats) -> float:
    """Linear interpolation in a table (2, n) of x, rising, and y; constant beyond its ends."""
    if x <= table[0, 0]:
        return float(table[1, 0])
    for k in range(1, table.shape[1]):
        if x < table[0, k]:
            slope = (table[1, k] - table[1, k - 1]) / (table[0, k] - table[0, k - 1])
            return float(table[1, k - 1] + slope * (x - table[0, k - 1]))
    return float(table[1, -1])


@helper_kernel("float64(float64)")
def exceeds(energy_over_kt: float) -> float:
    """Probability that the thermal energy in a harmonic well in three dimensions exceeds a value."""
    x = max(energy_over_kt, 0.0)
    return math.exp(-x) * (1.0 + x + x * x / 2.0)


@helper_kernel("float64(float64)")
def kinetic_exceeds(energy_over_kt: float) -> float:
    """Probability that the kinetic energy in three dimensions exceeds a value (Maxwell's constants)."""
    root = math.sqrt(max(energy_over_kt, 0.0))
    return math.erfc(root) + 2.0 / math.sqrt(math.pi) * root * math.exp(-root * root)


@helper_kernel(f"float64(float64, int64, {VECTOR})")
def mobile_depth(power: float, n_further: int, constants: Floats) -> float:
    """Depth of a mobile tweezer in kelvin; ``power``: power of its tones relative to the intended one."""
    return float(constants[MOBILE_DEPTH] * power / (1.0 + constants[DEPTH_DROP] * n_further))


@helper_kernel(f"boolean(float64, float64, float64, {TABLE})")
def takes(mobile: float, static: float, distance_m: float, merging: Floats) -> bool:
    """Whether a mobile tweezer that switches on takes the atom of a static one; depths in kelvin."""
    if mobile <= static:
        return False
    log_ratio = math.log(mobile / static) if static > 0.0 else math.inf
    return distance_m < interpolate(log_ratio, merging)


@helper_kernel(f"float64(float64, float64, int64, {VECTOR})")
def shallow(mobile: float, speed_m_s: float, n_further: int, constants: Floats) -> float:
    """Probability that an atom falls out of a mobile tweezer that is too shallow for its speed."""
    if constants[ADIABATIC_DEPTH] == 0.0:
        return 0.0
    missing = constants[ADIABATIC_DEPTH] * (speed_m_s / REFERENCE_SPEED_M_S) ** 2 - mobile
    scatter = constants[INTERMODULATION] * math.sqrt(n_further / REFERENCE_TONES) * mobile
    if scatter > 0.0:
        part = 0.5 * math.erfc(-missing / scatter / math.sqrt(2.0))
    elif missing == 0.0:
        part = 0.5
    else:
        part = 1.0 if missing > 0.0 else 0.0
    return float(constants[SHALLOW_LOSS] * part)


@helper_kernel(f"float64(float64, float64, float64, float64, {VECTOR})")
def spilled(static: float, ratio: float, distance_m: float, ramp_s: float, constants: Floats) -> float:
    """Probability that an atom dropped off near a site does not stay there.

    Args:
        static: Depth of the site, in kelvin.
        ratio: Depth of the mobile tweezer while it was on, relative to ``static``.
        distance_m: Distance of the atom from the site.
        ramp_s: Duration of the drop-off.
        constants: The constants.
    """
    waists = distance_m / constants[STATIC_WAIST]
    slow = max(interpolate(waists, SLOW), exceeds(static / constants[TEMPERATURE]))
    left = static * math.exp(-2.0 * waists * waists)
    sudden = kinetic_exceeds(left / (constants[TEMPERATURE] * math.sqrt(1.0 + ratio)))
    part = math.exp(-((ramp_s / SUDDEN_S) ** 2))
    return slow + part * (max(sudden, slow) - slow)


@helper_kernel(f"UniTuple(float64, 3)(float64, float64, float64, float64, int64, float64, float64, {VECTOR})")
def risks(
    static: float,
    mobile: float,
    distance_m: float,
    fallen: float,
    n_further: int,
    ramp_s: float,
    factor: float,
    constants: Floats,
) -> tuple[float, float, float]:
    """Probabilities that an atom dropped off near a site is lost.

    Args:
        static: Depth of the site, in kelvin.
        mobile: Depth of the mobile tweezer while it was on.
        distance_m: Distance of the atom from the site.
        fallen: Probability of :func:`shallow` during the motion.
        n_further: Tones that were on beyond one per axis.
        ramp_s: Duration of the drop-off, in seconds.
        factor: The shot's factor on the losses.
        constants: The constants.

    Returns:
        The probabilities of losing it to heating at the site, to pick-up and drop-off, and in motion.
    """
    ratio = math.inf if mobile > 0.0 else 0.0
    if static > 0.0:
        ratio = mobile / static
    hand_over = 0.0
    if constants[TRANSPORT_LOSS] * factor > 0.0:
        nominal = constants[MOBILE_DEPTH] / constants[STATIC_DEPTH]
        hand_over = min(1.0, factor * constants[TRANSPORT_LOSS] * ratio / nominal)
    per_tone = min(1.0, factor * constants[PER_TONE] * n_further)
    return (
        spilled(static, ratio, distance_m, ramp_s, constants),
        hand_over,
        1.0 - (1.0 - per_tone) * (1.0 - fallen),
    )


@helper_kernel(f"Tuple((int64, int64, float64, boolean))(float64, float64, {TABLE}, {VECTOR})")
def nearest_site(row: float, col: float, static: Floats, constants: Floats) -> tuple[int, int, float, bool]:
    """The site nearest to a position, its distance in metres, and whether the position is in the grid."""
    r, c = round(row), round(col)
    down, right = row - r, col - c
    away_m = math.sqrt(
        (down * down + right * right) * (constants[SPACING] * constants[SPACING])
        + down * right * constants[SKEW]
    )
    inside = 0 <= r < static.shape[0] and 0 <= c < static.shape[1]
    r, c = min(max(r, 0), static.shape[0] - 1), min(max(c, 0), static.shape[1] - 1)
    return r, c, away_m, inside


@helper_kernel(f"void({SITES}, {TABLE}, {TABLE}, {TABLE}, {STATES}, {TABLE}, {VECTOR}, {TABLE})")
def pick_up(
    occupied: Mask,
    static: Floats,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    constants: Floats,
    merging: Floats,
) -> None:
    """Rule 2: crossings that are ramped up take the atoms of the sites close to them, row by row."""
    for i in range(len(row)):
        for j in range(len(col)):
            if state[i, j] != NEW:
                continue
            rises = row[i, POWER_START] * col[j, POWER_START] < RAMP * row[i, POWER_END] * col[j, POWER_END]
            state[i, j] = NEW if rises else EMPTY  # it may become deep enough in the next segment
            r, c, away_m, inside = nearest_site(row[i, START], col[j, START], static, constants)
            if inside and occupied[r, c] and takes(depth[i, j], static[r, c], away_m, merging):
                state[i, j] = HELD
                occupied[r, c] = False


@helper_kernel("int64(boolean[:, ::1], int64[::1], int64)")
def land(occupied: Mask, sites: Ints, n: int) -> int:
    """Put n atoms on their sites, all at once; atoms that share a site are lost; returns their number."""
    n_lost = 0
    for k in range(n):
        site, n_here = int(sites[k]), 0
        if site < 0:
            continue
        for other in range(k, n):
            if sites[other] == site:
                sites[other] = -1
                n_here += 1
        r, c = site // occupied.shape[1], site % occupied.shape[1]
        n_here += int(occupied[r, c])
        occupied[r, c] = n_here == 1
        n_lost += n_here if n_here > 1 else 0
    return n_lost


@helper_kernel(
    f"int64({SITES}, {TABLE}, {TABLE}, {TABLE}, {STATES}, {COURSES}, int64, float64, {TABLE}, int64, "
    f"{VECTOR}, {NUMBERS}, {NUMBERS})"
)
def set_down(
    occupied: Mask,
    static: Floats,
    row: Floats,
    col: Floats,
    state: States,
    course: Floats,
    n_further: int,
    factor: float,
    draws: Floats,
    n_drawn: int,
    constants: Floats,
    work: Ints,
    lost: Ints,
) -> int:
    """Rule 5: crossings that switch off drop their atoms; returns the number of draws used so far."""
    n = 0
    for i in range(len(row)):
        for j in range(len(col)):
            if row[i, ON_END] * col[j, ON_END] > 0.0:
                continue
            held, state[i, j] = state[i, j] == HELD, DARK
            if not held:
                continue
            r, c, away_m, inside = nearest_site(row[i, END], col[j, END], static, constants)
            spilled, hand_over, transport = risks(
                static[r, c], course[i, j, PEAK], away_m, course[i, j, RISK], n_further,
                course[i, j, FALL_S], factor, constants,
            )  # fmt: skip
            draw = draws[n_drawn]
            n_drawn += 1
            if not inside:
                lost[EJECTED] += 1
            elif draw[0] < spilled or draw[1] < hand_over:
                lost[HAND_OVER] += 1
            elif draw[2] < transport:
                lost[TRANSPORT] += 1
            else:
                work[n] = r * static.shape[1] + c
                n += 1
    lost[COLLISION] += land(occupied, work, n)
    return n_drawn


Offsets = NDArray[np.int32]

OFFSETS = const("int32", 1)
OUTPUT = "float64[:, ::1]"

INSTANT_S = 1e-12
"""Duration assumed for a segment of duration 0, in seconds."""


@helper_kernel(f"int64({TABLE}, int64, int64)")
def count_on(tones: Floats, one: int, other: int) -> int:
    """Number of tones that are on in both of two columns (start and end, or the same column twice)."""
    n = 0
    for tone in range(len(tones)):
        n += tones[tone, one] * tones[tone, other] > 0.0
    return n


@helper_kernel(f"int64({TABLE})")
def count_lit(tones: Floats) -> int:
    """Number of tones that are on at the start or at the end."""
    n = 0
    for tone in range(len(tones)):
        n += tones[tone, ON_START] + tones[tone, ON_END] > 0.0
    return n


@helper_kernel(f"boolean({TABLE}, {TABLE})")
def any_lit(row: Floats, col: Floats) -> bool:
    """Whether any crossing is on at the start or at the end."""
    at_start = count_on(row, ON_START, ON_START) * count_on(col, ON_START, ON_START)
    return at_start + count_on(row, ON_END, ON_END) * count_on(col, ON_END, ON_END) > 0


@kernel(f"int64({TABLE}, {OFFSETS}, {TABLE}, {OFFSETS}, int64)")
def max_drop_offs(
    rows: Floats, row_offsets: Offsets, cols: Floats, col_offsets: Offsets, n_segments: int
) -> int:
    """Number of crossings that switch off within the first segments: an upper limit on the drop-offs."""
    n = 0
    for k in range(n_segments):
        row, col = rows[row_offsets[k] : row_offsets[k + 1]], cols[col_offsets[k] : col_offsets[k + 1]]
        n += count_on(row, ON_START, ON_START) * count_on(col, ON_START, ON_START)
        n -= count_on(row, ON_START, ON_END) * count_on(col, ON_START, ON_END)
    return n


@helper_kernel(f"int64({STATES}, {TABLE}, {TABLE})")
def count_held(state: States, row: Floats, col: Floats) -> int:
    """Number of crossings that hold an atom."""
    n = 0
    for i in range(len(row)):
        for j in range(len(col)):
            n += state[i, j] == HELD
    return n


@helper_kernel(f"boolean({TABLE}, {TABLE}, float64)")
def unchanged(before: Floats, now: Floats, tolerance: float) -> bool:
    """Whether the tones continue in the same order, as they nearly always do."""
    if len(before) != len(now):
        return False
    furthest = 0.0
    for tone in range(len(now)):
        furthest = max(furthest, abs(now[tone, START] - before[tone, END]))
    return furthest <= tolerance


@helper_kernel(f"{NUMBERS}({TABLE}, {TABLE}, float64)")
def match(before: Floats, now: Floats, tolerance: float) -> Ints:
    """For each tone the nearest one of the segment before (n_tones,); -1 where none is close enough.

    A tone that is the nearest one to several continues as the closest of these, or the first of them.
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


@helper_kernel(f"void({TABLE}, {TABLE}, {STATES}, {COURSES}, {TABLE}, {TABLE}, {STATES}, {COURSES}, float64)")
def follow(
    old_row: Floats,
    old_col: Floats,
    old_state: States,
    old_course: Floats,
    row: Floats,
    col: Floats,
    state: States,
    course: Floats,
    tolerance: float,
) -> None:
    """Rule 1: tweezers that stay on keep their atoms; other crossings are new or dark."""
    if unchanged(old_row, row, tolerance) and unchanged(old_col, col, tolerance):
        from_row, from_col = np.arange(len(row)), np.arange(len(col))
    else:
        from_row, from_col = match(old_row, row, tolerance), match(old_col, col, tolerance)
    for i in range(len(row)):
        for j in range(len(col)):
            on = row[i, ON_START] * col[j, ON_START] > 0.0
            m, n = from_row[i], from_col[j]
            if on and m >= 0 and n >= 0 and old_state[m, n] != DARK:
                state[i, j], course[i, j] = old_state[m, n], old_course[m, n]
            else:
                lit = on or row[i, ON_END] * col[j, ON_END] > 0.0
                state[i, j], course[i, j] = NEW if lit else DARK, 0.0


@helper_kernel(f"void({TABLE}, {TABLE}, {TABLE}, {COURSES}, int64, float64, float64, {VECTOR})")
def run_courses(
    row: Floats,
    col: Floats,
    depth: Floats,
    course: Floats,
    n_further: int,
    duration_s: float,
    fastest: float,
    constants: Floats,
) -> None:
    """Continue the courses of crossings; ``fastest``: peak speed relative to the mean one."""
    speed = fastest * constants[SPACING] / max(duration_s, INSTANT_S)
    for i in range(len(row)):
        for j in range(len(col)):
            start, end = row[i, POWER_START] * col[j, POWER_START], row[i, POWER_END] * col[j, POWER_END]
            course[i, j, PEAK] = max(course[i, j, PEAK], depth[i, j])
            if start < RAMP * end:
                course[i, j, RISE_S] += duration_s
            course[i, j, FALL_S] = course[i, j, FALL_S] + duration_s if end < RAMP * start else 0.0
            down, right = row[i, END] - row[i, START], col[j, END] - col[j, START]
            if down != 0.0 or right != 0.0:
                risk = shallow(depth[i, j], math.hypot(down, right) * speed, n_further, constants)
                course[i, j, RISK] = max(course[i, j, RISK], risk)


@helper_kernel(f"int64({OFFSETS}, int64)")
def max_tones(offsets: Offsets, n_segments: int) -> int:
    """Largest number of tones of an axis in one of the first segments."""
    most = 0
    for k in range(n_segments):
        most = max(most, offsets[k + 1] - offsets[k])
    return most


@helper_kernel(
    f"int64({SITES}, {TABLE}, {TABLE}, {TABLE}, {STATES}, {OUTPUT}, {COURSES}, float64, float64, float64, "
    f"{TABLE}, int64, {VECTOR}, {TABLE}, {OUTPUT}, {NUMBERS}, {NUMBERS})"
)
def play(
    occupied: Mask,
    static: Floats,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    course: Floats,
    duration_s: float,
    fastest: float,
    factor: float,
    draws: Floats,
    n_drawn: int,
    constants: Floats,
    merging: Floats,
    paths: Floats,
    work: Ints,
    lost: Ints,
) -> int:
    """Rules 2 to 5 for a segment; returns the number of draws used so far."""
    n_further = count_lit(row) + count_lit(col) - 2
    for i in range(len(row)):
        for j in range(len(col)):
            start, end = row[i, POWER_START] * col[j, POWER_START], row[i, POWER_END] * col[j, POWER_END]
            depth[i, j] = mobile_depth(max(start, end), n_further, constants)
    pick_up(occupied, static, row, col, state, depth, constants, merging)
    lost[COLLISION] += mix(row, col, state)
    if moves(row) or moves(col):
        lost[COLLISION] += sweep(
            occupied, row, col, state, depth, constants[STATIC_DEPTH], constants[TOLERANCE], paths, work
        )
    run_courses(row, col, depth, course, n_further, duration_s, fastest, constants)
    return set_down(
        occupied, static, row, col, state, course, n_further, factor, draws, n_drawn, constants, work, lost
    )


@kernel(
    f"{NUMBERS}({SITES}, {TABLE}, {TABLE}, {OFFSETS}, {TABLE}, {OFFSETS}, {VECTOR}, {VECTOR}, int64, "
    f"float64, {TABLE}, {VECTOR}, {TABLE})"
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
    constants: Floats,
    merging: Floats,
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
        fastest: Their greatest speed relative to their mean speed.
        n_segments: Number of segments played.
        factor: The shot's factor on the transport loss.
        draws: Uniform random numbers (at least :func:`max_drop_offs`, 3).
        constants: The constants.
        merging: The merging distances.

    Returns:
        Number of atoms lost by each cause (5,).
    """
    shape = max_tones(row_offsets, n_segments), max_tones(col_offsets, n_segments)
    old_state, state = np.zeros(shape, np.int8), np.zeros(shape, np.int8)
    old_course, course, depth = (
        np.zeros((shape[0], shape[1], N_COURSE)),
        np.zeros((shape[0], shape[1], N_COURSE)),
        np.zeros(shape),
    )
    paths = np.zeros((shape[0] * shape[1], N_PATH))
    work, lost, n_drawn = np.zeros(shape[0] * shape[1], np.int64), np.zeros(5, np.int64), 0
    old_row, old_col = rows[:0], cols[:0]
    for k in range(n_segments):
        row, col = rows[row_offsets[k] : row_offsets[k + 1]], cols[col_offsets[k] : col_offsets[k + 1]]
        lost[PROGRAM] += count_held(old_state, old_row, old_col)
        if any_lit(row, col):
            follow(old_row, old_col, old_state, old_course, row, col, state, course, constants[TOLERANCE])
            lost[PROGRAM] -= count_held(state, row, col)
            n_drawn = play(
                occupied, static, row, col, state, depth, course, duration_s[k], fastest[k], factor, draws,
                n_drawn, constants, merging, paths, work, lost,
            )  # fmt: skip
            old_row, old_col, old_state, state = row, col, state, old_state
            old_course, course = course, old_course
        else:
            old_row, old_col = row[:0], col[:0]
    lost[PROGRAM] += count_held(old_state, old_row, old_col)
    return lost
