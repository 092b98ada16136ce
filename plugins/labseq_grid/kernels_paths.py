r"""Kernels that turn rows and columns of a batch into paths of tones.

The tweezers leave their sites for the *lanes* half-way between rows and half-way between columns, go along
these, and reach their goals from there: in a lane they keep half a line's distance from every site. The way
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

A lane of a triangular lattice may weave, see :func:`add_travel`::

    o       o       o       o
       ,-.     ,-.     ,-.
      /   \   /   \   /   \
     '     `-'     `-'     `
        o       o       o

Positions are in lines: 2.0 is the third row or column, 2.5 the lane behind it. Everything is written for
tones of the rows first; with rows and columns swapped it is the same.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import helper_kernel
from labseq_grid.kernels_columns import NUMBERS, Ints

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LANE: Final = 0.5
"""Distance of a lane from the lines of sites on both sides."""
PARTS: Final = 8
"""Parts of a site of a tweezer's way along a lane that weaves; with 6 corners come at the trap frequency."""
KNOTS_OF: Final = "float64[:, ::1]"


@helper_kernel(f"void({NUMBERS}, int64, int64, int64, int64, float64[::1])")
def find_lanes(lines: Ints, n: int, first: int, last: int, side: int, lanes: Floats) -> None:
    """Choose a lane beside each of some lines, on the given side if that is possible.

    At the edge of the AOD's band all go to the other side. If both edges are taken, the
    lines up to a gap go down and those from there on up; there is a gap, since a batch never takes all lines.

    Args:
        lines: int64 (n,), ascending.
        n: Number of lines.
        first: First line that the band reaches.
        last: Last one.
        side: 1 or -1, the side where they go if they can.
        lanes: Result, float64 (n,).
    """
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
    for i in range(n):
        lanes[i] = lines[i] + (LANE if i < turn else -LANE)


@helper_kernel("int64(int64[::1], int64[::1], int64)")
def main_side(before: Ints, after: Ints, n: int) -> int:
    """The side to which most of the way goes; 1 if there is none."""
    total = 0
    for i in range(n):
        total += after[i] - before[i]
    return -1 if total < 0 else 1


@helper_kernel(f"int64({KNOTS_OF}, {KNOTS_OF}, int64, float64[::1], float64[::1])")
def add_knot(rows: Floats, columns: Floats, n_knots: int, row: Floats, column: Floats) -> int:
    """Add a knot, unless all tones are there already; return the number of knots."""
    moves = n_knots == 0
    for i in range(len(row)):
        moves = moves or rows[n_knots - 1, i] != row[i]
    for i in range(len(column)):
        moves = moves or columns[n_knots - 1, i] != column[i]
    if not moves:
        return n_knots
    rows[n_knots, : len(row)] = row
    columns[n_knots, : len(column)] = column
    return n_knots + 1


@helper_kernel("int64(int64, int64)")
def max_knots(n_rows: int, n_cols: int) -> int:
    """More than the number of knots of any batch on a grid, lines outside of it included.

    Each site of the way along rows and columns takes PARTS, half a site more where tweezers go both ways,
    and each row that is dropped off on its own 4.
    """
    return PARTS * (n_rows + n_cols + 2) + 24


@helper_kernel(f"int64({KNOTS_OF}, {KNOTS_OF}, int64, float64[::1], float64[::1], float64)")
def add_travel(
    moving: Floats, crossing: Floats, n_knots: int, to: Floats, lanes: Floats, weave: float
) -> int:
    """Add the way of the moving tones along the lanes of the others; return the number of knots.

    On a triangular lattice a straight lane is 0.43 spacings from the sites on both sides, while the
    middles of the lattice's triangles and of their edges are 0.5 or more from all sites. So all tweezers
    weave from one middle to the next: the lanes swing to and fro once in each site of the way. Tones that
    wait, on the middle of an edge too, swing with them straight across that edge. Those that move are
    shifted so that their tweezers, which the swing takes along the other axis, go evenly. Tones that move
    the other way need the opposite swing, and so start half a site later.

    Args:
        moving: float64 (>= n_knots, n), the tones that move along the lanes, up to here.
        crossing: float64 (>= n_knots, m), the others, which are in their lanes.
        n_knots: Number of knots so far.
        to: float64 (n,), where the moving tones end, whole sites from where they are.
        lanes: float64 (m,), where the others are.
        weave: How far the lanes swing, in lines; below 0 on a lattice that is sheared the other way.
    """
    if weave == 0.0:
        return add_knot(moving, crossing, n_knots, to, lanes)
    start = moving[n_knots - 1, : len(to)].copy()
    up = max(0, round((to - start).max()))
    down = max(0, round((start - to).max()))
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
            n_knots = add_knot(moving, crossing, n_knots, at, lanes + swing)
    return n_knots


