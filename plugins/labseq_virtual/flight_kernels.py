"""Kernels that integrate the motion of atoms in the light of static and mobile tweezers.

Energies and depths are per mass, in m^2/s^2. These arguments occur in several kernels:

- ``atom``: position and velocity, :class:`labseq_virtual.records.Atom`.
- ``plane``: positions of the sites, :class:`labseq_virtual.records.Plane`.
- ``rows``, ``cols``: the tones from frame to frame, :func:`labseq_virtual.light_kernels.course_of`.
- ``flights``, ``state``: :class:`Flight` and ``atom`` of each atom that a tweezer has come near so far.
- ``sites``: the sites and their atoms, ``Site`` (n_rows, n_cols).
- ``machine``: the constants, :class:`Machine`.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq_virtual.atom_kernels import (
    AWAY_X,
    AWAY_Y,
    COL,
    COL_CHANGE,
    LANES,
    MACHINE,
    N_NUMBERS,
    ROW,
    ROW_CHANGE,
    STATIC,
    VX,
    VY,
    VZ,
    WAY_X,
    WAY_Y,
    ZERO,
    Machine,
    X,
    Y,
    Z,
    draw_atom,
    energy_in,
    move,
    pull,
)
from labseq_virtual.formulas import KELVIN
from labseq_virtual.light_kernels import (
    CHANGE,
    CUT,
    DEPTH,
    HALF,
    MIXED,
    NEVER,
    PLACE,
    WAY,
    course_of,
    find_batches,
    light_of_axis,
)
from labseq_virtual.records import ATOM, SITE, TONE, Atom, Plane, Site, record, signature

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Records = Any
"""An array of records. numpy has no type with the columns."""

NEAR = 2.6
"""Distance in waists beyond which a tweezer is neglected, where it has 1.4e-6 of its depth."""
GONE = 2.0
"""Distance in waists from every tweezer beyond which an unbound atom counts as lost (ours)."""
HIGH = 4.0
"""Distance from the plane in Rayleigh lengths beyond which an unbound atom counts as lost (ours)."""
BLOCK = 0.15
"""Distance moved by the fastest tone, in sites, during which an atom feels the same two tweezers."""
BLOCK_S = 20e-6
"""Longest time during which an atom feels the same two tweezers."""
STEPS = 15.0
"""Minimum number of integration steps per period of the deepest tweezer."""
LIT = 0.2
"""Factor of the depth above which a tone counts as on when its tweezer is cut off. Half the amplitude is a
quarter. A ramp of 60 us is below it by then."""
COLDEST = 0.1
"""Smallest ratio of temperatures after and before a flight, because the energies of one atom scatter."""


KEPT, HAND_OVER, TRANSPORT, COLLISION, EJECTED, PROGRAM, FLYING, SETTLED = range(8)
"""Places in ``FATES``. The last two are temporary. A settled atom is bound only by its static tweezer, and
is not moved until a mobile tweezer comes near."""


class Flight:
    """An atom near which a mobile tweezer comes. Times are nan for events that did not happen.

    Attributes:
        fate: Fate of the atom.
        from_row: Row of its site before the flight.
        from_col: Column of its site before the flight.
        to_row: Row of the nearest site afterwards.
        to_col: Column of the nearest site afterwards.
        held_s: Time when a mobile tweezer first held it.
        offset: Distance of that tweezer from the nearest site, in metres.
        depth: Greatest depth of the tweezer.
        lost_s: Time when the atom was lost.
        lost_row: Row where the atom was lost, in sites.
        lost_col: Column where the atom was lost, in sites.
        heat: Temperature before the flight, converted to a static tweezer of nominal depth.
        energy: Initial energy above the bottom, divided by the root of the site's relative depth.
        glow_s: Time integral of the mobile tweezers' depth, relative to the nominal static depth.
        row: Track of the row tone of its tweezer. -1 if no tweezer is near.
        col: Track of the column tone.
        until_s: Time when a tweezer last held it.
        cut_s: Time when this tweezer was cut off. inf if it was not.
    """

    fate: int
    from_row: int
    from_col: int
    to_row: int
    to_col: int
    held_s: float
    offset: float
    depth: float
    lost_s: float
    lost_row: float
    lost_col: float
    heat: float
    energy: float
    glow_s: float
    row: int
    col: int
    until_s: float
    cut_s: float


FLIGHT: Final = record(Flight)


@helper_kernel()
def sites_of(x: float, y: float, plane: Plane) -> tuple[float, float]:
    """Row and column of a place, in sites."""
    x, y = x - plane.x, y - plane.y
    return plane.row_x * x + plane.row_y * y, plane.col_x * x + plane.col_y * y


@helper_kernel()
def place_of(row: float, col: float, plane: Plane) -> tuple[float, float]:
    """Place of a row and column, in metres."""
    x = plane.x + row * plane.x_row + col * plane.x_col
    return x, plane.y + row * plane.y_row + col * plane.y_col


@helper_kernel()
def site_at(atom: Atom, plane: Plane, shape: tuple[int, int]) -> tuple[int, int, bool]:
    """Row and column of the site closest to an atom, and whether the atom is in the grid."""
    at_row, at_col = sites_of(atom.x, atom.y, plane)
    row, col = round(at_row), round(at_col)
    inside = 0 <= row < shape[0] and 0 <= col < shape[1]
    return min(max(row, 0), shape[0] - 1), min(max(col, 0), shape[1] - 1), inside


@helper_kernel()
def nearest(tones: Floats, k: int, last: int, place: float, guess: int) -> int:
    """The track closest to a place, in sites, at frame k or ``last``. -1 if none is on.

    ``guess`` is returned if it is so close that no other can be closer.
    """
    if (
        guess >= 0
        and abs(tones[guess, k, PLACE] - place) < 0.2
        and abs(tones[guess, last, PLACE] - place) < 0.2
    ):
        return guess
    best, least = -1, np.inf
    for j in range(len(tones)):
        for frame in (k, last):
            away = abs(tones[j, frame, PLACE] - place)
            if away < least:  # never for nan
                best, least = j, away
    return best


@helper_kernel()
def find_tweezer(
    flight: Flight, atom: Atom, rows: Floats, cols: Floats, k: int, last: int, plane: Plane, reach: float
) -> bool:
    """Find the mobile tweezer closest to an atom between two frames. Returns whether one is near."""
    row, col = sites_of(atom.x, atom.y, plane)
    flight.row = nearest(rows, k, last, row, flight.row)
    flight.col = nearest(cols, k, last, col, flight.col)
    if flight.row >= 0 and flight.col >= 0:
        for frame in (k, last):
            x, y = place_of(rows[flight.row, frame, PLACE], cols[flight.col, frame, PLACE], plane)
            if square(x - atom.x, y - atom.y) < reach * reach:  # never for nan
                return True
    flight.row = flight.col = -1
    return False


@helper_kernel()
def relaxed(heat: float, elapsed_s: float, aim: float, machine: Machine) -> float:
    """Temperature after a time in a static tweezer, cooled or heated by intensity noise."""
    if machine.cooling_hz > 0.0:
        return aim + (heat - aim) * math.exp(-elapsed_s * machine.cooling_hz)
    return heat * math.exp(min(elapsed_s * machine.noise_hz, 20.0))


@helper_kernel()
def wake(
    flight: Flight, atom: Atom, row: int, col: int, site: Site, now_s: float, plane: Plane,
    machine: Machine, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Draw position and velocity of a site's atom in its static tweezer, when a mobile tweezer comes."""
    level = math.sqrt(site.depth / machine.static_depth)
    flight.heat = relaxed(site.heat, max(0.0, now_s - site.since_s), machine.temperature / level, machine)
    waist, rayleigh = machine.static_waist, machine.static_rayleigh
    draw_atom(atom, site.depth, KELVIN * flight.heat * level, waist, rayleigh, rng)
    flight.energy = (energy_in(atom, 0.0, 0.0, site.depth, waist, rayleigh) + site.depth) / level
    x, y = place_of(row, col, plane)
    atom.x += x
    atom.y += y
    site.atom = False
    flight.fate, flight.row, flight.col = FLYING, -1, -1
    flight.from_row, flight.from_col, flight.to_row, flight.to_col = row, col, row, col
    flight.held_s = flight.lost_s = flight.lost_row = flight.lost_col = flight.offset = np.nan
    flight.depth = flight.glow_s = 0.0
    flight.until_s, flight.cut_s = -np.inf, np.inf


