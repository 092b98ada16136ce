r"""Kernels that turn rows and columns of a batch into paths of tones.

The tweezers leave their sites for the *lanes* half-way between rows and half-way between columns, go along
these, and reach their goals from there. In a lane they keep half a line's distance from every site. The way
of one tweezer from row 0, column 0 to row 2, column 3::

    row 0   o       o       o       o      o  a site
              1                            1  off the site, to where two lanes cross
    lane    . + - - - 2 - - - - + . .      2  columns move along the lanes of the rows
                                |
    row 1   o       o       o   3   o      3  rows move along the lanes of the columns
                                |
    lane    . . . . . . . . . . + 4 .      4  columns go to their lines,
                                    5      5  then rows, and the tweezers are dropped off
    row 2   o       o       o       o

A lane of a triangular lattice may weave, as in :func:`add_travel`::

    o       o       o       o
       ,-.     ,-.     ,-.
      /   \   /   \   /   \
     '     `-'     `-'     `
        o       o       o

Positions are in lines, so 2.0 is the third row or column, and 2.5 the lane behind it. Everything is written
for tones of the rows first. With rows and columns swapped it is the same.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import helper_kernel
from labseq_grid.kernels_columns import Floats, Ints

Bools = NDArray[np.bool_]

LANE: Final = 0.5
"""Distance of a lane from the lines of sites on both sides."""
PARTS: Final = 8
"""Parts per site of a way along a lane that weaves. With 6 parts, corners come at the trap frequency."""

Tones = tuple[Ints, Ints]
"""Start and end of the tones of an axis, int64 (n,) each."""
TONES: Final = "UniTuple(int64[::1], 2)"
Band = tuple[int, int, int, int]
"""First and last row, and first and last column that the tones reach."""
Knots = tuple[Floats, Floats, int]
"""Positions of row tones and of column tones at each knot, float64 (max_knots, n), and number of knots."""


@helper_kernel()
def find_lanes(lines: Ints, first: int, last: int, side: int) -> Floats:
    """Choose a lane next to each of some lines, on the given side if possible.

    At the edge of the AOD's band all go to the other side. If both edges are taken, the lines up to a gap go
    down and the lines after it go up. There is always a gap, since a batch never takes all lines.

    Args:
        lines: int64 (n,), ascending.
        first: First line that the band reaches.
        last: Last line that the band reaches.
        side: 1 or -1, the side where they go if they can.
    """
    n = len(lines)
    turn = n  # lines before this one go up, the others down
    if side < 0:
        turn = 0
    if lines[n - 1] == last:
        turn = 0
    if turn == 0 and lines[0] == first:
        turn = n
        if lines[n - 1] == last:
            turn = 1
            while lines[turn] == lines[turn - 1] + 1:
                turn += 1
    lanes = np.empty(n)
    for i in range(n):
        lanes[i] = lines[i] + (LANE if i < turn else -LANE)
    return lanes


@helper_kernel()
def lanes_of(tones: Tones, first: int, last: int) -> tuple[Floats, Floats]:
    """Choose the lanes in which the tones of an axis leave and arrive.

    They leave on the side to which most of the way goes, and arrive from it, or from the same side if none
    moves.
    """
    total, moves = 0, False
    for i in range(len(tones[0])):
        total += tones[1][i] - tones[0][i]
        moves = moves or tones[1][i] != tones[0][i]
    side = -1 if total < 0 else 1
    return find_lanes(tones[0], first, last, side), find_lanes(
        tones[1], first, last, -side if moves else side
    )


@helper_kernel()
def add_knot(knots: Knots, row: Floats, column: Floats) -> Knots:
    """Add a knot, unless all tones are there already."""
    rows, columns, n_knots = knots
    moves = n_knots == 0
    # here and below, because numba compiles loops many times faster than assignments of whole arrays
    for i in range(len(row)):
        moves = moves or rows[n_knots - 1, i] != row[i]
        rows[n_knots, i] = row[i]
    for i in range(len(column)):
        moves = moves or columns[n_knots - 1, i] != column[i]
        columns[n_knots, i] = column[i]
    return rows, columns, n_knots + int(moves)


@helper_kernel()
def max_knots(n_rows: int, n_cols: int) -> int:
    """More than the number of knots of any batch on a grid, including lines outside it.

    Each site of the way along rows and columns takes PARTS knots, with half a site more where tweezers go
    both ways. Each row that is dropped off on its own takes 4.
    """
    return PARTS * (n_rows + n_cols + 2) + 24


@helper_kernel()
def swapped(knots: Knots) -> Knots:
    """The same knots with rows and columns swapped."""
    return knots[1], knots[0], knots[2]


@helper_kernel()
def add_travel(knots: Knots, to: Floats, lanes: Floats, weave: float) -> Knots:
    """Add the way of the row tones along the lanes of the column tones.

    On a triangular lattice a straight lane is 0.43 spacings from the sites on both sides, while the middles
    of the lattice's triangles and of their edges are 0.5 or more from all sites. So all tweezers weave from
    one middle to the next, and the lanes swing to and fro once in each site of the way. Waiting tones, which
    may be on the middle of an edge, swing with them straight across that edge. Moving tones are shifted so
    that their tweezers, which the swing takes along the other axis, go evenly. Tones that move the other way
    need the opposite swing, and so start half a site later.

    Args:
        knots: The knots so far. The column tones are in their lanes.
        to: float64 (n,), ends of the row tones, whole sites from their positions.
        lanes: float64 (m,), positions of the column tones.
        weave: How far the lanes swing, in lines. Below 0 on a lattice that is sheared the other way.
    """
    if weave == 0.0:
        return add_knot(knots, to, lanes)
    start, swinging = knots[0][knots[2] - 1].copy(), np.empty(len(lanes))
    up = down = 0
    for i in range(len(to)):
        up, down = max(up, round(to[i] - start[i])), max(down, round(start[i] - to[i]))
    first = 1 if up >= down else -1  # the direction that starts at once
    half, shear = PARTS // 2, 1 if weave > 0.0 else -1
    n_parts = max(PARTS * max(up, down), PARTS * min(up, down) + half if min(up, down) > 0 else 0)
    at = np.empty(len(to))
    for part in range(1, n_parts + 1):
        turns = part == n_parts or part % half != 0  # or a tone starts or stops here
        swing = first * weave * math.sin(2.0 * math.pi * part / PARTS) if part % half else 0.0
        for i in range(len(to)):
            way = to[i] - start[i]
            went = part - (half if way * first < 0.0 else 0)
            turns = turns or went == 0 or went == PARTS * abs(way)
            if went <= 0:
                at[i] = start[i] + swing * shear
            elif went < PARTS * abs(way):
                at[i] = start[i] + math.copysign(went / PARTS, way) - 0.5 * shear * swing
            else:
                at[i] = to[i] + swing * shear
        if turns:
            for j in range(len(lanes)):
                swinging[j] = lanes[j] + swing
            knots = add_knot(knots, at, swinging)
    return knots


@helper_kernel()
def half_way(start: Floats, to: Floats, swing: float) -> Floats:
    """Positions of tones half-way through half a site, while waiting tones swing out of the way.

    A tone in a lane goes as far as the other axis' tones, and a tone on a line twice as far to the other
    side. Both go straight away from the edge of the triangle that their tweezers are on.
    """
    at = np.empty(len(to))
    for i in range(len(to)):
        here = start[i]
        at[i] = 0.5 * (here + to[i])
        if here == to[i]:
            at[i] += -2.0 * swing if here % 1.0 == 0.0 else swing
    return at


@helper_kernel()
def side_of(start: Floats, to: Floats) -> int:
    """1 if tones move between a lane and the next higher line, -1 the next lower line, 0 neither, 2 both."""
    above = below = 0
    for i in range(len(to)):
        here = start[i]
        up = (to[i] > here) == (here % 1.0 != 0.0)
        above |= up and here != to[i]
        below |= not up and here != to[i]
    return 2 if above & below else above - below


@helper_kernel()
def are_apart(tones: Floats, first: int, last: int) -> bool:
    """True if the tones of an axis are within its band and at least half a line apart."""
    apart = tones[0] >= first and tones[-1] <= last
    for i in range(1, len(tones)):
        apart = apart and tones[i] - tones[i - 1] >= LANE
    return apart


@helper_kernel()
def add_middle(knots: Knots, row: Floats, column: Floats, weave: float, band: Band, way: int) -> Knots:
    """Add a knot half-way through half a site, unless tones would be too close together or too far out.

    ``way`` is the side to which tweezers on the edges go, 1 up along the rows, -1 down, 0 neither.
    """
    last = knots[2] - 1
    at = half_way(knots[0][last], row, way * abs(weave))
    across = half_way(knots[1][last], column, way * weave)
    if way != 0 and are_apart(at, band[0], band[1]) and are_apart(across, band[2], band[3]):
        knots = add_knot(knots, at, across)
    return knots


@helper_kernel()
def add_half_site(knots: Knots, row: Floats, column: Floats, weave: float, band: Band) -> Knots:
    """Add a way of half a site from lanes to lines or back, by the middle of a triangle.

    All tweezers are on middles of edges as in :func:`add_travel`, or go from or to their sites.
    """
    last = knots[2] - 1
    along, across = side_of(knots[0][last], row), side_of(knots[1][last], column)
    if weave == 0.0 or max(along, across) == 2:
        return add_knot(knots, row, column)
    shear = 1 if weave > 0.0 else -1
    if along * across * shear < 0:  # first the columns alone
        here = knots[0][last].copy()
        knots = add_middle(knots, here, column, weave, band, shear * across)
        knots = add_knot(knots, here, column)
        across = 0
    way = along if along != 0 else shear * across
    knots = add_middle(knots, row, column, weave, band, way)
    return add_knot(knots, row, column)


@helper_kernel()
def next_to_put_down(carried: Bools, free: Bools, goes_off: Ints, together: Bools, used: Bools) -> None:
    """Choose the rows to drop off together, which leave no empty tweezer on an atom.

    Args:
        carried: bool (n, m), which crossings carry atoms.
        free: bool (n, m), which crossings may be dropped off.
        goes_off: int64 (n,), the knot at which each row is dropped off, 0 if it is still on.
        together: Result, bool (n,), the rows.
        used: Result, bool (m,), the columns that carry atoms in these rows.
    """
    for j in range(len(used)):
        used[j] = False
    for i in range(len(together)):
        together[i] = False
        if goes_off[i] > 0:
            continue
        fits = True
        for j in range(len(used)):
            if used[j] or carried[i, j]:
                for k in range(i + 1):
                    if k == i or together[k]:
                        fits = fits and free[k, j]
        if not fits:
            continue
        together[i] = True
        for j in range(len(used)):
            used[j] = used[j] or carried[i, j]


@helper_kernel(
    f"Tuple((float64[:, ::1], float64[:, ::1], int64[::1]))"
    f"({TONES}, {TONES}, UniTuple(bool_[:, ::1], 2), UniTuple(int64, 4), boolean, float64)"
)
def find_paths(
    rows: Tones, columns: Tones, crossings: tuple[Bools, Bools], band: Band, in_stages: bool, weave: float
) -> tuple[Floats, Floats, Ints]:
    """Find the paths of the tones of a batch, by the steps of the drawing above.

    Args:
        rows: The row tones, n of them.
        columns: The column tones, m of them.
        crossings: bool (n, m) each, which crossings carry atoms, and which may be dropped off.
        band: The lines that the tones reach.
        in_stages: True to drop off rows in stages, so that only free crossings are dropped off.
        weave: How far lanes swing, as in :func:`add_travel`, or 0 for straight lanes.

    Returns:
        Positions of the row tones at each knot, float64 (n_knots, n), and of the column tones, float64
        (n_knots, m), and the knot at which each row tone is ramped down, int64 (n,).
    """
    low, high, left, right = band
    n, m = len(rows[0]), len(columns[0])
    here, there = lanes_of(rows, low, high)
    across, beside = lanes_of(columns, left, right)
    most = max_knots(high - low + 1, right - left + 1)
    knots = np.empty((most, n)), np.empty((most, m)), 0
    knots = add_knot(knots, rows[0].astype(np.float64), columns[0].astype(np.float64))
    knots = add_knot(knots, here, across)
    knots = swapped(add_travel(swapped(knots), beside, here, weave))
    knots = add_travel(knots, there, beside, weave)
    goes_off = np.zeros(n, np.int64)
    together, used = np.ones(n, np.bool_), np.ones(m, np.bool_)
    at, n_on = np.empty(m), n
    while n_on > 0:
        if in_stages:
            next_to_put_down(crossings[0], crossings[1], goes_off, together, used)
        for j in range(m):
            at[j] = columns[1][j] if used[j] else beside[j]
        if n_on < n:
            knots = add_half_site(knots, there, at, weave, band)
        for i in range(n):
            if together[i]:
                there[i] = rows[1][i]
                n_on -= 1
        knots = add_half_site(knots, there, at, weave if in_stages else 0.0, band)
        for i in range(n):
            if together[i]:
                goes_off[i] = knots[2] - 1
    return knots[0][: knots[2]], knots[1][: knots[2]], goes_off