@helper_kernel(f"float64[::1]({KNOTS_OF}, int64, float64[::1], float64)")
def half_way(path: Floats, n_knots: int, to: Floats, swing: float) -> Floats:
    """Where tones are half-way through half a site, while those that wait swing out of the way.

    A tone in a lane goes as far as the other axis' tones, one on a line twice as far to the other side: both
    straight away from the edge of a triangle that its tweezers are on.
    """
    at = np.empty(len(to))
    for i in range(len(to)):
        here = path[n_knots - 1, i]
        at[i] = 0.5 * (here + to[i])
        if here == to[i]:
            at[i] += -2.0 * swing if here % 1.0 == 0.0 else swing
    return at


@helper_kernel(f"int64({KNOTS_OF}, int64, float64[::1])")
def side(path: Floats, n_knots: int, to: Floats) -> int:
    """1 if tones move between a lane and the next higher line, -1 the next lower one, 0 neither, 2 both."""
    above = below = 0
    for i in range(len(to)):
        here = path[n_knots - 1, i]
        up = (to[i] > here) == (here % 1.0 != 0.0)
        above |= up and here != to[i]
        below |= not up and here != to[i]
    return 2 if above & below else above - below


@helper_kernel("boolean(float64[::1], int64, int64)")
def are_apart(tones: Floats, first: int, last: int) -> bool:
    """Whether the tones of an axis are within its band and at least half a line apart."""
    apart = tones[0] >= first and tones[-1] <= last
    for i in range(1, len(tones)):
        apart = apart and tones[i] - tones[i - 1] >= LANE
    return apart


Band = tuple[int, int, int, int]
BAND: Final = "UniTuple(int64, 4)"
"""First and last row, first and last column that the tones reach."""


@helper_kernel(f"int64({KNOTS_OF}, {KNOTS_OF}, int64, float64[::1], float64[::1], float64, {BAND}, int64)")
def add_middle(
    rows: Floats,
    columns: Floats,
    n_knots: int,
    row: Floats,
    column: Floats,
    weave: float,
    band: Band,
    way: int,
) -> int:
    """Add a knot half-way through half a site, unless tones are too near to one another there or too far out.

    ``way`` is the side to which tweezers on the edges go: 1 up along the rows, -1 down, 0 neither.
    """
    at = half_way(rows, n_knots, row, way * abs(weave))
    across = half_way(columns, n_knots, column, way * weave)
    if way != 0 and are_apart(at, band[0], band[1]) and are_apart(across, band[2], band[3]):
        n_knots = add_knot(rows, columns, n_knots, at, across)
    return n_knots


@helper_kernel(f"int64({KNOTS_OF}, {KNOTS_OF}, int64, float64[::1], float64[::1], float64, {BAND})")
def add_half_site(
    rows: Floats, columns: Floats, n_knots: int, row: Floats, column: Floats, weave: float, band: Band
) -> int:
    """Add a way of half a site from lanes to lines or back, by the middle of a triangle.

    All tweezers are on middles of edges, or go from or to their sites; see :func:`add_travel`.
    """
    sides = side(rows, n_knots, row), side(columns, n_knots, column)
    if weave == 0.0 or max(sides) == 2:
        return add_knot(rows, columns, n_knots, row, column)
    shear = 1 if weave > 0.0 else -1
    if sides[0] * sides[1] * shear < 0:  # first the columns alone
        here = rows[n_knots - 1, : len(row)].copy()
        n_knots = add_middle(rows, columns, n_knots, here, column, weave, band, shear * sides[1])
        n_knots = add_knot(rows, columns, n_knots, here, column)
        sides = sides[0], 0
    way = sides[0] if sides[0] != 0 else shear * sides[1]
    n_knots = add_middle(rows, columns, n_knots, row, column, weave, band, way)
    return add_knot(rows, columns, n_knots, row, column)


