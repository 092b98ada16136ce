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

from labseq.plugin import FrequencyCourse, const, helper_kernel, kernel
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
    NOISE_HZ,
    ON_END,
    ON_START,
    PAIR_SURVIVAL,
    PER_TONE,
    POWER_END,
    POWER_START,
    REFERENCE_TONES,
    SHALLOW_LOSS,
    SKEW,
    SPACING,
    START,
    STATIC_DEPTH,
    STATIC_WAIST,
    TOLERANCE,
    TRANSPORT_LOSS,
)
from labseq_virtual.response_kernels import at_once, carry, hand_over, land_on, pass_by, relaxed
from labseq_virtual.responses import BESIDE, REFERENCE_SPEED_M_S
from labseq_virtual.transport import COLLISION, EJECTED, FASTEST, HAND_OVER, PROGRAM, TRANSPORT

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
States = NDArray[np.int8]
Mask = NDArray[np.bool_]

TABLE, VECTOR = const("float64", 2), const("float64", 1)

(
    RISK,
    PEAK,
    RISE_S,
    FALL_S,
    SITE_DEPTH,
    AWAY,
    HEAT,
    LOST,
    IS_PICKED,
    DOWN,
    RIGHT,
    SPEED,
    STOP_SPEED,
    LEG_HEAT,
    REST_S,
) = range(15)
"""Columns of a course: the probability that the atom fell out because the tweezer was too shallow; the
greatest depth in kelvin; the durations of the ramps at start and end; depth and distance of the site that it
came from; its temperature, as it would be in a static tweezer of nominal depth; the probability that it was
lost so far; whether the pick-up is contained in both; the velocity, in sites per second; the speed of the
last motion, in m/s, and the same if it stopped at once, else 0; the temperature at its start; the time at
rest since the last ramp up or motion."""
N_COURSE = 15
LINEAR = int(FrequencyCourse.LINEAR)
NEW_LEG = 0.8
"""Change of the velocity, relative to the greater one, from which on a tweezer has started again; smaller
ones are the bends of a curve, each with less than a third of the energy of a start and a stop."""
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
    """Which of n paths passes over a site first; -1 if none does. One that ends there lands or goes on."""
    first, soonest = -1, math.inf
    for k in range(n):
        to_r, to_c, down, right = r - paths[k, 0], c - paths[k, 1], paths[k, 2], paths[k, 3]
        when = min(max((to_r * down + to_c * right) / paths[k, 4], 0.0), 1.0)
        miss_r, miss_c = to_r - when * down, to_c - when * right
        ends_there = (to_r - down) ** 2 + (to_c - right) ** 2 <= tolerance * tolerance
        if miss_r * miss_r + miss_c * miss_c <= tolerance * tolerance and when < soonest and not ends_there:
            first, soonest = k, when
    return first


@helper_kernel(
    f"int64(boolean[:, ::1], {TABLE}, {TABLE}, int8[:, ::1], {TABLE}, float64[:, :, ::1], "
    f"{VECTOR}, float64[:, ::1], int64[::1])"
)
def sweep(
    occupied: Mask,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    course: Floats,
    constants: Floats,
    paths: Floats,
    work: Ints,
) -> int:
    """Rule 4: moving crossings knock out atoms on sites; returns the number of atoms lost.

    The motion is a straight line from the start to the end of a segment. The first crossing to arrive
    may lose its own atom too.
    """
    min_depth, tolerance = constants[STATIC_DEPTH], constants[TOLERANCE]
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
            if state[i, j] == HELD and constants[PAIR_SURVIVAL] > 0.0:
                course[i, j, LOST] = 1.0 - (1.0 - course[i, j, LOST]) * constants[PAIR_SURVIVAL]
            elif state[i, j] == HELD:
                state[i, j] = EMPTY
                n_lost += 1
    return n_lost


OUTPUT = "float64[:, ::1]"
SITES = "boolean[:, ::1]"
STATES = "int8[:, ::1]"
NUMBERS = "int64[::1]"
COURSES = "float64[:, :, ::1]"
THERMAL = "float64[:, :, ::1]"


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