@helper_kernel()
def wake_around(
    row: float, col: float, flights: Records, state: Records, n: int, awake: Ints, block: int, sites: Records,
    now_s: float, plane: Plane, machine: Machine, rng: np.random.Generator,
) -> int:  # fmt: skip
    """Wake the atoms on the sites around a mobile tweezer, and return the number of flights."""
    x, y = place_of(row, col, plane)
    reach = NEAR * machine.mobile_waist
    for r in range(max(math.floor(row), 0), min(math.floor(row) + 2, sites.shape[0])):
        for c in range(max(math.floor(col), 0), min(math.floor(col) + 2, sites.shape[1])):
            site_x, site_y = place_of(r, c, plane)
            if square(x - site_x, y - site_y) >= reach * reach or sites[r, c].depth <= 0.0:
                continue
            awake[r, c] = block
            if sites[r, c].atom:
                wake(flights[n], state[n], r, c, sites[r, c], now_s, plane, machine, rng)
                n += 1
    return n


@helper_kernel()
def wake_atoms(
    rows: Floats, cols: Floats, k: int, last: int, flights: Records, state: Records, n: int, awake: Ints,
    sites: Records, now_s: float, plane: Plane, machine: Machine, rng: np.random.Generator,
) -> int:  # fmt: skip
    """Wake the atoms on all sites with a mobile tweezer near between two frames.

    Args:
        rows: The row tones.
        cols: The column tones.
        k: First frame.
        last: Last frame.
        flights: Array for the atoms of all sites. The first n fly or have settled.
        state: Positions and velocities of these atoms.
        n: Number of atoms that fly or have settled.
        awake: The last block in which a tweezer was near each site (n_rows, n_cols). Changed in place.
        sites: The sites. Changed in place, because woken atoms leave them.
        now_s: Time of frame k.
        plane: The plane of the sites.
        machine: The constants.
        rng: Random numbers of the shot.

    Returns:
        The number of flights.
    """
    for i in range(len(rows)):
        for j in range(len(cols)):
            for frame in (k, last):
                row, col = rows[i, frame, PLACE], cols[j, frame, PLACE]
                if (frame == k > 0) or math.isnan(row) or math.isnan(col):  # done in the block before
                    continue
                n = wake_around(row, col, flights, state, n, awake, last, sites, now_s, plane, machine, rng)
    return n


