"""Kernels of the rules in ``transport.py``: all tweezers of a program, and the atoms on the sites.

Arguments that occur in several kernels; the records are those of ``records.py`` and ``tweezer_kernels.py``:

- ``sites``: the sites and their atoms, ``Site`` (n_rows, n_cols).
- ``row``, ``col``: the tones of a segment, ``Tone`` (n_tones,).
- ``tweezers``: the crossings of these tones, ``Tweezer`` (n_row_tones, n_col_tones).
- ``lost``: the ``Losses`` so far; changed in place.
- ``constants``: the machine, ``Constants``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq_virtual.records import SITE, TONE, Site, signature
from labseq_virtual.response_kernels import land_on, pass_by, relaxed
from labseq_virtual.responses import BESIDE
from labseq_virtual.tweezer_kernels import (
    DARK,
    EMPTY,
    HELD,
    INSTANT_S,
    LOSSES,
    N_NUMBERS,
    NEW,
    RAMP,
    TWEEZER,
    Constants,
    Losses,
    Tweezer,
    advance,
    affect,
    mobile_depth,
    risks,
    survives,
    takes,
    way_of,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Offsets = NDArray[np.int32]
Records = Any
"""An array of records: numpy has no type for one that knows its columns."""

TABLE, VECTOR, OFFSETS = const("float64", 2), const("float64", 1), const("int32", 1)
TONES = const(signature(TONE), 1)

TOLERANCE = 0.25
"""Distance, in sites, within which a tweezer that passes hits an atom, and along each axis is the same
tweezer in the next segment (ours: the waist is 0.22 sites)."""
MIXING = 0.45
"""Distance of two tones, in sites, below which their tweezers merge (ours)."""
AT_REST = 1e-6
"""Motion in a segment, in sites, below which a tweezer counts as at rest (rounding)."""


class Lit(NamedTuple):
    """How many tones of an axis are on in a segment: at its start, at its end, at both, at any of them."""

    start: int
    end: int
    both: int
    any: int


@helper_kernel()
def count_lit(tones: Records) -> Lit:
    """How many tones are on."""
    start, end, both = 0, 0, 0
    for tone in tones:
        start += tone.on_start
        end += tone.on_end
        both += tone.on_start and tone.on_end
    return Lit(start, end, both, start + end - both)


@kernel(f"int64({TONES}, {OFFSETS}, {TONES}, {OFFSETS}, int64)")
def max_drop_offs(
    rows: Records, row_offsets: Offsets, cols: Records, col_offsets: Offsets, n_segments: int
) -> int:
    """Number of crossings that switch off within the first segments: an upper limit on the drop-offs."""
    n = 0
    for k in range(n_segments):
        row = count_lit(rows[row_offsets[k] : row_offsets[k + 1]])
        col = count_lit(cols[col_offsets[k] : col_offsets[k + 1]])
        n += row.start * col.start - row.both * col.both
    return n


class Segment(NamedTuple):
    """A segment of a program.

    Attributes:
        start_s: When it starts.
        duration_s: Its duration.
        course: Course of its frequencies.
        n_further: Tones that are on beyond one per axis.
        factor: The shot's factor on the losses.
    """

    start_s: float
    duration_s: float
    course: int
    n_further: int
    factor: float


@helper_kernel()
def count_held(tweezers: Records) -> int:
    """Number of tweezers that hold an atom."""
    n = 0
    for tweezer in tweezers.ravel():
        n += tweezer.state == HELD
    return n


@helper_kernel()
def match(before: Records, now: Records) -> Ints:
    """For each tone the nearest one of the segment before (n_tones,); -1 where none is close enough.

    A tone that is the nearest one to several continues as the closest of these, or the first of them.
    """
    nearest, distance = np.full(len(now), -1), np.empty(len(now))
    for tone in range(len(now)):
        least = math.inf
        for other in range(len(before)):
            away = abs(now[tone].start - before[other].end)
            if away < least:
                least = away
                nearest[tone] = other if away <= TOLERANCE else -1
        distance[tone] = least
        for rival in range(tone):
            if nearest[rival] == nearest[tone]:
                nearest[tone if distance[rival] <= least else rival] = -1
    return nearest


@helper_kernel()
def follow(old_row: Records, old_col: Records, old: Records, row: Records, col: Records) -> Records:
    """Rule 1: tweezers that stay on keep their atoms; other crossings are new or dark."""
    from_row, from_col = match(old_row, row), match(old_col, col)
    tweezers = np.zeros((len(row), len(col)), TWEEZER)
    for i in range(len(row)):
        for j in range(len(col)):
            tweezer, m, n = tweezers[i, j], from_row[i], from_col[j]
            on_start = row[i].on_start and col[j].on_start
            on_end = row[i].on_end and col[j].on_end
            if on_start and m >= 0 and n >= 0 and old[m, n].state != DARK:
                tweezers[i, j] = old[m, n]
            elif on_start or on_end:
                tweezer.state = NEW
            tweezer.row, tweezer.col = row[i].start, col[j].start
            tweezer.to_row, tweezer.to_col = row[i].end, col[j].end
            tweezer.power_start = row[i].power_start * col[j].power_start
            tweezer.power_end = row[i].power_end * col[j].power_end
            tweezer.stays_on = on_end
    return tweezers


@helper_kernel()
def nearest_site(
    row: float, col: float, sites: Records, constants: Constants
) -> tuple[int, int, float, bool]:
    """The site nearest to a position, its distance in metres, and whether the position is in the grid."""
    r, c = round(row), round(col)
    down, right = row - r, col - c
    spacing2 = constants.spacing * constants.spacing
    away_m = math.sqrt((down * down + right * right) * spacing2 + down * right * constants.skew)
    inside = 0 <= r < sites.shape[0] and 0 <= c < sites.shape[1]
    r, c = min(max(r, 0), sites.shape[0] - 1), min(max(c, 0), sites.shape[1] - 1)
    return r, c, away_m, inside


@helper_kernel()
def heat_of(site: Site, now_s: float, constants: Constants) -> float:
    """Temperature of the atom on a site now."""
    return relaxed(site.heat, now_s - site.since_s, constants)


@helper_kernel()
def disturb(site: Site, loss: float, heat: float, now_s: float) -> None:
    """Set the temperature of the atom on a site, and add to its hazard of being lost."""
    site.heat, site.since_s = heat, now_s
    site.hazard -= math.log1p(-min(loss, 1.0 - 1e-9))


@helper_kernel()
def pick_up(
    sites: Records, tweezers: Records, segment: Segment, constants: Constants, merging: Floats
) -> None:
    """Rule 2: tweezers that are ramped up take the atoms of the sites close to them, row by row."""
    for tweezer in tweezers.ravel():
        if tweezer.state != NEW:
            continue
        rises = tweezer.power_start < RAMP * tweezer.power_end
        tweezer.state = NEW if rises else EMPTY  # it may become deep enough in the next segment
        r, c, away_m, inside = nearest_site(tweezer.row, tweezer.col, sites, constants)
        site = sites[r, c]
        if not (inside and site.atom and takes(tweezer.depth, site.depth, away_m, merging)):
            continue
        tweezer.state, site.atom = HELD, False
        tweezer.site_depth, tweezer.away = site.depth, away_m
        tweezer.heat = heat_of(site, segment.start_s, constants)
        tweezer.is_picked = False
        tweezer.lost, site.hazard = -math.expm1(-site.hazard), 0.0


@helper_kernel()
def find_mixed(tones: Records) -> Mask:
    """Which tones come too close to another, or pass it (n_tones,)."""
    mixed = np.zeros(len(tones), np.bool_)
    for k in range(len(tones)):
        for m in range(k):
            tone, other = tones[k], tones[m]
            before, after = tone.start - other.start, tone.end - other.end
            near = abs(before) < MIXING or abs(after) < MIXING or before * after < 0.0
            if near and (tone.on_start or tone.on_end) and (other.on_start or other.on_end):
                mixed[k] = mixed[m] = True
    return mixed


@helper_kernel()
def mix(row: Records, col: Records, tweezers: Records, lost: Losses) -> None:
    """Rule 3: atoms on tones that mix are lost."""
    by_row, by_col = find_mixed(row), find_mixed(col)
    for i in range(len(row)):
        for j in range(len(col)):
            tweezer = tweezers[i, j]
            if tweezer.state == HELD and (by_row[i] or by_col[j]):
                tweezer.state = EMPTY
                lost.collision += 1


@helper_kernel()
def find_movers(tweezers: Records, min_depth: float) -> Ints:
    """The numbers of the moving tweezers deep enough to knock atoms out (n,)."""
    movers, n = np.empty(len(tweezers), np.int64), 0
    for k in range(len(tweezers)):
        tweezer = tweezers[k]
        moves = max(abs(tweezer.to_row - tweezer.row), abs(tweezer.to_col - tweezer.col)) > AT_REST
        if moves and tweezer.state != DARK and tweezer.depth > min_depth:
            movers[n] = k
            n += 1
    return movers[:n]


@helper_kernel()
def span(starts: Floats, ends: Floats, n_sites: int) -> tuple[int, int]:
    """Range of the rows or columns that tweezers come close to on their ways: first, last + 1."""
    low, high = min(starts.min(), ends.min()), max(starts.max(), ends.max())
    first, last = math.floor(low - TOLERANCE), math.ceil(high + TOLERANCE)
    return max(first, 0), min(last + 1, n_sites)


@helper_kernel()
def first_to_hit(tweezers: Records, movers: Ints, r: int, c: int) -> int:
    """Which tweezer passes over a site first; -1 if none does. One that ends there lands or goes on."""
    first, soonest = -1, math.inf
    for k in movers:
        tweezer = tweezers[k]
        down, right = way_of(tweezer)
        to_r, to_c = r - tweezer.row, c - tweezer.col
        when = min(max((to_r * down + to_c * right) / (down * down + right * right), 0.0), 1.0)
        miss_r, miss_c = to_r - when * down, to_c - when * right
        ends_there = (to_r - down) ** 2 + (to_c - right) ** 2 <= TOLERANCE * TOLERANCE
        if miss_r * miss_r + miss_c * miss_c <= TOLERANCE * TOLERANCE and when < soonest and not ends_there:
            first, soonest = k, when
    return first


@helper_kernel()
def sweep(sites: Records, tweezers: Records, constants: Constants, lost: Losses) -> None:
    """Rule 4: moving tweezers knock out atoms on sites.

    The motion is a straight line from the start to the end of a segment. The first tweezer to arrive
    may lose its own atom too.
    """
    movers = find_movers(tweezers, constants.static_depth)
    if len(movers) == 0:
        return
    on_way = tweezers[movers]
    top, bottom = span(on_way["row"], on_way["to_row"], sites.shape[0])
    left, right = span(on_way["col"], on_way["to_col"], sites.shape[1])
    for r in range(top, bottom):
        for c in range(left, right):
            first = first_to_hit(tweezers, movers, r, c) if sites[r, c].atom else -1
            if first < 0:
                continue
            sites[r, c].atom = False
            lost.collision += 1
            tweezer = tweezers[first]
            if tweezer.state == HELD and constants.pair_survival > 0.0:
                affect(tweezer, (1.0 - constants.pair_survival, 1.0))
            elif tweezer.state == HELD:
                tweezer.state = EMPTY
                lost.collision += 1


@helper_kernel()
def dot(down: float, right: float, to_down: float, to_right: float, constants: Constants) -> float:
    """Scalar product of two displacements in sites, along columns and rows, in square metres."""
    straight = (down * to_down + right * to_right) * constants.spacing * constants.spacing
    return straight + 0.5 * constants.skew * (down * to_right + right * to_down)


@helper_kernel()
def nearest_pass(r: int, c: int, tweezer: Tweezer, constants: Constants) -> float:
    """Distance in metres at which a tweezer passes a site in a segment; inf if it is nearest in another."""
    down, right = way_of(tweezer)
    to_down, to_right = r - tweezer.row, c - tweezer.col
    length2 = dot(down, right, down, right, constants)
    ahead = dot(to_down, to_right, down, right, constants)
    if length2 > 0.0 and ahead >= length2:
        return math.inf  # it comes nearer still
    if length2 > 0.0 and ahead > 0.0:
        part = ahead / length2
        to_down, to_right = to_down - part * down, to_right - part * right
    else:
        rested = tweezer.down_hz == 0.0 and tweezer.right_hz == 0.0
        came_nearer = dot(to_down, to_right, tweezer.down_hz, tweezer.right_hz, constants) > 0.0
        if not (came_nearer or (rested and length2 > 0.0)):
            return math.inf
    return math.sqrt(dot(to_down, to_right, to_down, to_right, constants))


@helper_kernel()
def lines_beside(start: float, way: float, reach: float, n_lines: int) -> tuple[int, int]:
    """Range of the rows or columns within reach of a way: first, last + 1."""
    first = max(math.ceil(start + min(way, 0.0) - reach), 0)
    return first, min(math.floor(start + max(way, 0.0) + reach) + 1, n_lines)


@helper_kernel()
def pass_atoms(sites: Records, tweezers: Records, segment: Segment, constants: Constants) -> None:
    """Rule 5: tweezers that pass atoms on sites add to their hazards of being lost, and of their own atom."""
    cosine = 0.5 * constants.skew / (constants.spacing * constants.spacing)
    within_m = BESIDE[-1] * constants.static_waist
    reach = within_m / constants.spacing / math.sqrt(1.0 - cosine * cosine)
    for tweezer in tweezers:
        if tweezer.state == DARK:
            continue
        down, right = way_of(tweezer)
        speed_m_s = math.sqrt(dot(down, right, down, right, constants)) / max(segment.duration_s, INSTANT_S)
        top, bottom = lines_beside(tweezer.row, down, reach, sites.shape[0])
        left, last = lines_beside(tweezer.col, right, reach, sites.shape[1])
        for r in range(top, bottom):
            for c in range(left, last):
                away_m = nearest_pass(r, c, tweezer, constants) if sites[r, c].atom else math.inf
                if TOLERANCE * constants.spacing < away_m < within_m:
                    pass_atom(sites[r, c], tweezer, away_m, speed_m_s, segment.start_s, constants)


@helper_kernel()
def pass_atom(
    site: Site, tweezer: Tweezer, away_m: float, speed_m_s: float, now_s: float, constants: Constants
) -> None:
    """A tweezer passes the atom on a site, at a distance; the atom that it carries is at risk as well."""
    heat = heat_of(site, now_s, constants)
    loss, warmer = pass_by(site.depth, tweezer.depth, speed_m_s, away_m, heat, constants)
    disturb(site, loss, heat * warmer, now_s)
    if tweezer.state == HELD:
        affect(tweezer, (loss, 1.0))


@helper_kernel()
def one_left(n: int, pair_survival: float) -> float:
    """Probability that n atoms in a tweezer end as one, not none: P(n) of ``handover.pair_survival``."""
    return (1.0 - (pair_survival - 1.0) ** n) / (2.0 - pair_survival)


@helper_kernel()
def land(sites: Records, goals: Ints, luck: Floats, n: int, pair_survival: float) -> int:
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
        n_here += int(site.atom)
        site.atom = luck[k] < one_left(n_here, pair_survival)
        n_lost += n_here - int(site.atom)
    return n_lost


@helper_kernel()
def land_empty(site: Site, tweezer: Tweezer, now_s: float, constants: Constants) -> None:
    """An empty tweezer that came from elsewhere goes off on an atom, which may be lost, or is heated."""
    if tweezer.speed == 0.0:
        return
    heat = heat_of(site, now_s, constants)
    loss, warmer = land_on(site.depth, tweezer.peak, tweezer.speed, tweezer.fall_s, heat, constants)
    disturb(site, loss, heat * warmer, now_s)


@helper_kernel()
def set_down(
    sites: Records, tweezers: Records, segment: Segment, draws: Floats, constants: Constants, lost: Losses
) -> int:
    """Rule 6: tweezers that switch off drop their atoms; returns the number of draws used."""
    now_s, n, n_drawn = segment.start_s + segment.duration_s, 0, 0
    goals, luck = np.empty(len(tweezers), np.int64), np.empty(len(tweezers))
    for tweezer in tweezers:
        if tweezer.stays_on or tweezer.state == DARK:
            continue
        before, tweezer.state = tweezer.state, DARK
        r, c, away_m, inside = nearest_site(tweezer.to_row, tweezer.to_col, sites, constants)
        site = sites[r, c]
        if before != HELD:
            if inside and site.atom and away_m <= TOLERANCE * constants.spacing:
                land_empty(site, tweezer, now_s, constants)
            continue
        risk = risks(site.depth, tweezer, away_m, segment.n_further, segment.factor, constants)
        draw = draws[n_drawn]
        n_drawn += 1
        if not inside:
            lost.ejected += 1
        elif survives(risk, draw, lost):
            goals[n] = r * sites.shape[1] + c
            luck[n] = (draw[2] - risk.motion) / (1.0 - risk.motion)  # uniform, as the draw was not below it
            site.heat, site.since_s, site.hazard = risk.temperature, now_s, 0.0
            n += 1
    lost.collision += land(sites, goals, luck, n, constants.pair_survival)
    return n_drawn


@helper_kernel()
def play(
    sites: Records, row: Records, col: Records, crossings: Records, segment: Segment, draws: Floats,
    constants: Constants, merging: Floats, lost: Losses,
) -> int:  # fmt: skip
    """Rules 2 to 6 for a segment; returns the number of draws used."""
    tweezers = crossings.reshape(crossings.size)
    for tweezer in tweezers:
        power = max(tweezer.power_start, tweezer.power_end)
        tweezer.depth = mobile_depth(power, segment.n_further, constants)
    pick_up(sites, tweezers, segment, constants, merging)
    mix(row, col, crossings, lost)
    sweep(sites, tweezers, constants, lost)
    pass_atoms(sites, tweezers, segment, constants)
    for tweezer in tweezers:
        if tweezer.state != DARK:
            advance(tweezer, segment.duration_s, segment.course, segment.n_further, constants)
    return set_down(sites, tweezers, segment, draws, constants, lost)


@kernel(
    f"void(Array({signature(SITE)}, 2, 'C'), float64, {TONES}, {OFFSETS}, {TONES}, {OFFSETS}, {VECTOR}, "
    f"{const('int8', 1)}, int64, float64, {TABLE}, {VECTOR}, UniTuple(float64, {N_NUMBERS}), {TABLE}, "
    f"{signature(LOSSES)})"
)
def carry_atoms(
    sites: Records, now_s: float, rows: Records, row_offsets: Offsets, cols: Records, col_offsets: Offsets,
    duration_s: Floats, courses: NDArray[np.int8], n_segments: int, factor: float, draws: Floats,
    tables: Floats, numbers: Any, merging: Floats, lost: Losses,
) -> None:  # fmt: skip
    """Carry atoms by the first segments of a program.

    Args:
        sites: The sites and their atoms; changed in place.
        now_s: When the program starts.
        rows: Row tones of all segments (n_row_tones,).
        row_offsets: The first of each segment (at least n_segments + 1,).
        cols: Column tones, likewise.
        col_offsets: Likewise.
        duration_s: Durations of the segments.
        courses: Their courses of the frequency.
        n_segments: Number of segments played.
        factor: The shot's factor on the losses.
        draws: Uniform random numbers (at least :func:`max_drop_offs`, N_DRAWS).
        tables: The tables of a move, see :func:`labseq_virtual.responses.move_tables`.
        numbers: The constants without the tables, a tuple (N_NUMBERS,).
        merging: The merging distances, see :func:`labseq_virtual.tweezer_kernels.takes`.
        lost: The losses so far, without those that the hazards will cost; changed in place.
    """
    constants = Constants(tables, *numbers)
    n_drawn, old_row, old_col = 0, rows[:0], cols[:0]
    old = np.zeros((0, 0), TWEEZER)
    for k in range(n_segments):
        row, col = rows[row_offsets[k] : row_offsets[k + 1]], cols[col_offsets[k] : col_offsets[k + 1]]
        by_row, by_col = count_lit(row), count_lit(col)
        if by_row.start * by_col.start + by_row.end * by_col.end == 0:  # no tweezer is on
            row, col = row[:0], col[:0]
        tweezers = follow(old_row, old_col, old, row, col)
        lost.program += count_held(old) - count_held(tweezers)
        segment = Segment(now_s, duration_s[k], courses[k], by_row.any + by_col.any - 2, factor)
        n_drawn += play(sites, row, col, tweezers, segment, draws[n_drawn:], constants, merging, lost)
        old_row, old_col, old = row, col, tweezers
        now_s += duration_s[k]
    lost.program += count_held(old)