@helper_kernel("void(float64[::1], float64, float64)")
def affect(course: Floats, loss: float, warmer: float) -> None:
    """Add a loss, and a ratio of temperatures, to the course of a crossing."""
    course[LOST] = 1.0 - (1.0 - course[LOST]) * (1.0 - loss)
    course[HEAT] *= warmer


@helper_kernel(f"void(float64[::1], {VECTOR}, {VECTOR})")
def settle(course: Floats, constants: Floats, tables: Floats) -> None:
    """Add the pick-up to the course of a crossing that holds an atom, unless it is contained."""
    if course[IS_PICKED] > 0.0:
        return
    course[IS_PICKED] = 1.0
    loss, warmer = hand_over(
        0, course[SITE_DEPTH], course[PEAK], course[AWAY], course[RISE_S], course[HEAT], constants, tables
    )
    affect(course, loss, warmer)


@helper_kernel(
    "void(float64[::1], boolean, float64, float64, float64, float64, float64, float64, int64, int64, "
    f"{VECTOR}, {VECTOR})"
)
def advance(
    course: Floats,
    is_held: bool,
    start: float,
    end: float,
    depth: float,
    down: float,
    right: float,
    duration_s: float,
    kind: int,
    n_further: int,
    constants: Floats,
    tables: Floats,
) -> None:
    """Continue the course of a crossing over a segment.

    Args:
        course: The course; changed in place.
        is_held: Whether it holds an atom.
        start: Power of its tones at the start, relative to the intended one.
        end: The same at the end.
        depth: Its greatest depth in the segment, in kelvin.
        down: Its displacement along the columns, in sites.
        right: Its displacement along a row.
        duration_s: Duration of the segment.
        kind: Course of the frequencies.
        n_further: Tones that are on beyond one per axis.
        constants: The constants.
        tables: The tables.
    """
    duration_s = max(duration_s, INSTANT_S)
    course[PEAK] = max(course[PEAK], depth)
    rises, falls = start < RAMP * end, end < RAMP * start
    if rises:
        course[RISE_S] += duration_s
    course[FALL_S] = course[FALL_S] + duration_s if falls else 0.0
    ratio = depth / constants[STATIC_DEPTH]
    course[HEAT] *= math.exp(min(duration_s * constants[NOISE_HZ] * ratio, 20.0))
    down_hz, right_hz = down / duration_s, right / duration_s
    change = math.hypot(down_hz - course[DOWN], right_hz - course[RIGHT])
    starts = change > NEW_LEG * max(math.hypot(down_hz, right_hz), math.hypot(course[DOWN], course[RIGHT]))
    course[DOWN], course[RIGHT] = down_hz, right_hz
    length_m = math.hypot(down, right) * constants[SPACING]
    if length_m == 0.0:
        if not falls:
            course[REST_S] = 0.0 if rises else course[REST_S] + duration_s
        return
    course[SPEED] = length_m / duration_s
    course[STOP_SPEED] = course[SPEED] if kind == LINEAR else 0.0
    risk = shallow(depth, length_m / duration_s * FASTEST[kind], n_further, constants)
    course[RISK] = max(course[RISK], risk)
    if is_held and starts:
        is_first = course[IS_PICKED] == 0.0
        settle(course, constants, tables)
        heat = course[LEG_HEAT] = course[HEAT]
        loss, warmer = carry(kind, course[SPEED], length_m, depth, heat, constants, tables)
        affect(course, loss, warmer)
        if is_first and course[STOP_SPEED] > 0.0:
            ramp_s = course[RISE_S] + course[REST_S]
            loss, warmer = at_once(0, depth, course[SPEED], ramp_s, heat, constants, tables)
            affect(course, loss, warmer)
    course[REST_S] = 0.0