@helper_kernel()
def must_move(
    flight: Flight, atom: Atom, rows: Floats, cols: Floats, k: int, last: int, sites: Records, plane: Plane,
    machine: Machine,
) -> bool:  # fmt: skip
    """Whether an atom must be integrated from frame k to ``last``. Otherwise it settles."""
    if find_tweezer(flight, atom, rows, cols, k, last, plane, NEAR * machine.mobile_waist):
        flight.fate = FLYING
        return True
    row, col, _ = site_at(atom, plane, sites.shape)
    x, y = place_of(row, col, plane)
    depth = sites[row, col].depth
    if energy_in(atom, x, y, depth, machine.static_waist, machine.static_rayleigh) >= 0.0:
        return True
    flight.fate, flight.to_row, flight.to_col = SETTLED, row, col
    return False


@helper_kernel()
def set_tweezers(
    lanes: NDArray[np.float32], origin: Floats, moving: Ints, flights: Records, rows: Floats, cols: Floats,
    k: int, plane: Plane,
) -> None:  # fmt: skip
    """Fill in the mobile tweezers of the lanes from frame k to the next, relative to the origins."""
    for i in range(len(moving)):
        r, c = flights[moving[i]].row, flights[moving[i]].col
        if r < 0:
            continue  # its depth is 0
        lanes[ROW + i], lanes[ROW_CHANGE + i] = rows[r, k, DEPTH], rows[r, k, CHANGE]
        lanes[COL + i], lanes[COL_CHANGE + i] = cols[c, k, DEPTH], cols[c, k, CHANGE]
        x, y = place_of(rows[r, k, PLACE], cols[c, k, PLACE], plane)
        if math.isnan(x) or math.isnan(y):
            continue  # its depth is 0
        lanes[AWAY_X + i], lanes[AWAY_Y + i] = x - origin[i, 0], y - origin[i, 1]
        lanes[WAY_X + i] = rows[r, k, WAY] * plane.x_row + cols[c, k, WAY] * plane.x_col
        lanes[WAY_Y + i] = rows[r, k, WAY] * plane.y_row + cols[c, k, WAY] * plane.y_col


