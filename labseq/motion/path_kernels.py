"""Kernels that check one batch with paths of tones; see :class:`labseq.model.TonePaths`.

In all of them ``shape`` is the number of knots, of row tones and of column tones. ``positions``,
float64, holds the position of each row tone at knot 0, at knot 1 and so on, then those of the column
tones; ``off``, int32, the knot at which each row tone goes off, then each column tone. Positions and ways
are in sites; ``cosine`` is that of the angle between rows and columns. For ``stamp``, ``lifted`` and
``goals`` see :mod:`labseq.motion.check_kernels`. The last two numbers of a fault are a site, or axis
and tone.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Moves = NDArray[np.int16]
Fault = tuple[int, int, int, int]
Shape = tuple[int, int, int]

RIGHT: Final = 0
PATH_SHAPE: Final = 25
PATH_POSITION: Final = 26
PATH_OFF: Final = 27
PATH_OUTSIDE: Final = 28
PATH_ORDER: Final = 29
PATH_NO_TONE: Final = 30
PATH_END: Final = 31
PATH_PICKS_UP: Final = 32
PATH_NEAR_ATOM: Final = 33
PATH_LANDS: Final = 34

ROUNDING: Final = 1e-9
"""Shortfall of a distance that rounding can cause, in sites."""

FAULT: Final = "UniTuple(int64, 4)"
SHAPE: Final = "UniTuple(int64, 3)"
POSITIONS: Final = const("float64", 1)
KNOTS: Final = const("int32", 1)
MOVES: Final = const("int16", 2)
STAMPS: Final = "int32[:, ::1]"


PATHS: Final = f"Tuple(({const('int32', 2)}, {POSITIONS}, {KNOTS}))"
Paths = tuple[Ints, Floats, Ints]
"""``path_shapes``, ``path_positions`` and ``path_off`` of :class:`labseq.model.Plan`."""


@helper_kernel(f"Tuple(({POSITIONS}, {KNOTS}, UniTuple(int64, 3)))({PATHS}, int64, int64, int64)")
def paths_of(paths: Paths, number: int, start: int, off_start: int) -> tuple[Floats, Ints, Shape]:
    """The positions of a batch from ``start`` on, its knots from ``off_start`` on, and its shape.

    For a line batch they are empty, and the shape is (0, 0, 0).
    """
    shapes, positions, off = paths
    n_knots = n_rows = n_cols = 0
    if number < len(shapes):
        n_knots, n_rows, n_cols = shapes[number, 0], shapes[number, 1], shapes[number, 2]
    n_tones = n_rows + n_cols
    return positions[start : start + n_knots * n_tones], off[off_start : off_start + n_tones], (
        n_knots, n_rows, n_cols,
    )  # fmt: skip


@helper_kernel(f"float64({POSITIONS}, {SHAPE}, int64, int64, int64)")
def position(positions: Floats, shape: Shape, axis: int, knot: int, tone: int) -> float:
    """Position of a tone of an axis (0: rows, 1: columns) at a knot."""
    first = axis * shape[0] * shape[1]
    return float(positions[first + knot * shape[1 + axis] + tone])


@helper_kernel("float64(float64, float64, float64)")
def length(down: float, right: float, cosine: float) -> float:
    """Length of a way along rows and columns that meet at an angle."""
    return math.sqrt(max(0.0, down * down + right * right + 2.0 * cosine * down * right))


@helper_kernel(f"float64({POSITIONS}, {KNOTS}, {SHAPE}, float64, int64)")
def leg_way(positions: Floats, off: Ints, shape: Shape, cosine: float, leg: int) -> float:
    """The longest way of any tweezer from knot ``leg`` to the next.

    A length is a convex function of its parts, so that only the extremes of each axis matter.
    """
    ends = np.zeros((2, 2))
    for axis in range(2):
        ends[axis, 0], ends[axis, 1] = math.inf, -math.inf
        for tone in range(shape[1 + axis]):
            if off[axis * shape[1] + tone] > leg:
                way = position(positions, shape, axis, leg + 1, tone)
                way -= position(positions, shape, axis, leg, tone)
                ends[axis, 0], ends[axis, 1] = min(ends[axis, 0], way), max(ends[axis, 1], way)
    longest = 0.0
    for down in ends[0]:
        for right in ends[1]:
            longest = max(longest, length(down, right, cosine))
    return longest


@helper_kernel(f"{FAULT}({POSITIONS}, {KNOTS}, {SHAPE}, int64, int64, int64, float64)")
def check_axis(
    positions: Floats, off: Ints, shape: Shape, axis: int, n_sites: int, slots: int, least: float
) -> Fault:
    """Test the paths of the tones of an axis: numbers that mean something, the band, and their order.

    From knot to knot the distance of two tones changes evenly, so that it is least at a knot.
    """
    last, n_tones = shape[0] - 1, shape[1 + axis]
    latest = 0
    for tone in range(n_tones):
        end = off[axis * shape[1] + tone]
        if not 1 <= end <= last:
            return PATH_OFF, -1, axis, tone
        latest = max(latest, end)
        for knot in range(shape[0]):
            at = position(positions, shape, axis, knot, tone)
            if not math.isfinite(at):
                return PATH_POSITION, -1, axis, tone
            if knot <= end and not -slots <= at <= n_sites - 1 + slots:
                return PATH_OUTSIDE, -1, axis, tone
    if latest < last:
        return PATH_OFF, -1, axis, n_tones - 1
    for knot in range(shape[0]):
        before = -math.inf
        for tone in range(n_tones):
            if off[axis * shape[1] + tone] >= knot:
                at = position(positions, shape, axis, knot, tone)
                if not at - before >= least - ROUNDING:
                    return PATH_ORDER, -1, axis, tone
                before = at
    return RIGHT, -1, 0, 0


@helper_kernel(f"int64({POSITIONS}, {SHAPE}, int64, int64)")
def find_tone(positions: Floats, shape: Shape, axis: int, site: int) -> int:
    """The tone of an axis that starts on a site; -1 if there is none."""
    for tone in range(shape[1 + axis]):
        if position(positions, shape, axis, 0, tone) == site:
            return tone
    return -1


@helper_kernel(f"{FAULT}({MOVES}, {POSITIONS}, {KNOTS}, {SHAPE}, {STAMPS})")
def check_ends(batch: Moves, positions: Floats, off: Ints, shape: Shape, dropped: Ints) -> Fault:
    """Test that each atom starts on a crossing of tones, and ends where the first of them goes off.

    The knot at which it does goes into ``dropped``, int32 (n_rows, n_cols), for goals on the grid.
    """
    n_rows, n_cols = dropped.shape
    for i in range(len(batch)):
        tones = find_tone(positions, shape, 0, batch[i, 0]), find_tone(positions, shape, 1, batch[i, 1])
        for axis in range(2):
            if tones[axis] < 0:
                return PATH_NO_TONE, i, axis, 0
        end = min(off[tones[0]], off[shape[1] + tones[1]])
        for axis in range(2):
            if position(positions, shape, axis, end, tones[axis]) != batch[i, 2 + axis]:
                return PATH_END, i, axis, end
        row, col = batch[i, 2], batch[i, 3]
        if 0 <= row < n_rows and 0 <= col < n_cols:
            dropped[row, col] = end
    return RIGHT, -1, 0, 0


@helper_kernel("float64(float64, float64, float64, float64, float64)")
def distance(row: float, col: float, down: float, right: float, cosine: float) -> float:
    """Distance of a site, at (row, col) from the start of a straight way, from the way."""
    square = down * down + right * right + 2.0 * cosine * down * right
    part = 0.0
    if square > 0.0:
        along = row * down + col * right + cosine * (row * right + col * down)
        part = min(max(along / square, 0.0), 1.0)
    return length(row - part * down, col - part * right, cosine)


@helper_kernel(
    f"Tuple((int64, int64))({const('bool_', 2)}, {STAMPS}, {STAMPS}, {STAMPS}, int64, int64,"
    " UniTuple(float64, 4), float64, float64, UniTuple(int64, 2))"
)
def find_near(
    atoms: Bools,
    lifted: Ints,
    goals: Ints,
    dropped: Ints,
    stamp: int,
    leg: int,
    way: tuple[float, float, float, float],
    clearance: float,
    cosine: float,
    spared: tuple[int, int],
) -> tuple[int, int]:
    """Find an atom that stands during a leg and is too near to a way; (-1, -1) if there is none.

    Args:
        atoms: bool (n_rows, n_cols), before the batch.
        lifted: As in :mod:`labseq.motion.check_kernels`.
        goals: Likewise.
        dropped: int32 (n_rows, n_cols), the knot at which the batch puts an atom onto each of its goals.
        stamp: Number of the batch.
        leg: The leg.
        way: Row and column of its start, and of its end.
        clearance: Least distance.
        cosine: Of the angle between rows and columns.
        spared: Row and column of a site that does not count.
    """
    n_rows, n_cols = atoms.shape
    # rows, measured along a column, are 1 / sine farther apart than straight across
    reach = clearance / math.sqrt(1.0 - cosine * cosine)
    top, bottom = math.ceil(min(way[0], way[2]) - reach), math.floor(max(way[0], way[2]) + reach)
    left, right = math.ceil(min(way[1], way[3]) - reach), math.floor(max(way[1], way[3]) + reach)
    for row in range(max(top, 0), min(bottom + 1, n_rows)):
        for col in range(max(left, 0), min(right + 1, n_cols)):
            stands = atoms[row, col] and lifted[row, col] != stamp
            if not stands and not (goals[row, col] == stamp and dropped[row, col] <= leg):
                continue
            if row == spared[0] and col == spared[1]:
                continue
            away = distance(row - way[0], col - way[1], way[2] - way[0], way[3] - way[1], cosine)
            if away < clearance - ROUNDING:
                return row, col
    return -1, -1


NO_SITE: Final = -(1 << 20)


@helper_kernel(
    f"{FAULT}({POSITIONS}, {KNOTS}, {SHAPE}, {const('bool_', 2)}, {STAMPS}, {STAMPS}, {STAMPS}, int64,"
    " float64, float64, boolean)"
)
def check_motion(
    positions: Floats,
    off: Ints,
    shape: Shape,
    atoms: Bools,
    lifted: Ints,
    goals: Ints,
    dropped: Ints,
    stamp: int,
    clearance: float,
    cosine: float,
    may_land: bool,
) -> Fault:
    """Test that no tweezer, named or not, comes too near to an atom that stands, from pick-up to drop-off.

    While tones are ramped the tweezers stand where a leg ends and the next starts, and atoms that have
    just been dropped off count in the next leg. So nothing happens at a knot that the legs do not show.
    """
    n_rows, n_cols = atoms.shape
    nowhere = NO_SITE, NO_SITE
    for i in range(shape[1]):
        for j in range(shape[2]):
            row, col = position(positions, shape, 0, 0, i), position(positions, shape, 1, 0, j)
            place = row, col, row, col
            near = find_near(atoms, lifted, goals, dropped, stamp, 0, place, clearance, cosine, nowhere)
            if near[0] >= 0:
                return PATH_PICKS_UP, -1, near[0], near[1]
    for i in range(shape[1]):
        for j in range(shape[2]):
            row, col = position(positions, shape, 0, 0, i), position(positions, shape, 1, 0, j)
            r, c = round(row), round(col)
            on_site = r == row and c == col and 0 <= r < n_rows and 0 <= c < n_cols
            is_empty = not (on_site and lifted[r, c] == stamp)
            end = min(off[i], off[shape[1] + j])
            for leg in range(end):
                to_row = position(positions, shape, 0, leg + 1, i)
                to_col = position(positions, shape, 1, leg + 1, j)
                spared = nowhere
                if is_empty and leg + 1 == end and round(to_row) == to_row and round(to_col) == to_col:
                    spared = round(to_row), round(to_col)
                near = find_near(
                    atoms, lifted, goals, dropped, stamp, leg, (row, col, to_row, to_col), clearance, cosine,
                    spared,
                )  # fmt: skip
                if near[0] >= 0:
                    return PATH_NEAR_ATOM, -1, near[0], near[1]
                row, col = to_row, to_col
                if spared[0] == NO_SITE or may_land:
                    continue
                place = row, col, row, col
                near = find_near(atoms, lifted, goals, dropped, stamp, leg, place, clearance, cosine, nowhere)
                if near[0] >= 0:
                    return PATH_LANDS, -1, near[0], near[1]
    return RIGHT, -1, 0, 0


ON_SITE: Final = 0.1
"""A tweezer that comes as near to a site, in spacings, ends there: it lands."""


@helper_kernel(
    f"int64({POSITIONS}, {KNOTS}, {SHAPE}, {const('bool_', 2)}, float64, UniTuple(float64, 3),"
    " float64[:, ::1], float64[:, ::1])"
)
def add_passes(
    positions: Floats,
    off: Ints,
    shape: Shape,
    atoms: Bools,
    cosine: float,
    distances: tuple[float, float, float],
    of_site: Floats,
    of_tweezer: Floats,
) -> int:
    """Weigh passes of standing atoms by their distance, each pair once, at its nearest; return how many.

    Args:
        positions: The paths.
        off: Likewise.
        shape: Likewise.
        atoms: bool (n_rows, n_cols), the atoms that stand.
        cosine: Of the angle between rows and columns.
        distances: In spacings: from where on a tweezer does not pass, where the weight is 1, and the
            additional distance at which it is 1/e.
        of_site: float64 (n_rows, n_cols), to which the weights of each site are added.
        of_tweezer: float64 (n_row_tones, n_column_tones), to which those of each tweezer are added.
    """
    n_rows, n_cols = atoms.shape
    beside, full, decay = distances
    reach = beside / math.sqrt(1.0 - cosine * cosine)
    nearest = np.full((n_rows, n_cols), math.inf)
    n_passes = 0
    for i in range(shape[1]):
        for j in range(shape[2]):
            nearest[:] = math.inf
            for leg in range(min(off[i], off[shape[1] + j])):
                row, col = position(positions, shape, 0, leg, i), position(positions, shape, 1, leg, j)
                down = position(positions, shape, 0, leg + 1, i) - row
                right = position(positions, shape, 1, leg + 1, j) - col
                top, left = math.ceil(row + min(down, 0.0) - reach), math.ceil(col + min(right, 0.0) - reach)
                bottom = math.floor(row + max(down, 0.0) + reach)
                last = math.floor(col + max(right, 0.0) + reach)
                for r in range(max(top, 0), min(bottom + 1, n_rows)):
                    for c in range(max(left, 0), min(last + 1, n_cols)):
                        if atoms[r, c] and (down != 0.0 or right != 0.0):
                            away = distance(r - row, c - col, down, right, cosine)
                            nearest[r, c] = min(nearest[r, c], away)
            for r in range(n_rows):
                for c in range(n_cols):
                    if ON_SITE <= nearest[r, c] < beside:
                        weight = math.exp((full - nearest[r, c]) / decay)
                        of_site[r, c] += weight
                        of_tweezer[i, j] += weight
                        n_passes += 1
    return n_passes