@helper_kernel(f"UniTuple(float64, 4)(float64, float64[::1], float64, int64, float64, {VECTOR}, {VECTOR})")
def risks(
    static: float,
    course: Floats,
    distance_m: float,
    n_further: int,
    factor: float,
    constants: Floats,
    tables: Floats,
) -> tuple[float, float, float, float]:
    """Probabilities that an atom dropped off near a site is lost.

    Args:
        static: Depth of the site, in kelvin.
        course: Course of the tweezer that holds it.
        distance_m: Distance of the atom from the site.
        n_further: Tones that were on beyond one per axis.
        factor: The shot's factor on the losses.
        constants: The constants.
        tables: The tables.

    Returns:
        The probabilities of losing it to heat, to pick-up and drop-off, and in motion; and its temperature.
    """
    settle(course, constants, tables)
    if course[STOP_SPEED] > 0.0:
        ramp_s = course[REST_S] + course[FALL_S]
        loss, warmer = at_once(
            1, course[PEAK], course[STOP_SPEED], ramp_s, course[LEG_HEAT], constants, tables
        )
        affect(course, loss, warmer)
    ratio = math.inf if course[PEAK] > 0.0 else 0.0
    if static > 0.0:
        ratio = course[PEAK] / static
    by_hand_over = 0.0
    if constants[TRANSPORT_LOSS] * factor > 0.0:
        nominal = constants[MOBILE_DEPTH] / constants[STATIC_DEPTH]
        by_hand_over = min(1.0, factor * constants[TRANSPORT_LOSS] * ratio / nominal)
    per_tone = min(1.0, factor * constants[PER_TONE] * n_further)
    loss, warmer = hand_over(
        1, static, course[PEAK], distance_m, course[FALL_S], course[HEAT], constants, tables
    )
    return (
        1.0 - (1.0 - course[LOST]) * (1.0 - loss),
        by_hand_over,
        1.0 - (1.0 - per_tone) * (1.0 - course[RISK]),
        course[HEAT] * warmer,
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


@helper_kernel(
    f"void({SITES}, {THERMAL}, float64, {TABLE}, {TABLE}, {TABLE}, {STATES}, {TABLE}, {COURSES}, {VECTOR}, "
    f"{TABLE}, {OUTPUT})"
)
def pick_up(
    occupied: Mask,
    thermal: Floats,
    now_s: float,
    static: Floats,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    course: Floats,
    constants: Floats,
    merging: Floats,
    hazards: Floats,
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
                course[i, j, SITE_DEPTH], course[i, j, AWAY] = static[r, c], away_m
                course[i, j, HEAT] = relaxed(thermal[0, r, c], now_s - thermal[1, r, c], constants)
                course[i, j, IS_PICKED] = 0.0
                course[i, j, LOST], hazards[r, c] = -math.expm1(-hazards[r, c]), 0.0


@helper_kernel(f"float64(float64, float64, float64, float64, {VECTOR})")
def dot(down: float, right: float, to_down: float, to_right: float, constants: Floats) -> float:
    """Scalar product of two displacements in sites, along columns and rows, in square metres."""
    straight = (down * to_down + right * to_right) * constants[SPACING] * constants[SPACING]
    return straight + 0.5 * constants[SKEW] * (down * to_right + right * to_down)


@helper_kernel(f"float64(float64, float64, float64, float64, float64, float64, {VECTOR})")
def nearest_pass(
    to_down: float,
    to_right: float,
    down: float,
    right: float,
    was_down: float,
    was_right: float,
    constants: Floats,
) -> float:
    """Distance in metres at which a tweezer passes an atom in a segment; inf if it is nearest in another one.

    Args:
        to_down: From the tweezer at the start to the atom, in sites along the columns.
        to_right: Along a row.
        down: Displacement of the tweezer in the segment.
        right: Along a row.
        was_down: Its velocity before.
        was_right: Along a row.
        constants: The constants.
    """
    length2 = dot(down, right, down, right, constants)
    ahead = dot(to_down, to_right, down, right, constants)
    if length2 > 0.0 and ahead >= length2:
        return math.inf  # it comes nearer still
    if length2 > 0.0 and ahead > 0.0:
        part = ahead / length2
        to_down, to_right = to_down - part * down, to_right - part * right
    else:
        rested = was_down == 0.0 and was_right == 0.0
        came_nearer = dot(to_down, to_right, was_down, was_right, constants) > 0.0
        if not (came_nearer or (rested and length2 > 0.0)):
            return math.inf
    return math.sqrt(dot(to_down, to_right, to_down, to_right, constants))


@helper_kernel(
    f"void({SITES}, {THERMAL}, float64, {TABLE}, {TABLE}, {TABLE}, {STATES}, {TABLE}, {COURSES}, float64, "
    f"{VECTOR}, {VECTOR}, {OUTPUT})"
)
def pass_atoms(
    occupied: Mask,
    thermal: Floats,
    now_s: float,
    static: Floats,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    course: Floats,
    duration_s: float,
    constants: Floats,
    tables: Floats,
    hazards: Floats,
) -> None:
    """Rule 5: tweezers that pass atoms on sites add to their hazards of being lost, and of their own atom."""
    cosine = 0.5 * constants[SKEW] / (constants[SPACING] * constants[SPACING])
    within_m = BESIDE[-1] * constants[STATIC_WAIST]
    reach = within_m / constants[SPACING] / math.sqrt(1.0 - cosine * cosine)
    for i in range(len(row)):
        for j in range(len(col)):
            down, right = row[i, END] - row[i, START], col[j, END] - col[j, START]
            if state[i, j] == DARK:
                continue
            top = max(math.ceil(row[i, START] + min(down, 0.0) - reach), 0)
            bottom = min(math.floor(row[i, START] + max(down, 0.0) + reach) + 1, occupied.shape[0])
            left = max(math.ceil(col[j, START] + min(right, 0.0) - reach), 0)
            last = min(math.floor(col[j, START] + max(right, 0.0) + reach) + 1, occupied.shape[1])
            for r in range(top, bottom):
                for c in range(left, last):
                    if not occupied[r, c]:
                        continue
                    away_m = nearest_pass(
                        r - row[i, START], c - col[j, START], down, right,
                        course[i, j, DOWN], course[i, j, RIGHT], constants,
                    )  # fmt: skip
                    if not constants[TOLERANCE] * constants[SPACING] < away_m < within_m:
                        continue
                    speed_m_s = math.sqrt(dot(down, right, down, right, constants)) / duration_s
                    heat = relaxed(thermal[0, r, c], now_s - thermal[1, r, c], constants)
                    loss, warmer = pass_by(
                        static[r, c], depth[i, j], speed_m_s, away_m, heat, constants, tables
                    )
                    thermal[0, r, c], thermal[1, r, c] = heat * warmer, now_s
                    hazards[r, c] -= math.log1p(-min(loss, 1.0 - 1e-9))
                    if state[i, j] == HELD:
                        course[i, j, LOST] = 1.0 - (1.0 - course[i, j, LOST]) * (1.0 - loss)


@helper_kernel("float64(int64, float64)")
def one_left(n: int, pair_survival: float) -> float:
    """Probability that n atoms in a tweezer end as one, not none: P(n) of ``handover.pair_survival``."""
    return (1.0 - (pair_survival - 1.0) ** n) / (2.0 - pair_survival)


@helper_kernel(f"int64(boolean[:, ::1], int64[::1], {VECTOR}, int64, float64)")
def land(occupied: Mask, sites: Ints, luck: Floats, n: int, pair_survival: float) -> int:
    """Put n atoms on their sites, all at once; returns how many of those that share a site are lost.

    Args:
        occupied: Sites that hold an atom; changed in place.
        sites: Site of each atom (at least n,); changed in place.
        luck: A uniform random number for each atom, likewise.
        n: Number of atoms.
        pair_survival: Probability that one of two atoms is left.
    """
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
        occupied[r, c] = luck[k] < one_left(n_here, pair_survival)
        n_lost += n_here - int(occupied[r, c])
    return n_lost


@helper_kernel(f"void(int64, int64, {THERMAL}, float64, {TABLE}, float64[::1], {VECTOR}, {VECTOR}, {OUTPUT})")
def land_empty(
    r: int,
    c: int,
    thermal: Floats,
    now_s: float,
    static: Floats,
    course: Floats,
    constants: Floats,
    tables: Floats,
    hazards: Floats,
) -> None:
    """An empty tweezer that came from elsewhere goes off on an atom, which may be lost, or is heated."""
    if course[SPEED] == 0.0:
        return
    heat = relaxed(thermal[0, r, c], now_s - thermal[1, r, c], constants)
    loss, warmer = land_on(static[r, c], course[PEAK], course[SPEED], course[FALL_S], heat, constants, tables)
    thermal[0, r, c], thermal[1, r, c] = heat * warmer, now_s
    hazards[r, c] -= math.log1p(-min(loss, 1.0 - 1e-9))


@helper_kernel(
    f"int64({SITES}, {THERMAL}, float64, {TABLE}, {TABLE}, {TABLE}, {STATES}, {COURSES}, int64, float64, "
    f"{TABLE}, int64, {VECTOR}, {VECTOR}, {NUMBERS}, {NUMBERS}, {OUTPUT})"
)
def set_down(
    occupied: Mask,
    thermal: Floats,
    now_s: float,
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
    tables: Floats,
    work: Ints,
    lost: Ints,
    hazards: Floats,
) -> int:
    """Rule 6: crossings that switch off drop their atoms; returns the number of draws used so far."""
    n, luck = 0, np.empty(len(work))
    for i in range(len(row)):
        for j in range(len(col)):
            if row[i, ON_END] * col[j, ON_END] > 0.0:
                continue
            before, state[i, j] = state[i, j], DARK
            if before == DARK:
                continue
            r, c, away_m, inside = nearest_site(row[i, END], col[j, END], static, constants)
            if before != HELD:
                if inside and occupied[r, c] and away_m <= constants[TOLERANCE] * constants[SPACING]:
                    land_empty(r, c, thermal, now_s, static, course[i, j], constants, tables, hazards)
                continue
            by_heat, by_hand_over, in_motion, heat = risks(
                static[r, c], course[i, j], away_m, n_further, factor, constants, tables
            )
            draw = draws[n_drawn]
            n_drawn += 1
            if not inside:
                lost[EJECTED] += 1
            elif draw[0] < by_heat or draw[1] < by_hand_over:
                lost[HAND_OVER] += 1
            elif draw[2] < in_motion:
                lost[TRANSPORT] += 1
            else:
                work[n] = r * static.shape[1] + c
                luck[n] = (draw[2] - in_motion) / (1.0 - in_motion)  # uniform, as the draw was not below it
                thermal[0, r, c], thermal[1, r, c] = heat, now_s
                hazards[r, c] = 0.0
                n += 1
    lost[COLLISION] += land(occupied, work, luck, n, constants[PAIR_SURVIVAL])
    return n_drawn


Offsets = NDArray[np.int32]

OFFSETS = const("int32", 1)
KINDS = const("int8", 1)

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


@helper_kernel(f"int64({OFFSETS}, int64)")
def max_tones(offsets: Offsets, n_segments: int) -> int:
    """Largest number of tones of an axis in one of the first segments."""
    most = 0
    for k in range(n_segments):
        most = max(most, offsets[k + 1] - offsets[k])
    return most


@helper_kernel(
    f"int64({SITES}, {THERMAL}, float64, {TABLE}, {TABLE}, {TABLE}, {STATES}, {OUTPUT}, {COURSES}, float64, "
    f"int64, float64, {TABLE}, int64, {VECTOR}, {TABLE}, {VECTOR}, {OUTPUT}, {NUMBERS}, {NUMBERS}, {OUTPUT})"
)
def play(
    occupied: Mask,
    thermal: Floats,
    now_s: float,
    static: Floats,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    course: Floats,
    duration_s: float,
    kind: int,
    factor: float,
    draws: Floats,
    n_drawn: int,
    constants: Floats,
    merging: Floats,
    tables: Floats,
    paths: Floats,
    work: Ints,
    lost: Ints,
    hazards: Floats,
) -> int:
    """Rules 2 to 6 for a segment; returns the number of draws used so far."""
    n_further = count_lit(row) + count_lit(col) - 2
    for i in range(len(row)):
        for j in range(len(col)):
            start, end = row[i, POWER_START] * col[j, POWER_START], row[i, POWER_END] * col[j, POWER_END]
            depth[i, j] = mobile_depth(max(start, end), n_further, constants)
    pick_up(occupied, thermal, now_s, static, row, col, state, depth, course, constants, merging, hazards)
    lost[COLLISION] += mix(row, col, state)
    if moves(row) or moves(col):
        lost[COLLISION] += sweep(occupied, row, col, state, depth, course, constants, paths, work)
    pass_atoms(
        occupied, thermal, now_s, static, row, col, state, depth, course, max(duration_s, INSTANT_S),
        constants, tables, hazards,
    )  # fmt: skip
    for i in range(len(row)):
        for j in range(len(col)):
            start, end = row[i, POWER_START] * col[j, POWER_START], row[i, POWER_END] * col[j, POWER_END]
            down, right = row[i, END] - row[i, START], col[j, END] - col[j, START]
            if state[i, j] != DARK:
                advance(
                    course[i, j], state[i, j] == HELD, start, end, depth[i, j], down, right, duration_s, kind,
                    n_further, constants, tables,
                )  # fmt: skip
    return set_down(
        occupied, thermal, now_s + duration_s, static, row, col, state, course, n_further, factor, draws,
        n_drawn, constants, tables, work, lost, hazards,
    )  # fmt: skip


@kernel(
    f"{NUMBERS}({SITES}, {THERMAL}, float64, {TABLE}, {TABLE}, {OFFSETS}, {TABLE}, {OFFSETS}, {VECTOR}, "
    f"{KINDS}, int64, float64, {TABLE}, {VECTOR}, {TABLE}, {VECTOR}, {OUTPUT})"
)
def carry_atoms(
    occupied: Mask,
    thermal: Floats,
    now_s: float,
    static: Floats,
    rows: Floats,
    row_offsets: Offsets,
    cols: Floats,
    col_offsets: Offsets,
    duration_s: Floats,
    kinds: NDArray[np.int8],
    n_segments: int,
    factor: float,
    draws: Floats,
    constants: Floats,
    merging: Floats,
    tables: Floats,
    hazards: Floats,
) -> Ints:
    """Carry atoms by the first segments of a program.

    Args:
        occupied: Sites that hold an atom (n_rows, n_cols); changed in place.
        thermal: Temperature of the atom on each site, as it would be at the nominal depth, and the time
            that it belongs to (2, n_rows, n_cols); changed in place.
        now_s: When the program starts.
        static: Depths of the static tweezers (n_rows, n_cols).
        rows: Row tones of all segments (n_row_tones, N_COLUMNS).
        row_offsets: The first of each segment (at least n_segments + 1,).
        cols: Column tones, likewise.
        col_offsets: Likewise.
        duration_s: Durations of the segments.
        kinds: Their courses of the frequency.
        n_segments: Number of segments played.
        factor: The shot's factor on the transport loss.
        draws: Uniform random numbers (at least :func:`max_drop_offs`, 3).
        constants: The constants.
        merging: The merging distances.
        tables: The tables of ``response_kernels.py``.
        hazards: Result, hazard of the atom on each site by tweezers that passed it (n_rows, n_cols), from 0.

    Returns:
        Number of atoms lost by each cause (5,), without those that the hazards will cost.
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
                occupied, thermal, now_s, static, row, col, state, depth, course, duration_s[k], kinds[k],
                factor, draws, n_drawn, constants, merging, tables, paths, work, lost, hazards,
            )  # fmt: skip
            old_row, old_col, old_state, state = row, col, state, old_state
            old_course, course = course, old_course
        else:
            old_row, old_col = row[:0], col[:0]
        now_s += duration_s[k]
    lost[PROGRAM] += count_held(old_state, old_row, old_col)
    return lost