@helper_kernel()
def move_some(
    lanes: NDArray[np.float32], origin: Floats, moving: Ints, state: Records, flights: Records, rows: Floats,
    cols: Floats, k: int, last: int, n_steps: int, sites: Records, frame_s: float, plane: Plane,
    machine: Machine,
) -> None:  # fmt: skip
    """Move as many atoms as there are lanes, or fewer, from frame k to ``last``."""
    lanes[:] = ZERO
    for i in range(len(moving)):
        atom = state[moving[i]]
        row, col, _ = site_at(atom, plane, sites.shape)
        origin[i, 0], origin[i, 1] = place_of(row, col, plane)
        lanes[STATIC + i] = sites[row, col].depth
        lanes[X + i], lanes[Y + i], lanes[Z + i] = atom.x - origin[i, 0], atom.y - origin[i, 1], atom.z
        lanes[VX + i], lanes[VY + i], lanes[VZ + i] = atom.vx, atom.vy, atom.vz
    for frame in range(k, last):
        set_tweezers(lanes, origin, moving, flights, rows, cols, frame, plane)
        move(lanes, machine, frame_s, n_steps)
    for i in range(len(moving)):
        atom = state[moving[i]]
        atom.x, atom.y, atom.z = origin[i, 0] + lanes[X + i], origin[i, 1] + lanes[Y + i], lanes[Z + i]
        atom.vx, atom.vy, atom.vz = lanes[VX + i], lanes[VY + i], lanes[VZ + i]


@helper_kernel()
def lose(flight: Flight, fate: int, atom: Atom, plane: Plane, t_s: float) -> None:
    """Record time, place and cause of a lost atom."""
    flight.fate, flight.lost_s = fate, t_s
    flight.lost_row, flight.lost_col = sites_of(atom.x, atom.y, plane)


@helper_kernel()
def fall_out(flight: Flight, atom: Atom, plane: Plane, shape: tuple[int, int], t_s: float) -> None:
    """Lose an atom that no tweezer binds, and record the cause."""
    inside = site_at(atom, plane, shape)[2]
    fate = PROGRAM if flight.until_s > flight.cut_s - 1.5 * BLOCK_S else TRANSPORT
    lose(flight, fate if inside else EJECTED, atom, plane, t_s)


@helper_kernel()
def check_atom(
    flight: Flight, atom: Atom, rows: Floats, cols: Floats, k: int, sites: Records, t_s: float,
    lasted_s: float, plane: Plane, machine: Machine,
) -> None:  # fmt: skip
    """Find what holds an atom at frame k. It is lost once it is unbound and far from everything."""
    row, col, _ = site_at(atom, plane, sites.shape)
    x, y = place_of(row, col, plane)
    depth, mobile, to_x, to_y = sites[row, col].depth, 0.0, 0.0, 0.0
    near = square(atom.x - x, atom.y - y) < (GONE * machine.static_waist) ** 2
    if flight.row >= 0:
        r, c, before = flight.row, flight.col, k - 1
        factor = rows[r, before, DEPTH] + rows[r, before, CHANGE]
        factor *= cols[c, before, DEPTH] + cols[c, before, CHANGE]
        if factor > 0.0:
            mobile = machine.mobile_depth * factor
            at_x, at_y = place_of(
                rows[r, before, PLACE] + rows[r, before, WAY],
                cols[c, before, PLACE] + cols[c, before, WAY],
                plane,
            )
            to_x, to_y = atom.x - at_x, atom.y - at_y
            away = square(to_x, to_y)
            near = near or away < (GONE * machine.mobile_waist) ** 2
            if mobile > depth and away < machine.mobile_waist**2:
                record_hold(flight, math.sqrt(square(at_x - x, at_y - y)), mobile, t_s)
                flight.glow_s += lasted_s * mobile / machine.static_depth
    if near and abs(atom.z) < HIGH * machine.mobile_rayleigh:
        return
    energy = energy_in(atom, x, y, depth, machine.static_waist, machine.static_rayleigh)
    energy += pull(to_x, to_y, atom.z, mobile, machine.mobile_waist, machine.mobile_rayleigh)[3]
    if energy >= 0.0:
        fall_out(flight, atom, plane, sites.shape, t_s)


