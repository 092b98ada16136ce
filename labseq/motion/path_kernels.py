"""Kernels that check one batch with paths of tones, which are :class:`labseq.model.TonePaths`.

In all of them ``shape`` is the number of knots, of row tones and of column tones. ``positions``, float64,
holds the positions of all row tones at knot 0, at knot 1 and so on, and then of all column tones. ``tracks``
holds the same tone by tone. ``off``, int32, is the knot at which each row tone goes off, then each column
tone. Positions and ways are in sites. ``cosine`` belongs to the angle between rows and columns.
``stands_from``, int32 (n_rows, n_cols), is the leg from which an atom rests on each site. For ``stamp`` and
``lifted`` see :mod:`labseq.motion.check_kernels`. The last two numbers of a fault are a site, or axis and
tone.
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

NEVER: Final = 1 << 30
"""A leg that no batch has."""

NOWHERE: Final = (-(1 << 20), -(1 << 20))
"""No site."""

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
    """Position of a tone of an axis (0 for rows, 1 for columns) at a knot."""
    first = axis * shape[0] * shape[1]
    return float(positions[first + knot * shape[1 + axis] + tone])


@helper_kernel("float64(float64, float64, float64)")
def length(down: float, right: float, cosine: float) -> float:
    """Length of a way along rows and columns that meet at an angle."""
    return math.sqrt(max(0.0, down * down + right * right + 2.0 * cosine * down * right))


Tracks = tuple[Floats, Floats]
"""Position of each row tone at each knot, float64 (n_row_tones, n_knots), and of each column tone."""
TRACKS: Final = "UniTuple(float64[:, ::1], 2)"


@helper_kernel(f"float64[:, ::1]({POSITIONS}, {SHAPE}, int64)")
def track_axis(positions: Floats, shape: Shape, axis: int) -> Floats:
    """The position of each tone of an axis at each knot, float64 (n_tones, n_knots)."""
    n_knots, n_tones, first = shape[0], shape[1 + axis], axis * shape[0] * shape[1]
    at = positions[first : first + n_knots * n_tones].reshape((n_knots, n_tones))
    track = np.empty((n_tones, n_knots))
    for tone in range(n_tones):
        for knot in range(n_knots):
            track[tone, knot] = at[knot, tone]
    return track


@helper_kernel(f"{TRACKS}({POSITIONS}, {SHAPE})")
def tracks_of(positions: Floats, shape: Shape) -> Tracks:
    """The tracks of the tones of both axes."""
    return track_axis(positions, shape, 0), track_axis(positions, shape, 1)


@helper_kernel(f"UniTuple(float64[::1], 2)(float64[:, ::1], {KNOTS})")
def extreme_ways(track: Floats, off: Ints) -> tuple[Floats, Floats]:
    """The lowest and the highest way, with its sign, of an axis' tones on each leg, float64 (n_knots - 1,).

    Only tones that are on count. ``off``, int32 (n_tones,), says until when.
    """
    n_tones, n_knots = track.shape
    least, most = np.full(n_knots - 1, math.inf), np.full(n_knots - 1, -math.inf)
    for tone in range(n_tones):
        here, there = track[tone], track[tone, 1:]
        for leg in range(off[tone]):
            way = there[leg] - here[leg]
            least[leg], most[leg] = min(way, least[leg]), max(way, most[leg])
    return least, most


@helper_kernel(f"float64[::1]({TRACKS}, {KNOTS}, float64)")
def leg_ways(tracks: Tracks, off: Ints, cosine: float) -> Floats:
    """The longest way of any tweezer from each knot to the next, float64 (n_knots - 1,).

    A length is a convex function of its parts, so only the extremes of each axis matter.
    """
    n_rows = len(tracks[0])
    up, down = extreme_ways(tracks[0], off[:n_rows])
    left, right = extreme_ways(tracks[1], off[n_rows:])
    ways = np.empty(len(up))
    for leg in range(len(ways)):
        ways[leg] = max(
            length(up[leg], left[leg], cosine),
            length(up[leg], right[leg], cosine),
            length(down[leg], left[leg], cosine),
            length(down[leg], right[leg], cosine),
        )
    return ways


@helper_kernel(f"{FAULT}(float64[:, ::1], {KNOTS}, int64, int64, int64, float64)")
def check_axis(track: Floats, off: Ints, axis: int, n_sites: int, slots: int, least: float) -> Fault:
    """Test that the paths of the tones of an axis have meaningful numbers, stay near the grid and keep order.

    From knot to knot the distance of two tones changes evenly, so it is least at a knot. ``off``, int32
    (n_tones,), is the knot at which each tone goes off.
    """
    n_tones, n_knots = track.shape
    lowest, highest, latest = -slots, n_sites - 1 + slots, 0
    for tone in range(n_tones):
        if not 1 <= off[tone] < n_knots:
            return PATH_OFF, -1, axis, tone
        latest = max(latest, off[tone])
        for knot in range(n_knots):
            at = track[tone, knot]
            if lowest <= at <= highest:
                continue
            if not math.isfinite(at):
                return PATH_POSITION, -1, axis, tone
            if knot <= off[tone]:
                return PATH_OUTSIDE, -1, axis, tone
    if latest < n_knots - 1:
        return PATH_OFF, -1, axis, n_tones - 1
    for knot in range(n_knots):
        before = -math.inf
        for tone in range(n_tones):
            if off[tone] >= knot:
                if not track[tone, knot] - before >= least - ROUNDING:
                    return PATH_ORDER, -1, axis, tone
                before = track[tone, knot]
    return RIGHT, -1, 0, 0


@helper_kernel("int64(float64[:, ::1], int64)")
def find_tone(track: Floats, site: int) -> int:
    """The tone of an axis that starts on a site, or -1."""
    for tone in range(len(track)):
        if track[tone, 0] == site:
            return tone
    return -1


@helper_kernel(f"void({const('bool_', 2)}, {STAMPS}, int64, {STAMPS})")
def fill_stands_from(atoms: Bools, lifted: Ints, stamp: int, stands_from: Ints) -> None:
    """Fill in the leg from which an atom rests on each site, 0 if it stays there, else NEVER."""
    for row in range(atoms.shape[0]):
        for col in range(atoms.shape[1]):
            stays = atoms[row, col] and lifted[row, col] != stamp
            stands_from[row, col] = 0 if stays else NEVER


@helper_kernel(f"{FAULT}({MOVES}, {TRACKS}, {KNOTS}, {STAMPS})")
def check_ends(batch: Moves, tracks: Tracks, off: Ints, stands_from: Ints) -> Fault:
    """Test that each atom starts on a crossing of tones, and ends where the first of the two goes off.

    That knot goes into ``stands_from``, for goals on the grid.
    """
    n_rows, n_cols = stands_from.shape
    for i in range(len(batch)):
        tones = find_tone(tracks[0], batch[i, 0]), find_tone(tracks[1], batch[i, 1])
        for axis in range(2):
            if tones[axis] < 0:
                return PATH_NO_TONE, i, axis, 0
        end = min(off[tones[0]], off[len(tracks[0]) + tones[1]])
        for axis in range(2):
            if tracks[axis][tones[axis], end] != batch[i, 2 + axis]:
                return PATH_END, i, axis, end
        row, col = batch[i, 2], batch[i, 3]
        if 0 <= row < n_rows and 0 <= col < n_cols:
            stands_from[row, col] = end
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
    f"UniTuple(int64, 2)({STAMPS}, int64, UniTuple(float64, 4), float64, float64, UniTuple(int64, 2))"
)
def find_near(
    stands_from: Ints,
    leg: int,
    way: tuple[float, float, float, float],
    clearance: float,
    cosine: float,
    spared: tuple[int, int],
) -> tuple[int, int]:
    """Find an atom that rests during a leg and is too near to a way, or return NOWHERE.

    Args:
        stands_from: See :func:`fill_stands_from`.
        way: Row and column of its start, and of its end.
        clearance: Least distance.
        cosine: Cosine of the angle between rows and columns.
        spared: Row and column of a site to ignore.
    """
    n_rows, n_cols = stands_from.shape
    # rows, measured along a column, are 1 / sine farther apart than straight across
    reach = clearance / math.sqrt(1.0 - cosine * cosine)
    top, bottom = math.ceil(min(way[0], way[2]) - reach), math.floor(max(way[0], way[2]) + reach)
    left, right = math.ceil(min(way[1], way[3]) - reach), math.floor(max(way[1], way[3]) + reach)
    for row in range(max(top, 0), min(bottom + 1, n_rows)):
        for col in range(max(left, 0), min(right + 1, n_cols)):
            if stands_from[row, col] > leg or (row == spared[0] and col == spared[1]):
                continue
            away = distance(row - way[0], col - way[1], way[2] - way[0], way[3] - way[1], cosine)
            if away < clearance - ROUNDING:
                return row, col
    return NOWHERE


@helper_kernel("void(float64[::1], float64[::1], float64, float64[::1])")
def fill_site_distances(down: Floats, right: Floats, cosine: float, squares: Floats) -> None:
    """Fill in the squared distance of places from the nearest of the four sites around each.

    Args:
        down: float64 (n,), row of each place.
        right: float64 (n,), column of each place.
        cosine: Cosine of the angle between rows and columns.
        squares: Result, float64 (n,).
    """
    across = 1.0 - cosine * cosine
    for k in range(len(squares)):
        r, c = down[k] - np.floor(down[k]), right[k] - np.floor(right[k])
        x, from_next = c + cosine * r, 1.0 - r
        y = x - cosine
        this_row = min(x * x, (x - 1.0) * (x - 1.0)) + across * r * r
        next_row = min(y * y, (y - 1.0) * (y - 1.0)) + across * from_next * from_next
        squares[k] = min(this_row, next_row)


@helper_kernel("void(float64[::1], float64[::1], float64, float64, float64[::1], bool_[::1])")
def mark_near_legs(
    down: Floats, right: Floats, clearance: float, cosine: float, squares: Floats, is_near: Bools
) -> None:
    """Mark the legs of a tweezer on which it may come too near to a site.

    If a point of a leg of length l has the distance d from a site, one of its ends has at most the root of
    d^2 + l^2 / 4 (Stewart's theorem). The four sites around that end are enough, because one of them is
    within 0.71 spacings, and all others are beyond the next lines, 0.87 or more away.

    Args:
        down: float64 (n_knots,), row of the tweezer at each knot.
        right: float64 (n_knots,), column at each knot.
        clearance: Least distance.
        cosine: Cosine of the angle between rows and columns.
        squares: float64 (n_knots,), see :func:`fill_site_distances`.
        is_near: Result, bool (n_knots - 1,).
    """
    to_row, to_col, then = down[1:], right[1:], squares[1:]
    for leg in range(len(is_near)):
        r, c = to_row[leg] - down[leg], to_col[leg] - right[leg]
        limit = clearance * clearance + 0.25 * (r * r + c * c + 2.0 * cosine * r * c)
        is_near[leg] = min(squares[leg], then[leg]) < limit


@helper_kernel(f"{FAULT}(float64[::1], float64[::1], int64, boolean, {STAMPS}, float64, float64, boolean)")
def check_leg(
    down: Floats,
    right: Floats,
    leg: int,
    lands: bool,
    stands_from: Ints,
    clearance: float,
    cosine: float,
    may_land: bool,
) -> Fault:
    """Test that a tweezer comes too near to no atom on a leg.

    Args:
        down: float64 (n_knots,), row of the tweezer at each knot.
        right: float64 (n_knots,), column at each knot.
        lands: True if it goes off after the leg, without an atom.
        stands_from: See :func:`fill_stands_from`.
        clearance: Least distance.
        cosine: Cosine of the angle between rows and columns.
        may_land: True if an empty tweezer may end on an atom.
    """
    to_row, to_col = down[leg + 1], right[leg + 1]
    spared = NOWHERE
    if lands and round(to_row) == to_row and round(to_col) == to_col:
        spared = round(to_row), round(to_col)
    way = down[leg], right[leg], to_row, to_col
    near = find_near(stands_from, leg, way, clearance, cosine, spared)
    if near[0] >= 0:
        return PATH_NEAR_ATOM, -1, near[0], near[1]
    if spared[0] >= 0 and not may_land:
        place = to_row, to_col, to_row, to_col
        near = find_near(stands_from, leg, place, clearance, cosine, NOWHERE)
        if near[0] >= 0:
            return PATH_LANDS, -1, near[0], near[1]
    return RIGHT, -1, 0, 0


@helper_kernel(f"{FAULT}({TRACKS}, {KNOTS}, {STAMPS}, {STAMPS}, int64, float64, float64, boolean)")
def check_motion(
    tracks: Tracks,
    off: Ints,
    lifted: Ints,
    stands_from: Ints,
    stamp: int,
    clearance: float,
    cosine: float,
    may_land: bool,
) -> Fault:
    """Test that no tweezer, named or not, comes too near to an atom at rest, from pick-up to drop-off.

    While tones are ramped the tweezers rest where a leg ends and the next starts, and atoms that have just
    been dropped off count in the next leg. So nothing happens at a knot that the legs do not show.
    """
    n_rows, n_cols = lifted.shape
    all_down, all_right = tracks
    for i in range(len(all_down)):
        for j in range(len(all_right)):
            place = all_down[i, 0], all_right[j, 0], all_down[i, 0], all_right[j, 0]
            near = find_near(stands_from, 0, place, clearance, cosine, NOWHERE)
            if near[0] >= 0:
                return PATH_PICKS_UP, -1, near[0], near[1]
    n_knots = all_down.shape[1]
    squares, is_near = np.empty(n_knots), np.empty(n_knots - 1, np.bool_)
    for i in range(len(all_down)):
        for j in range(len(all_right)):
            end = min(off[i], off[len(all_down) + j])
            down, right = all_down[i, : end + 1], all_right[j, : end + 1]
            r, c = round(down[0]), round(right[0])
            on_site = r == down[0] and c == right[0] and 0 <= r < n_rows and 0 <= c < n_cols
            is_empty = not (on_site and lifted[r, c] == stamp)
            fill_site_distances(down, right, cosine, squares[: end + 1])
            mark_near_legs(down, right, clearance, cosine, squares, is_near[:end])
            for leg in range(end):
                if is_near[leg]:
                    fault = check_leg(
                        down,
                        right,
                        leg,
                        is_empty and leg + 1 == end,
                        stands_from,
                        clearance,
                        cosine,
                        may_land,
                    )
                    if fault[0] != RIGHT:
                        return fault
    return RIGHT, -1, 0, 0


ON_SITE: Final = 0.1
"""A tweezer that ends this near to a site, in spacings, lands on it."""


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
    """Count passes of atoms at rest, and weigh each pair once, by its least distance.

    Args:
        positions: See the module.
        off: See the module.
        shape: See the module.
        atoms: bool (n_rows, n_cols), the atoms at rest.
        cosine: Cosine of the angle between rows and columns.
        distances: In spacings, the distance from which a tweezer does not pass, the distance at which the
            weight is 1, and the additional distance at which it is 1/e.
        of_site: float64 (n_rows, n_cols), to which the weights of each site are added.
        of_tweezer: float64 (n_row_tones, n_column_tones), to which the weights of each tweezer are added.
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
