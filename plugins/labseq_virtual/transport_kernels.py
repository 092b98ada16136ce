"""Kernels of the rules in ``transport.py``: all tweezers of a program, and the atoms on the sites.

Arguments that occur in several kernels:

- ``sites``: the sites and their atoms (n_rows, n_cols, N_SITE), with the columns of ``handover.py``.
- ``row``, ``col``: the tones of a segment, with the columns of ``handover.py`` (n_tones, N_COLUMNS).
- ``tweezers``: the crossings of these tones (at least n_row_tones, n_col_tones, N_TWEEZER), with the columns
  of ``tweezer_kernels.py``.
- ``constants``, ``tables``: as in ``tweezer_kernels.py``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq_virtual.handover import (
    AT_REST,
    ATOM,
    ATOM_HEAT,
    DARK,
    EMPTY,
    END,
    HAZARD,
    HEAT_AT_S,
    HELD,
    MIXING,
    NEW,
    ON_END,
    ON_START,
    PAIR_SURVIVAL,
    POWER_END,
    POWER_START,
    SKEW,
    SPACING,
    START,
    STATIC_DEPTH,
    STATIC_WAIST,
    TOLERANCE,
    TRAP_DEPTH,
)
from labseq_virtual.response_kernels import land_on, pass_by, relaxed
from labseq_virtual.responses import BESIDE
from labseq_virtual.transport import COLLISION, EJECTED, HAND_OVER, PROGRAM, TRANSPORT
from labseq_virtual.tweezer_kernels import (
    AWAY,
    DEPTH,
    DOWN,
    FALL_S,
    HEAT,
    INSTANT_S,
    IS_PICKED,
    LOST,
    N_TWEEZER,
    PEAK,
    RAMP,
    RIGHT,
    SITE_DEPTH,
    SPEED,
    STATE,
    advance,
    mobile_depth,
    risks,
    takes,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Offsets = NDArray[np.int32]

TABLE, VECTOR, OFFSETS = const("float64", 2), const("float64", 1), const("int32", 1)
SITES = TWEEZERS = "float64[:, :, ::1]"
NUMBERS = "int64[::1]"


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


@helper_kernel(f"int64({TWEEZERS}, {TABLE}, {TABLE})")
def count_held(tweezers: Floats, row: Floats, col: Floats) -> int:
    """Number of tweezers that hold an atom."""
    n = 0
    for i in range(len(row)):
        for j in range(len(col)):
            n += tweezers[i, j, STATE] == HELD
    return n


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


@helper_kernel(f"void({TABLE}, {TABLE}, {TWEEZERS}, {TABLE}, {TABLE}, {TWEEZERS}, float64)")
def follow(
    old_row: Floats,
    old_col: Floats,
    old: Floats,
    row: Floats,
    col: Floats,
    tweezers: Floats,
    tolerance: float,
) -> None:
    """Rule 1: tweezers that stay on keep their atoms; other crossings are new or dark."""
    from_row, from_col = match(old_row, row, tolerance), match(old_col, col, tolerance)
    for i in range(len(row)):
        for j in range(len(col)):
            on = row[i, ON_START] * col[j, ON_START] > 0.0
            m, n = from_row[i], from_col[j]
            if on and m >= 0 and n >= 0 and old[m, n, STATE] != DARK:
                tweezers[i, j] = old[m, n]
            else:
                lit = on or row[i, ON_END] * col[j, ON_END] > 0.0
                tweezers[i, j] = 0.0
                tweezers[i, j, STATE] = NEW if lit else DARK


@helper_kernel(f"Tuple((int64, int64, float64, boolean))(float64, float64, {SITES}, {VECTOR})")
def nearest_site(row: float, col: float, sites: Floats, constants: Floats) -> tuple[int, int, float, bool]:
    """The site nearest to a position, its distance in metres, and whether the position is in the grid."""
    r, c = round(row), round(col)
    down, right = row - r, col - c
    away_m = math.sqrt(
        (down * down + right * right) * (constants[SPACING] * constants[SPACING])
        + down * right * constants[SKEW]
    )
    inside = 0 <= r < sites.shape[0] and 0 <= c < sites.shape[1]
    r, c = min(max(r, 0), sites.shape[0] - 1), min(max(c, 0), sites.shape[1] - 1)
    return r, c, away_m, inside


@helper_kernel(f"float64(float64[::1], float64, {VECTOR})")
def heat_of(site: Floats, now_s: float, constants: Floats) -> float:
    """Temperature of the atom on a site now."""
    return relaxed(site[ATOM_HEAT], now_s - site[HEAT_AT_S], constants)


@helper_kernel("void(float64[::1], float64, float64, float64)")
def disturb(site: Floats, loss: float, heat: float, now_s: float) -> None:
    """Set the temperature of the atom on a site, and add to its hazard of being lost."""
    site[ATOM_HEAT], site[HEAT_AT_S] = heat, now_s
    site[HAZARD] -= math.log1p(-min(loss, 1.0 - 1e-9))


@helper_kernel(f"void({SITES}, float64, {TABLE}, {TABLE}, {TWEEZERS}, {VECTOR}, {TABLE})")
def pick_up(
    sites: Floats,
    now_s: float,
    row: Floats,
    col: Floats,
    tweezers: Floats,
    constants: Floats,
    merging: Floats,
) -> None:
    """Rule 2: tweezers that are ramped up take the atoms of the sites close to them, row by row."""
    for i in range(len(row)):
        for j in range(len(col)):
            tweezer = tweezers[i, j]
            if tweezer[STATE] != NEW:
                continue
            rises = row[i, POWER_START] * col[j, POWER_START] < RAMP * row[i, POWER_END] * col[j, POWER_END]
            tweezer[STATE] = NEW if rises else EMPTY  # it may become deep enough in the next segment
            r, c, away_m, inside = nearest_site(row[i, START], col[j, START], sites, constants)
            site = sites[r, c]
            if not (inside and site[ATOM] and takes(tweezer[DEPTH], site[TRAP_DEPTH], away_m, merging)):
                continue
            tweezer[STATE], site[ATOM] = HELD, 0.0
            tweezer[SITE_DEPTH], tweezer[AWAY] = site[TRAP_DEPTH], away_m
            tweezer[HEAT] = heat_of(site, now_s, constants)
            tweezer[IS_PICKED] = 0.0
            tweezer[LOST], site[HAZARD] = -math.expm1(-site[HAZARD]), 0.0


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


@helper_kernel(f"int64({TABLE}, {TABLE}, {TWEEZERS})")
def mix(row: Floats, col: Floats, tweezers: Floats) -> int:
    """Rule 3: atoms on tones that mix are lost; returns their number."""
    n_lost = 0
    by_row, by_col = find_mixed(row), find_mixed(col)
    for i in range(len(row)):
        for j in range(len(col)):
            if tweezers[i, j, STATE] == HELD and (by_row[i] or by_col[j]):
                tweezers[i, j, STATE] = EMPTY
                n_lost += 1
    return n_lost


@helper_kernel(f"Tuple((float64[:, ::1], int64[:, ::1]))({TABLE}, {TABLE}, {TWEEZERS}, float64)")
def find_paths(row: Floats, col: Floats, tweezers: Floats, min_depth: float) -> tuple[Floats, Ints]:
    """Find the moving tweezers deep enough to knock atoms out.

    Returns:
        For each its row and column at the start, and its displacement along both (n, 4); and the numbers of
        its tones (n, 2).
    """
    paths, crossing = np.empty((len(row) * len(col), 4)), np.empty((len(row) * len(col), 2), np.int64)
    n = 0
    for i in range(len(row)):
        down = row[i, END] - row[i, START]
        for j in range(len(col)):
            right = col[j, END] - col[j, START]
            still = abs(down) <= AT_REST and abs(right) <= AT_REST
            if still or tweezers[i, j, STATE] == DARK or tweezers[i, j, DEPTH] <= min_depth:
                continue
            paths[n, 0], paths[n, 1], paths[n, 2], paths[n, 3] = row[i, START], col[j, START], down, right
            crossing[n, 0], crossing[n, 1] = i, j
            n += 1
    return paths[:n], crossing[:n]


@helper_kernel(f"UniTuple(int64, 2)({TABLE}, int64, int64, float64)")
def span(paths: Floats, axis: int, n_sites: int, tolerance: float) -> tuple[int, int]:
    """Range of the rows (axis 0) or columns (axis 1) that paths come close to: first, last + 1."""
    if len(paths) == 0:
        return 0, 0
    low, high = math.inf, -math.inf
    for k in range(len(paths)):
        start, end = paths[k, axis], paths[k, axis] + paths[k, 2 + axis]
        low, high = min(low, start, end), max(high, start, end)
    first, last = math.floor(low - tolerance), math.ceil(high + tolerance)
    return max(first, 0), min(last + 1, n_sites)


@helper_kernel(f"int64({TABLE}, int64, int64, float64)")
def first_to_hit(paths: Floats, r: int, c: int, tolerance: float) -> int:
    """Which path passes over a site first; -1 if none does. One that ends there lands or goes on."""
    first, soonest = -1, math.inf
    for k in range(len(paths)):
        to_r, to_c, down, right = r - paths[k, 0], c - paths[k, 1], paths[k, 2], paths[k, 3]
        when = min(max((to_r * down + to_c * right) / (down * down + right * right), 0.0), 1.0)
        miss_r, miss_c = to_r - when * down, to_c - when * right
        ends_there = (to_r - down) ** 2 + (to_c - right) ** 2 <= tolerance * tolerance
        if miss_r * miss_r + miss_c * miss_c <= tolerance * tolerance and when < soonest and not ends_there:
            first, soonest = k, when
    return first


@helper_kernel(f"int64({SITES}, {TABLE}, {TABLE}, {TWEEZERS}, {VECTOR})")
def sweep(sites: Floats, row: Floats, col: Floats, tweezers: Floats, constants: Floats) -> int:
    """Rule 4: moving tweezers knock out atoms on sites; returns the number of atoms lost.

    The motion is a straight line from the start to the end of a segment. The first tweezer to arrive
    may lose its own atom too.
    """
    tolerance, n_lost = constants[TOLERANCE], 0
    paths, crossing = find_paths(row, col, tweezers, constants[STATIC_DEPTH])
    top, bottom = span(paths, 0, sites.shape[0], tolerance)
    left, right = span(paths, 1, sites.shape[1], tolerance)
    for r in range(top, bottom):
        for c in range(left, right):
            first = first_to_hit(paths, r, c, tolerance) if sites[r, c, ATOM] else -1
            if first < 0:
                continue
            sites[r, c, ATOM] = 0.0
            n_lost += 1
            tweezer = tweezers[crossing[first, 0], crossing[first, 1]]
            if tweezer[STATE] == HELD and constants[PAIR_SURVIVAL] > 0.0:
                tweezer[LOST] = 1.0 - (1.0 - tweezer[LOST]) * constants[PAIR_SURVIVAL]
            elif tweezer[STATE] == HELD:
                tweezer[STATE] = EMPTY
                n_lost += 1
    return n_lost


@helper_kernel(f"float64(float64, float64, float64, float64, {VECTOR})")
def dot(down: float, right: float, to_down: float, to_right: float, constants: Floats) -> float:
    """Scalar product of two displacements in sites, along columns and rows, in square metres."""
    straight = (down * to_down + right * to_right) * constants[SPACING] * constants[SPACING]
    return straight + 0.5 * constants[SKEW] * (down * to_right + right * to_down)


@helper_kernel(f"float64(float64, float64, float64, float64, float64[::1], {VECTOR})")
def nearest_pass(
    to_down: float, to_right: float, down: float, right: float, tweezer: Floats, constants: Floats
) -> float:
    """Distance in metres at which a tweezer passes an atom in a segment; inf if it is nearest in another one.

    Args:
        to_down: From the tweezer at the start to the atom, in sites along the columns.
        to_right: Along a row.
        down: Displacement of the tweezer in the segment.
        right: Along a row.
        tweezer: The tweezer, with its velocity before.
        constants: The constants.
    """
    was_down, was_right = tweezer[DOWN], tweezer[RIGHT]
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


@helper_kernel("UniTuple(int64, 2)(float64, float64, float64, int64)")
def lines_beside(start: float, way: float, reach: float, n_lines: int) -> tuple[int, int]:
    """Range of the rows or columns within reach of a way: first, last + 1."""
    first = max(math.ceil(start + min(way, 0.0) - reach), 0)
    return first, min(math.floor(start + max(way, 0.0) + reach) + 1, n_lines)


@helper_kernel(f"void({SITES}, float64, {TABLE}, {TABLE}, {TWEEZERS}, float64, {VECTOR}, {VECTOR})")
def pass_atoms(
    sites: Floats, now_s: float, row: Floats, col: Floats, tweezers: Floats, duration_s: float,
    constants: Floats, tables: Floats,
) -> None:  # fmt: skip
    """Rule 5: tweezers that pass atoms on sites add to their hazards of being lost, and of their own atom."""
    cosine = 0.5 * constants[SKEW] / (constants[SPACING] * constants[SPACING])
    within_m = BESIDE[-1] * constants[STATIC_WAIST]
    reach = within_m / constants[SPACING] / math.sqrt(1.0 - cosine * cosine)
    for i in range(len(row)):
        for j in range(len(col)):
            tweezer = tweezers[i, j]
            if tweezer[STATE] == DARK:
                continue
            down, right = row[i, END] - row[i, START], col[j, END] - col[j, START]
            speed_m_s = math.sqrt(dot(down, right, down, right, constants)) / max(duration_s, INSTANT_S)
            top, bottom = lines_beside(row[i, START], down, reach, sites.shape[0])
            left, last = lines_beside(col[j, START], right, reach, sites.shape[1])
            for r in range(top, bottom):
                for c in range(left, last):
                    site = sites[r, c]
                    if not site[ATOM]:
                        continue
                    to_down, to_right = r - row[i, START], c - col[j, START]
                    away_m = nearest_pass(to_down, to_right, down, right, tweezer, constants)
                    if not constants[TOLERANCE] * constants[SPACING] < away_m < within_m:
                        continue
                    heat, mobile = heat_of(site, now_s, constants), tweezer[DEPTH]
                    loss, warmer = pass_by(
                        site[TRAP_DEPTH], mobile, speed_m_s, away_m, heat, constants, tables
                    )
                    disturb(site, loss, heat * warmer, now_s)
                    if tweezer[STATE] == HELD:
                        tweezer[LOST] = 1.0 - (1.0 - tweezer[LOST]) * (1.0 - loss)


@helper_kernel(f"void({TABLE}, {TABLE}, {TWEEZERS}, float64, int64, int64, {VECTOR}, {VECTOR})")
def advance_all(
    row: Floats, col: Floats, tweezers: Floats, duration_s: float, kind: int, n_further: int,
    constants: Floats, tables: Floats,
) -> None:  # fmt: skip
    """Continue the courses of all tweezers that are on over a segment."""
    for i in range(len(row)):
        for j in range(len(col)):
            if tweezers[i, j, STATE] == DARK:
                continue
            start, end = row[i, POWER_START] * col[j, POWER_START], row[i, POWER_END] * col[j, POWER_END]
            down, right = row[i, END] - row[i, START], col[j, END] - col[j, START]
            advance(tweezers[i, j], start, end, down, right, duration_s, kind, n_further, constants, tables)


@helper_kernel("float64(int64, float64)")
def one_left(n: int, pair_survival: float) -> float:
    """Probability that n atoms in a tweezer end as one, not none: P(n) of ``handover.pair_survival``."""
    return (1.0 - (pair_survival - 1.0) ** n) / (2.0 - pair_survival)


@helper_kernel(f"int64({SITES}, int64[::1], {VECTOR}, int64, float64)")
def land(sites: Floats, goals: Ints, luck: Floats, n: int, pair_survival: float) -> int:
    """Put n atoms on their sites, all at once; returns how many of those that share a site are lost.

    Args:
        sites: The sites; changed in place.
        goals: Site of each atom (at least n,); changed in place.
        luck: A uniform random number for each atom, likewise.
        n: Number of atoms.
        pair_survival: Probability that one of two atoms is left.
    """
    n_lost = 0
    for k in range(n):
        goal, n_here = int(goals[k]), 0
        if goal < 0:
            continue
        for other in range(k, n):
            if goals[other] == goal:
                goals[other] = -1
                n_here += 1
        site = sites[goal // sites.shape[1], goal % sites.shape[1]]
        n_here += int(site[ATOM])
        site[ATOM] = luck[k] < one_left(n_here, pair_survival)
        n_lost += n_here - int(site[ATOM])
    return n_lost


@helper_kernel(f"void(float64[::1], float64, float64[::1], {VECTOR}, {VECTOR})")
def land_empty(site: Floats, now_s: float, tweezer: Floats, constants: Floats, tables: Floats) -> None:
    """An empty tweezer that came from elsewhere goes off on an atom, which may be lost, or is heated."""
    speed_m_s, fall_s = tweezer[SPEED], tweezer[FALL_S]
    if speed_m_s == 0.0:
        return
    heat = heat_of(site, now_s, constants)
    loss, warmer = land_on(site[TRAP_DEPTH], tweezer[PEAK], speed_m_s, fall_s, heat, constants, tables)
    disturb(site, loss, heat * warmer, now_s)


@helper_kernel(
    f"int64({SITES}, float64, {TABLE}, {TABLE}, {TWEEZERS}, int64, float64, {TABLE}, {VECTOR}, {VECTOR}, "
    f"{NUMBERS})"
)
def set_down(
    sites: Floats, now_s: float, row: Floats, col: Floats, tweezers: Floats, n_further: int, factor: float,
    draws: Floats, constants: Floats, tables: Floats, lost: Ints,
) -> int:  # fmt: skip
    """Rule 6: tweezers that switch off drop their atoms; returns the number of draws used."""
    n_crossings, n, n_drawn = len(row) * len(col), 0, 0
    goals, luck = np.empty(n_crossings, np.int64), np.empty(n_crossings)
    for i in range(len(row)):
        for j in range(len(col)):
            if row[i, ON_END] * col[j, ON_END] > 0.0:
                continue
            tweezer = tweezers[i, j]
            before, tweezer[STATE] = tweezer[STATE], DARK
            if before == DARK:
                continue
            r, c, away_m, inside = nearest_site(row[i, END], col[j, END], sites, constants)
            site = sites[r, c]
            if before != HELD:
                if inside and site[ATOM] and away_m <= constants[TOLERANCE] * constants[SPACING]:
                    land_empty(site, now_s, tweezer, constants, tables)
                continue
            by_heat, by_hand_over, in_motion, heat = risks(
                site[TRAP_DEPTH], tweezer, away_m, n_further, factor, constants, tables
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
                goals[n] = r * sites.shape[1] + c
                luck[n] = (draw[2] - in_motion) / (1.0 - in_motion)  # uniform, as the draw was not below it
                site[ATOM_HEAT], site[HEAT_AT_S], site[HAZARD] = heat, now_s, 0.0
                n += 1
    lost[COLLISION] += land(sites, goals, luck, n, constants[PAIR_SURVIVAL])
    return n_drawn


@helper_kernel(f"int64({OFFSETS}, int64)")
def max_tones(offsets: Offsets, n_segments: int) -> int:
    """Largest number of tones of an axis in one of the first segments."""
    most = 0
    for k in range(n_segments):
        most = max(most, offsets[k + 1] - offsets[k])
    return most


@helper_kernel(
    f"int64({SITES}, float64, {TABLE}, {TABLE}, {TWEEZERS}, float64, int64, float64, {TABLE}, {VECTOR}, "
    f"{TABLE}, {VECTOR}, {NUMBERS})"
)
def play(
    sites: Floats, now_s: float, row: Floats, col: Floats, tweezers: Floats, duration_s: float, kind: int,
    factor: float, draws: Floats, constants: Floats, merging: Floats, tables: Floats, lost: Ints,
) -> int:  # fmt: skip
    """Rules 2 to 6 for a segment; returns the number of draws used."""
    n_further = count_lit(row) + count_lit(col) - 2
    for i in range(len(row)):
        for j in range(len(col)):
            start, end = row[i, POWER_START] * col[j, POWER_START], row[i, POWER_END] * col[j, POWER_END]
            tweezers[i, j, DEPTH] = mobile_depth(max(start, end), n_further, constants)
    pick_up(sites, now_s, row, col, tweezers, constants, merging)
    lost[COLLISION] += mix(row, col, tweezers)
    lost[COLLISION] += sweep(sites, row, col, tweezers, constants)
    pass_atoms(sites, now_s, row, col, tweezers, duration_s, constants, tables)
    advance_all(row, col, tweezers, duration_s, kind, n_further, constants, tables)
    end_s = now_s + duration_s
    return set_down(sites, end_s, row, col, tweezers, n_further, factor, draws, constants, tables, lost)


@kernel(
    f"{NUMBERS}({SITES}, float64, {TABLE}, {OFFSETS}, {TABLE}, {OFFSETS}, {VECTOR}, {const('int8', 1)}, "
    f"int64, float64, {TABLE}, {VECTOR}, {TABLE}, {VECTOR})"
)
def carry_atoms(
    sites: Floats, now_s: float, rows: Floats, row_offsets: Offsets, cols: Floats, col_offsets: Offsets,
    duration_s: Floats, kinds: NDArray[np.int8], n_segments: int, factor: float, draws: Floats,
    constants: Floats, merging: Floats, tables: Floats,
) -> Ints:  # fmt: skip
    """Carry atoms by the first segments of a program.

    Args:
        sites: The sites and their atoms; changed in place.
        now_s: When the program starts.
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
        merging: The merging distances, see :func:`labseq_virtual.tweezer_kernels.takes`.
        tables: The tables.

    Returns:
        Number of atoms lost by each cause (5,), without those that the hazards will cost.
    """
    shape = max_tones(row_offsets, n_segments), max_tones(col_offsets, n_segments), N_TWEEZER
    old, tweezers = np.zeros(shape), np.zeros(shape)
    lost, n_drawn = np.zeros(5, np.int64), 0
    old_row, old_col = rows[:0], cols[:0]
    for k in range(n_segments):
        row, col = rows[row_offsets[k] : row_offsets[k + 1]], cols[col_offsets[k] : col_offsets[k + 1]]
        lost[PROGRAM] += count_held(old, old_row, old_col)
        if any_lit(row, col):
            follow(old_row, old_col, old, row, col, tweezers, constants[TOLERANCE])
            lost[PROGRAM] -= count_held(tweezers, row, col)
            n_drawn += play(
                sites, now_s, row, col, tweezers, duration_s[k], kinds[k], factor, draws[n_drawn:],
                constants, merging, tables, lost,
            )  # fmt: skip
            old_row, old_col, old, tweezers = row, col, tweezers, old
        else:
            old_row, old_col = row[:0], col[:0]
        now_s += duration_s[k]
    lost[PROGRAM] += count_held(old, old_row, old_col)
    return lost