@helper_kernel()
def square(x: float, y: float) -> float:
    """Square of the length of a vector."""
    return x * x + y * y


@helper_kernel()
def record_hold(flight: Flight, offset: float, depth: float, t_s: float) -> None:
    """Record that a mobile tweezer holds an atom."""
    if math.isnan(flight.held_s):
        flight.held_s, flight.offset = t_s, offset
    flight.depth = max(flight.depth, depth)
    flight.until_s = t_s


@helper_kernel()
def check_faults(
    flight: Flight, atom: Atom, rows: Floats, row_faults: Ints, cols: Floats, col_faults: Ints, k: int,
    start_s: float, frame_s: float, plane: Plane,
) -> None:  # fmt: skip
    """Record when the tweezer that holds an atom at frame k is cut off. Lose an atom whose tones mix.

    A tone may be cut off after the other one was ramped down. Then the tweezer was already off.
    """
    now_s = start_s + k * frame_s
    if flight.fate != FLYING or flight.until_s != now_s:
        return
    cut = min(row_faults[flight.row, CUT], col_faults[flight.col, CUT])
    is_lit = cut < NEVER and min(rows[flight.row, cut, DEPTH], cols[flight.col, cut, DEPTH]) > LIT
    flight.cut_s = start_s + cut * frame_s if is_lit else np.inf
    if k >= min(row_faults[flight.row, MIXED], col_faults[flight.col, MIXED]):
        lose(flight, COLLISION, atom, plane, now_s)