@helper_kernel("void(bool_[:, ::1], int64[::1], int64, int64, bool_[::1], bool_[::1])")
def next_to_put_down(free: Bools, goes_off: Ints, n: int, m: int, together: Bools, used: Bools) -> None:
    """Choose the rows that are dropped off together: those that leave no empty tweezer on an atom.

    Args:
        free: bool (2 n, m): which crossings carry atoms, then which may be dropped off.
        goes_off: int64 (n,), the knot at which each row is dropped off, 0 if it is still on.
        n: Number of rows.
        m: Number of columns.
        together: Result, bool (n,), the rows.
        used: Result, bool (m,), the columns that carry atoms in these rows.
    """
    together[:] = False
    used[:] = False
    for i in range(n):
        if goes_off[i] > 0:
            continue
        fits = True
        for j in range(m):
            if used[j] or free[i, j]:
                for k in range(i + 1):
                    if k == i or together[k]:
                        fits = fits and free[n + k, j]
        if not fits:
            continue
        together[i] = True
        for j in range(m):
            used[j] = used[j] or free[i, j]


@helper_kernel(
    f"int64({NUMBERS}, {NUMBERS}, {NUMBERS}, {NUMBERS}, bool_[:, ::1], int64, int64, int64, int64, "
    f"float64, {KNOTS_OF}, {KNOTS_OF}, {NUMBERS})"
)
def find_paths(
    row: Ints,
    to_row: Ints,
    column: Ints,
    to_column: Ints,
    free: Bools,
    n_rows: int,
    n_cols: int,
    slots: int,
    stages: int,
    weave: float,
    rows: Floats,
    columns: Floats,
    goes_off: Ints,
) -> int:
    """Find the paths of the tones of a batch.

    Args:
        row: int64 (n,), where the row tones start.
        to_row: int64 (n,), where they end.
        column: int64 (m,), where the column tones start.
        to_column: int64 (m,), where they end.
        free: bool (2 n, m): which crossings carry atoms, then which may be dropped off.
        n_rows: Rows of the grid.
        n_cols: Columns of the grid.
        slots: Lines beyond the grid that the tones reach.
        stages: Whether rows are dropped off in stages, so that only free crossings are dropped off.
        weave: How far lanes swing, see :func:`add_travel`; 0 for straight ones.
        rows: Result, float64 (max_knots, n), positions of the row tones at each knot.
        columns: Result, float64 (max_knots, m), of the column tones.
        goes_off: Result, int64 (n,), the knot at which each row tone is ramped down.

    Returns:
        Number of knots.
    """
    n, m = len(row), len(column)
    low, high = -slots, n_rows - 1 + slots
    left, right = -slots, n_cols - 1 + slots
    band = low, high, left, right
    here, across = np.empty(n), np.empty(m)
    there, beside = np.empty(n), np.empty(m)
    side = main_side(row, to_row, n)
    still = True
    for i in range(n):
        still = still and row[i] == to_row[i]
    find_lanes(row, n, low, high, side, here)
    find_lanes(to_row, n, low, high, side if still else -side, there)
    side = main_side(column, to_column, m)
    still = True
    for j in range(m):
        still = still and column[j] == to_column[j]
    find_lanes(column, m, left, right, side, across)
    find_lanes(to_column, m, left, right, side if still else -side, beside)
    n_knots = add_knot(rows, columns, 0, row.astype(np.float64), column.astype(np.float64))
    n_knots = add_knot(rows, columns, n_knots, here, across)
    n_knots = add_travel(columns, rows, n_knots, beside, here, weave)
    n_knots = add_travel(rows, columns, n_knots, there, beside, weave)
    goes_off[:] = 0
    together, used = np.ones(n, np.bool_), np.ones(m, np.bool_)
    first = True
    while True:
        if stages:
            next_to_put_down(free, goes_off, n, m, together, used)
        at = np.where(used, to_column.astype(np.float64), beside)
        if not first:
            n_knots = add_half_site(rows, columns, n_knots, there, at, weave, band)
        first = False
        for i in range(n):
            if together[i]:
                there[i] = to_row[i]
        n_knots = add_half_site(rows, columns, n_knots, there, at, weave if stages else 0.0, band)
        n_on = 0
        for i in range(n):
            if together[i]:
                goes_off[i] = n_knots - 1
            n_on += goes_off[i] == 0
        if n_on == 0:
            return n_knots