@helper_kernel()
def collide(
    state: Records, moving: Ints, flights: Records, plane: Plane, machine: Machine, t_s: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Collisions in the light leave one or none of two moving atoms within a waist of each other."""
    for m in range(len(moving)):
        for n in range(m):
            i, j = moving[m], moving[n]
            x, y = state[i].x - state[j].x, state[i].y - state[j].y
            if square(x, y) > machine.mobile_waist**2:
                continue
            if flights[i].fate != FLYING or flights[j].fate != FLYING:
                continue
            one_left, first = rng.random() < machine.pair_survival, rng.random() < 0.5
            for atom, stays in ((i, one_left and first), (j, one_left and not first)):
                if not stays:
                    lose(flights[atom], COLLISION, state[atom], plane, t_s)


@helper_kernel()
def ways_of(rows: Floats, cols: Floats) -> Floats:
    """Distance moved by the fastest tone from each frame to the next, in sites (n_frames,)."""
    ways = np.zeros(rows.shape[1])
    for axis in (rows, cols):
        for j in range(len(axis)):
            for k in range(axis.shape[1]):
                ways[k] = max(ways[k], abs(axis[j, k, WAY]))  # never nan
    return ways


@helper_kernel()
def greatest(tones: Floats) -> float:
    """The greatest factor of the depth of any tone."""
    most = 0.0
    for j in range(len(tones)):
        for k in range(tones.shape[1]):
            most = max(most, tones[j, k, DEPTH])
    return most


@helper_kernel()
def steps_of(machine: Machine, factor: float, frame_s: float) -> int:
    """Number of steps from frame to frame. ``factor`` is the depth factor of the deepest tweezer."""
    depth, waist = machine.static_depth + factor * machine.mobile_depth, machine.mobile_waist
    return math.ceil(STEPS * frame_s * math.sqrt(depth) / (math.pi * waist))


@helper_kernel()
def end_of_block(k: int, ways: Floats, longest: int) -> int:
    """The last frame of the block that begins with frame k."""
    way, last = ways[k], k + 1
    while last < min(k + longest, len(ways) - 1) and way + ways[last] <= BLOCK:
        way += ways[last]
        last += 1
    return last


@helper_kernel()
def land(
    flight: Flight, atom: Atom, sites: Records, plane: Plane, machine: Machine, end_s: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Decide the fate of an atom that is left at the end. Its nearest site keeps it if it binds it."""
    row, col, inside = site_at(atom, plane, sites.shape)
    x, y = place_of(row, col, plane)
    depth = sites[row, col].depth
    energy = energy_in(atom, x, y, depth, machine.static_waist, machine.static_rayleigh)
    is_held = not math.isnan(flight.held_s)
    if not inside or energy >= 0.0:
        fall_out(flight, atom, plane, sites.shape, end_s)
    elif is_held and rng.random() < machine.loss:
        lose(flight, HAND_OVER, atom, plane, end_s)
    else:
        flight.fate, flight.to_row, flight.to_col = KEPT, row, col
        change = (energy + depth) / math.sqrt(depth / machine.static_depth) - flight.energy
        flight.heat = max(flight.heat + change / 3.0 / KELVIN, COLDEST * flight.heat)
        if machine.cooling_hz == 0.0:
            flight.heat *= math.exp(min(flight.glow_s * machine.noise_hz, 20.0))


@helper_kernel()
def put_down(
    flights: Records, state: Records, sites: Records, plane: Plane, end_s: float, lost: Ints
) -> None:
    """Put the atoms on their sites, lose pairs on the same site, and count the losses."""
    for i in range(len(flights)):
        for j in range(i if flights[i].fate == KEPT else 0):
            a, b = flights[i], flights[j]
            if b.fate == KEPT and a.to_row == b.to_row and a.to_col == b.to_col:
                lose(a, COLLISION, state[i], plane, end_s)
                lose(b, COLLISION, state[j], plane, end_s)
                break
    for flight in flights:
        if flight.fate == KEPT:
            site = sites[flight.to_row, flight.to_col]
            site.atom, site.heat, site.since_s = True, flight.heat, end_s
        lost[flight.fate] += 1


TABLE, OFFSETS = const("float64", 2), const("int32", 1)
TONES, SITES = const(signature(TONE), 1), f"Array({signature(SITE)}, 2, 'C')"
FLIGHTS = f"Array({signature(FLIGHT)}, 1, 'C')"
COURSES, FAULTS = const("float64", 3), const("int64", 2)
PLANE = f"UniTuple(float64, {len(Plane._fields)})"
SHOT = f"{MACHINE}, {PLANE}, npy_rng, int64[::1]"


@helper_kernel(f"{FLIGHTS}({SITES}, {COURSES}, {FAULTS}, {COURSES}, {FAULTS}, float64, float64, {SHOT})")
def fly(
    sites: Records, rows: Floats, row_faults: Ints, cols: Floats, col_faults: Ints, start_s: float,
    frame_s: float, numbers: tuple[float, ...], axes: tuple[float, ...], rng: np.random.Generator, lost: Ints,
) -> Records:  # fmt: skip
    """Move the atoms in the light of a batch.

    Between frames, positions and depths change evenly. An atom feels its nearest static tweezer and its
    nearest mobile one. Without a mobile tweezer near, an atom bound by its static tweezer is not moved.

    Args:
        sites: The sites and their atoms. Changed in place.
        rows: The row tones.
        row_faults: Faults of the row tones, see ``CUT`` (n_row_tones, 2).
        cols: The column tones.
        col_faults: Faults of the column tones.
        start_s: Time of the first frame.
        frame_s: Time from frame to frame.
        numbers: The numbers of :class:`Machine`.
        axes: The numbers of :class:`labseq_virtual.records.Plane`.
        rng: Random numbers of the shot.
        lost: Number of atoms of each of ``FATES`` (6,). Changed in place.

    Returns:
        Flights of the atoms that tweezers came near (n_atoms,).
    """
    machine, plane = Machine(*numbers), Plane(*axes)
    flights: Records = np.empty(sites.size, FLIGHT)
    state: Records = np.empty(sites.size, ATOM)
    n = 0
    moving, lanes = np.empty(sites.size, np.int64), np.empty(LANES * N_NUMBERS, np.float32)
    origin, awake = np.empty((LANES, 2)), np.full(sites.shape, -1)
    ways, k, end_s = ways_of(rows, cols), 0, start_s
    n_steps = steps_of(machine, greatest(rows) * greatest(cols), frame_s)
    while k < len(ways) - 1:
        last, n_moving = end_of_block(k, ways, round(BLOCK_S / frame_s)), 0
        now_s, end_s = end_s, start_s + last * frame_s
        n = wake_atoms(rows, cols, k, last, flights, state, n, awake, sites, now_s, plane, machine, rng)
        for i in range(n):
            flight = flights[i]
            is_asleep = flight.fate == SETTLED and awake[flight.to_row, flight.to_col] < last
            if flight.fate < FLYING or is_asleep:
                continue
            if must_move(flight, state[i], rows, cols, k, last, sites, plane, machine):
                moving[n_moving] = i
                n_moving += 1
        for m in range(0, n_moving, LANES):
            some = moving[m : min(m + LANES, n_moving)]
            move_some(
                lanes, origin, some, state, flights, rows, cols, k, last, n_steps, sites, frame_s, plane,
                machine,
            )  # fmt: skip
        for i in moving[:n_moving]:
            check_atom(flights[i], state[i], rows, cols, last, sites, end_s, end_s - now_s, plane, machine)
            check_faults(
                flights[i], state[i], rows, row_faults, cols, col_faults, last, start_s, frame_s, plane
            )
        collide(state, moving[:n_moving], flights, plane, machine, end_s, rng)
        k = last
    for i in range(n):
        if flights[i].fate >= FLYING:
            land(flights[i], state[i], sites, plane, machine, end_s, rng)
    put_down(flights[:n], state, sites, plane, end_s, lost)
    return flights[:n]


@kernel(f"{FLIGHTS}({SITES}, {TABLE}, {TABLE}, {TABLE}, {TABLE}, float64, float64, {SHOT})")
def fly_in_light(
    sites: Records, rows: Floats, row_depth: Floats, cols: Floats, col_depth: Floats, start_s: float,
    frame_s: float, numbers: tuple[float, ...], axes: tuple[float, ...], rng: np.random.Generator, lost: Ints,
) -> Records:  # fmt: skip
    """Move the atoms in the light of tones with positions in sites and depth factors (n_tracks, n_frames)."""
    row_faults, col_faults = np.full((len(rows), 2), NEVER), np.full((len(cols), 2), NEVER)
    of_rows, of_cols = course_of(rows, row_depth), course_of(cols, col_depth)
    return fly(sites, of_rows, row_faults, of_cols, col_faults, start_s, frame_s, numbers, axes, rng, lost)


@kernel(
    f"void({SITES}, {TONES}, {OFFSETS}, {TONES}, {OFFSETS}, {const('float64', 1)}, {const('int8', 1)}, "
    f"int64, UniTuple(float64, 2), float64, float64, {SHOT})"
)
def fly_in_program(
    sites: Records, rows: Records, row_offsets: NDArray[np.int32], cols: Records,
    col_offsets: NDArray[np.int32], durations_s: Floats, courses: NDArray[np.int8], n_segments: int,
    step_hz: tuple[float, float], start_s: float, frame_s: float, numbers: tuple[float, ...],
    axes: tuple[float, ...], rng: np.random.Generator, lost: Ints,
) -> None:  # fmt: skip
    """Move the atoms in the light of the first segments of a program, batch by batch.

    Args:
        sites: The sites and their atoms. Changed in place.
        rows: The row tones of all segments (n_tones,).
        row_offsets: Start of each segment in ``rows``.
        cols: The column tones.
        col_offsets: Start of each segment in ``cols``.
        durations_s: Durations of the segments.
        courses: Courses of their frequencies.
        n_segments: Number of segments that are played.
        step_hz: Difference of the frequencies of neighbouring rows, and columns.
        start_s: Start of the program.
        frame_s: Time from frame to frame.
        numbers: The numbers of :class:`Machine`.
        axes: The numbers of :class:`labseq_virtual.records.Plane`.
        rng: Random numbers of the shot.
        lost: Number of atoms of each of ``FATES`` (6,). Changed in place.
    """
    for first, last in find_batches(rows, row_offsets, cols, col_offsets, n_segments):
        rows_now, row_faults = light_of_axis(
            rows, row_offsets, durations_s, courses, first, last, frame_s, step_hz[0]
        )
        cols_now, col_faults = light_of_axis(
            cols, col_offsets, durations_s, courses, first, last, frame_s, step_hz[1]
        )
        first_s = start_s + durations_s[:first].sum() - HALF * frame_s
        fly(sites, rows_now, row_faults, cols_now, col_faults, first_s, frame_s, numbers, axes, rng, lost)
