"""Kernels that integrate the motion of atoms in the light of static and mobile tweezers.

Energies and depths are per mass, in m^2/s^2. Arguments that occur in several kernels:

- ``atom``: position (m) and velocity (m/s), (6,).
- ``plane``: position of site (0, 0), step from row to row, step from column to column, in m; then
  the inverse of the steps, so that ``plane[3:] @ (x, y)`` is in sites (5, 2).
- ``rows``, ``cols``: the tones from frame to frame, :func:`labseq_virtual.light_kernels.course_of`.
- ``flights``, ``state``: the atoms near which a tweezer came so far, :class:`Flight` and ``atom`` of each.
- ``sites``: the sites and their atoms, ``Site`` (n_rows, n_cols).
- ``machine``: the constants, :class:`Machine`.

Atoms that need it are integrated in single precision, several at once, so that the compiler uses the
processor's vector instructions: they are the *lanes* of a flat array.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
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
from labseq_virtual.records import SITE, TONE, Site, record, signature

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Records = Any
"""An array of records: numpy has no type for one that knows its columns."""

NEAR = 3.0
"""Distance in waists beyond which a tweezer is neglected: there it has 2e-8 of its depth."""
GONE = 2.0
"""Distance in waists from every tweezer beyond which an unbound atom counts as lost (ours)."""
HIGH = 4.0
"""Distance from the plane in Rayleigh lengths beyond which an unbound atom counts as lost (ours)."""
BLOCK = 0.15
"""Way of the fastest tone, in sites, during which an atom feels the same two tweezers."""
BLOCK_S = 20e-6
"""The longest time of that."""
STEPS = 15.0
"""Least number of steps of the integration in a period of the deepest tweezer."""
LIT = 0.2
"""Factor of the depth above which a tone counts as on when its tweezer is cut off; half the amplitude is a
quarter. A ramp of 60 us is below it by then."""
COLDEST = 0.1
"""Least temperature after a flight over that before it: the energies of one atom scatter."""


class Machine(NamedTuple):
    """The constants of the machine and of a program.

    Attributes:
        static_depth: Nominal depth of a static tweezer.
        static_waist: 1/e^2 radius of its intensity, in metres.
        static_rayleigh: Its Rayleigh length.
        mobile_depth: Depth of a mobile tweezer whose tones have their intended power.
        mobile_waist: Its radius.
        mobile_rayleigh: Its Rayleigh length.
        temperature: Of cooled atoms, in kelvin.
        cooling_hz: Rate at which the cooling light brings atoms back to it; 0 without light.
        noise_hz: Rate at which noise of the intensity heats an atom in a nominal static tweezer.
        loss: Probability that an atom which was moved is lost, beyond what its flight loses.
        pair_survival: Probability that of two atoms in one tweezer one is left.
    """

    static_depth: float
    static_waist: float
    static_rayleigh: float
    mobile_depth: float
    mobile_waist: float
    mobile_rayleigh: float
    temperature: float
    cooling_hz: float
    noise_hz: float
    loss: float
    pair_survival: float


MACHINE: Final = f"UniTuple(float64, {len(Machine._fields)})"
KEPT, HAND_OVER, TRANSPORT, COLLISION, EJECTED, PROGRAM, FLYING, SETTLED = range(8)
"""Places in ``FATES``; the last two only on the way: a settled atom is bound by its static tweezer alone, and
is not moved until a mobile one comes near."""


class Flight:
    """An atom near which a mobile tweezer comes; nan where it did not happen.

    Attributes:
        fate: What became of it.
        from_row: Row of its site before.
        from_col: Column of it.
        to_row: Row of the nearest site afterwards.
        to_col: Column of it.
        held_s: When a mobile tweezer first held it.
        offset: How far that tweezer was from the nearest site, in metres.
        depth: Greatest depth of the tweezer.
        lost_s: When the atom was lost.
        lost_row: Where, in sites.
        lost_col: Likewise.
        heat: Its temperature before, as it would be in a static tweezer of nominal depth.
        energy: Its energy at the start, above the bottom, divided by the root of its site's relative depth.
        glow_s: Sum over the time in mobile tweezers, relative to the nominal static depth.
        row: Track of the row tone of its tweezer; -1: no tweezer is near.
        col: Track of the column tone.
        until_s: When a tweezer last held it.
        cut_s: When this tweezer was cut off; inf: it was not.
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
def pull(
    x: float, y: float, z: float, depth: float, waist: float, rayleigh: float
) -> tuple[float, float, float, float]:
    """Acceleration of an atom by a Gaussian beam along z, and its potential energy per mass.

    ``U = -depth / s exp(-2 r^2 / (waist^2 s))`` with ``s = 1 + (z / rayleigh)^2``
    (R. Grimm, M. Weidemueller, Y. Ovchinnikov, Adv. At. Mol. Opt. Phys. 42, 95, 2000).

    Args:
        x: Distance from the beam's axis, in metres.
        y: The same in the other direction.
        z: Position along the axis, from the focus.
        depth: Depth per mass.
        waist: 1/e^2 radius of the intensity.
        rayleigh: Rayleigh length.
    """
    s = 1.0 + (z / rayleigh) ** 2
    q = 2.0 * (x * x + y * y) / (waist * waist * s)
    energy = depth / s * math.exp(-q)
    radial = -4.0 * energy / (waist * waist * s)
    axial = -2.0 * energy * (1.0 - q) / (s * rayleigh * rayleigh)
    return radial * x, radial * y, axial * z, -energy


@helper_kernel()
def energy_in(atom: Floats, x: float, y: float, depth: float, waist: float, rayleigh: float) -> float:
    """Energy of an atom in one tweezer at a place, negative if that binds it."""
    kinetic = 0.5 * (atom[3] * atom[3] + atom[4] * atom[4] + atom[5] * atom[5])
    return kinetic + pull(atom[0] - x, atom[1] - y, atom[2], depth, waist, rayleigh)[3]


LANES: Final = 8
"""Atoms that are moved together: those of a vector of 256 bits."""
N_NUMBERS: Final = 15
X, Y, Z, VX, VY, VZ, STATIC, AWAY_X, AWAY_Y, WAY_X, WAY_Y, ROW, ROW_CHANGE, COL, COL_CHANGE = (
    LANES * n for n in range(N_NUMBERS)
)
"""Where each number of the lanes begins: position relative to the static tweezer, velocity, its depth;
the mobile tweezer's place relative to the static one and its displacement until the next frame, the factors
of its depth, and their changes."""
ZERO, HALF_, ONE, TWO, FARTHEST = (np.float32(x) for x in (0.0, 0.5, 1.0, 2.0, 40.0))
SHORTER = np.float32(-1.0 / 32.0)
C2, C3, C4, C5 = (np.float32(1.0 / math.factorial(n)) for n in range(2, 6))


@helper_kernel()
def fall(q: np.float32) -> np.float32:
    """exp(-q) for q of at least 0, as (exp(-q / 32))^32 with a series: to 1e-5 at 8, without branches."""
    u = min(q, FARTHEST) * SHORTER
    e = ONE + u * (ONE + u * (C2 + u * (C3 + u * (C4 + u * C5))))
    e *= e
    e *= e
    e *= e
    e *= e
    return e * e


@helper_kernel()
def pull_fast(
    x: np.float32, y: np.float32, z: np.float32, depth: np.float32, width: np.float32, length: np.float32
) -> tuple[np.float32, np.float32]:
    """As ``pull``, in single precision: what x and y, and what z is multiplied with for the acceleration.

    ``width`` is 2 / waist^2, ``length`` 1 / rayleigh^2.
    """
    g = ONE / (ONE + z * z * length)
    q = (x * x + y * y) * width * g
    energy = depth * g * fall(q)
    return -TWO * width * g * energy, -TWO * energy * (ONE - q) * g * length


@helper_kernel()
def move(lanes: NDArray[np.float32], machine: Machine, duration_s: float, n_steps: int) -> None:
    """Move the atoms of all lanes from one frame to the next, in which all light changes evenly: leapfrog."""
    width_s, length_s = np.float32(2 / machine.static_waist**2), np.float32(1 / machine.static_rayleigh**2)
    width_m, length_m = np.float32(2 / machine.mobile_waist**2), np.float32(1 / machine.mobile_rayleigh**2)
    depth, dt = np.float32(machine.mobile_depth), np.float32(duration_s / n_steps)
    half = HALF_ * dt
    for step in range(n_steps):
        part = np.float32((step + 0.5) / n_steps)
        for i in range(LANES):
            x = lanes[X + i] + half * lanes[VX + i]
            y = lanes[Y + i] + half * lanes[VY + i]
            z = lanes[Z + i] + half * lanes[VZ + i]
            radial_s, axial_s = pull_fast(x, y, z, lanes[STATIC + i], width_s, length_s)
            right = x - lanes[AWAY_X + i] - part * lanes[WAY_X + i]
            up = y - lanes[AWAY_Y + i] - part * lanes[WAY_Y + i]
            row = lanes[ROW + i] + part * lanes[ROW_CHANGE + i]
            col = lanes[COL + i] + part * lanes[COL_CHANGE + i]
            radial_m, axial_m = pull_fast(right, up, z, depth * row * col, width_m, length_m)
            vx = lanes[VX + i] + dt * (radial_s * x + radial_m * right)
            vy = lanes[VY + i] + dt * (radial_s * y + radial_m * up)
            vz = lanes[VZ + i] + dt * (axial_s + axial_m) * z
            lanes[VX + i], lanes[VY + i], lanes[VZ + i] = vx, vy, vz
            lanes[X + i] = x + half * vx
            lanes[Y + i] = y + half * vy
            lanes[Z + i] = z + half * vz


WIDER = 2.2
"""Width of the proposed positions relative to a harmonic well's: covers a beam's weaker flanks."""
LONGER = 4.0
"""The same along the beam."""


@helper_kernel()
def draw_place(most: float, atom: Floats, rng: np.random.Generator) -> float:
    """Draw a position in units of waist and Rayleigh length; returns -U / kT there. See ``draw_atoms``."""
    across, along = WIDER / math.sqrt(4.0 * most), LONGER / math.sqrt(2.0 * most)
    while True:
        nx, ny, nz = rng.standard_normal(), rng.standard_normal(), rng.standard_normal()
        x, y, z = across * nx, across * ny, along * nz
        s = 1.0 + z * z
        a = most / s * math.exp(-2.0 * (x * x + y * y) / s)
        part = rng.random() / math.exp(a - most + 0.5 * (nx * nx + ny * ny + nz * nz))
        if part < 1.0 and part < math.erf(math.sqrt(a)) - 2.0 * math.sqrt(a / math.pi) * math.exp(-a):
            atom[0], atom[1], atom[2] = x, y, z
            return a


@helper_kernel()
def draw_atom(
    atom: Floats, depth: float, kt: float, waist: float, rayleigh: float, rng: np.random.Generator
) -> None:
    """Draw one atom at the origin, as :func:`draw_atoms` does; ``kt`` is per mass."""
    kt = min(kt, 0.5 * depth)
    bound = draw_place(depth / kt, atom, rng)
    atom[0], atom[1], atom[2] = waist * atom[0], waist * atom[1], rayleigh * atom[2]
    while True:
        vx, vy, vz = rng.standard_normal(), rng.standard_normal(), rng.standard_normal()
        if 0.5 * (vx * vx + vy * vy + vz * vz) < bound:
            fast = math.sqrt(kt)
            atom[3], atom[4], atom[5] = fast * vx, fast * vy, fast * vz
            return


@kernel(f"float64[:, ::1]({const('float64', 1)}, {const('float64', 1)}, float64, float64, npy_rng)")
def draw_atoms(depth: Floats, kt: Floats, waist: float, rayleigh: float, rng: np.random.Generator) -> Floats:
    """Draw atoms from the Boltzmann distribution in a Gaussian beam, restricted to bound atoms.

    Positions have the density ``exp(a) P(a)``, where ``a = -U / kT`` and
    ``P(a) = erf(sqrt(a)) - 2 sqrt(a / pi) exp(-a)`` is the fraction of the Maxwell distribution slow enough
    to be bound there. They are drawn by rejection from a wider Gaussian. This distribution is stationary;
    the harmonic one would breathe. In tweezers too shallow for the temperature, the temperature is half of
    the depth: hotter atoms have evaporated.

    Args:
        depth: Depth of each atom's tweezer per mass, (n_atoms,), above 0.
        kt: kT per mass of each atom.
        waist: 1/e^2 radius of the intensity.
        rayleigh: Rayleigh length.
        rng: Random numbers.

    Returns:
        Positions relative to the tweezers' foci, and velocities, (n_atoms, 6).
    """
    atoms = np.empty((len(depth), 6))
    for i in range(len(depth)):
        draw_atom(atoms[i], depth[i], kt[i], waist, rayleigh, rng)
    return atoms


@kernel(f"float64[::1](float64[:, ::1], {const('float64', 1)}, float64, float64, float64, float64)")
def ramp_atoms(
    state: Floats, depth: Floats, end: float, duration_s: float, waist: float, rayleigh: float
) -> Floats:
    """Move atoms while the depth of their static tweezers changes evenly.

    Args:
        state: The atoms, each relative to its tweezer (n_atoms, 6); changed in place.
        depth: Depth of each tweezer at the start (n_atoms,).
        end: Depth at the end over that at the start.
        duration_s: Duration of the ramp.
        waist: 1/e^2 radius of the intensity.
        rayleigh: Rayleigh length.

    Returns:
        Energies in the tweezers at the end (n_atoms,).
    """
    energy = np.empty(len(state))
    for i in range(len(state)):
        x, y, z, vx, vy, vz = state[i]
        period_s = math.pi * waist / math.sqrt(depth[i] * max(1.0, end))
        n_steps = math.ceil(16.0 * duration_s / period_s)
        dt = duration_s / max(n_steps, 1)
        for step in range(n_steps):
            x, y, z = x + 0.5 * dt * vx, y + 0.5 * dt * vy, z + 0.5 * dt * vz
            now = depth[i] * (1.0 + (end - 1.0) * (step + 0.5) / n_steps)
            ax, ay, az, _ = pull(x, y, z, now, waist, rayleigh)
            vx, vy, vz = vx + dt * ax, vy + dt * ay, vz + dt * az
            x, y, z = x + 0.5 * dt * vx, y + 0.5 * dt * vy, z + 0.5 * dt * vz
        state[i] = np.array([x, y, z, vx, vy, vz])
        energy[i] = energy_in(state[i], 0.0, 0.0, end * depth[i], waist, rayleigh)
    return energy


@helper_kernel()
def sites_of(x: float, y: float, plane: Floats) -> tuple[float, float]:
    """Row and column of a place, in sites."""
    x, y = x - plane[0, 0], y - plane[0, 1]
    return plane[3, 0] * x + plane[3, 1] * y, plane[4, 0] * x + plane[4, 1] * y


@helper_kernel()
def place_of(row: float, col: float, plane: Floats) -> tuple[float, float]:
    """Place of a row and column, in metres."""
    x = plane[0, 0] + row * plane[1, 0] + col * plane[2, 0]
    return x, plane[0, 1] + row * plane[1, 1] + col * plane[2, 1]


@helper_kernel()
def site_at(atom: Floats, plane: Floats, shape: tuple[int, int]) -> tuple[int, int, bool]:
    """Row and column of the site nearest to an atom, and whether the atom is in the grid."""
    at_row, at_col = sites_of(atom[0], atom[1], plane)
    row, col = round(at_row), round(at_col)
    inside = 0 <= row < shape[0] and 0 <= col < shape[1]
    return min(max(row, 0), shape[0] - 1), min(max(col, 0), shape[1] - 1), inside


@helper_kernel()
def nearest(tones: Floats, k: int, last: int, place: float, guess: int) -> int:
    """The track nearest to a place, in sites, at frame k or ``last``; -1 if none is on.

    ``guess`` is taken if it is so close that no other can be closer.
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
    flight: Flight, atom: Floats, rows: Floats, cols: Floats, k: int, last: int, plane: Floats, reach: float
) -> bool:
    """Find the mobile tweezer nearest to an atom between two frames; whether one is near."""
    row, col = sites_of(atom[0], atom[1], plane)
    flight.row = nearest(rows, k, last, row, flight.row)
    flight.col = nearest(cols, k, last, col, flight.col)
    if flight.row >= 0 and flight.col >= 0:
        for frame in (k, last):
            x, y = place_of(rows[flight.row, frame, PLACE], cols[flight.col, frame, PLACE], plane)
            if square(x - atom[0], y - atom[1]) < reach * reach:  # never for nan
                return True
    flight.row = flight.col = -1
    return False


@helper_kernel()
def relaxed(heat: float, elapsed_s: float, aim: float, machine: Machine) -> float:
    """Temperature after a time in a static tweezer: cooled, or heated by the noise of the intensity."""
    if machine.cooling_hz > 0.0:
        return aim + (heat - aim) * math.exp(-elapsed_s * machine.cooling_hz)
    return heat * math.exp(min(elapsed_s * machine.noise_hz, 20.0))


@helper_kernel()
def wake(
    flight: Flight, atom: Floats, row: int, col: int, site: Site, now_s: float, plane: Floats,
    machine: Machine, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Draw where the atom of a site is in its static tweezer, and how it moves, as a mobile tweezer comes."""
    level = math.sqrt(site.depth / machine.static_depth)
    flight.heat = relaxed(site.heat, max(0.0, now_s - site.since_s), machine.temperature / level, machine)
    waist, rayleigh = machine.static_waist, machine.static_rayleigh
    draw_atom(atom, site.depth, KELVIN * flight.heat * level, waist, rayleigh, rng)
    flight.energy = (energy_in(atom, 0.0, 0.0, site.depth, waist, rayleigh) + site.depth) / level
    x, y = place_of(row, col, plane)
    atom[0] += x
    atom[1] += y
    site.atom = False
    flight.fate, flight.row, flight.col = FLYING, -1, -1
    flight.from_row, flight.from_col, flight.to_row, flight.to_col = row, col, row, col
    flight.held_s = flight.lost_s = flight.lost_row = flight.lost_col = flight.offset = np.nan
    flight.depth = flight.glow_s = 0.0
    flight.until_s, flight.cut_s = -np.inf, np.inf


@helper_kernel()
def wake_around(
    row: float, col: float, flights: Records, state: Floats, n: int, awake: Ints, block: int, sites: Records,
    now_s: float, plane: Floats, machine: Machine, rng: np.random.Generator,
) -> int:  # fmt: skip
    """Wake the atoms on the sites around a mobile tweezer; returns the number of flights."""
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
    rows: Floats, cols: Floats, k: int, last: int, flights: Records, state: Floats, n: int, awake: Ints,
    sites: Records, now_s: float, plane: Floats, machine: Machine, rng: np.random.Generator,
) -> int:  # fmt: skip
    """Wake the atoms on all sites that mobile tweezers are near between two frames.

    Args:
        rows: The row tones.
        cols: The column tones.
        k: First frame.
        last: Last frame.
        flights: Room for the atoms of all sites, of which the first n fly or have settled.
        state: Likewise.
        n: Their number.
        awake: The last block in which a tweezer was near each site (n_rows, n_cols); changed in place.
        sites: The sites; changed in place: atoms that are woken leave them.
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
                if (frame == k > 0) or math.isnan(row) or math.isnan(col):  # frame k was the last one before
                    continue
                n = wake_around(row, col, flights, state, n, awake, last, sites, now_s, plane, machine, rng)
    return n


@helper_kernel()
def must_move(
    flight: Flight, atom: Floats, rows: Floats, cols: Floats, k: int, last: int, awake: Ints, sites: Records,
    plane: Floats, machine: Machine,
) -> bool:  # fmt: skip
    """Whether an atom must be integrated from frame k to ``last``; one that need not settles."""
    if flight.fate < FLYING or (flight.fate == SETTLED and awake[flight.to_row, flight.to_col] < last):
        return False
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
def set_tweezer(
    lanes: NDArray[np.float32], i: int, flight: Flight, rows: Floats, cols: Floats, k: int, x: float,
    y: float, plane: Floats,
) -> None:  # fmt: skip
    """Fill in the mobile tweezer of lane i from frame k to the next, relative to (x, y)."""
    if flight.row < 0:
        return  # its depth is 0
    row, col = rows[flight.row, k], cols[flight.col, k]
    lanes[ROW + i], lanes[ROW_CHANGE + i] = row[DEPTH], row[CHANGE]
    lanes[COL + i], lanes[COL_CHANGE + i] = col[DEPTH], col[CHANGE]
    if math.isnan(row[PLACE]) or math.isnan(col[PLACE]):
        return  # likewise
    at_x, at_y = place_of(row[PLACE], col[PLACE], plane)
    lanes[AWAY_X + i], lanes[AWAY_Y + i] = at_x - x, at_y - y
    lanes[WAY_X + i] = row[WAY] * plane[1, 0] + col[WAY] * plane[2, 0]
    lanes[WAY_Y + i] = row[WAY] * plane[1, 1] + col[WAY] * plane[2, 1]


@helper_kernel()
def move_some(
    lanes: NDArray[np.float32], origin: Floats, moving: Ints, state: Floats, flights: Records, rows: Floats,
    cols: Floats, k: int, last: int, n_steps: int, sites: Records, frame_s: float, plane: Floats,
    machine: Machine,
) -> None:  # fmt: skip
    """Move as many atoms as there are lanes, or fewer, from frame k to ``last``."""
    lanes[:] = ZERO
    for i in range(len(moving)):
        atom = state[moving[i]]
        row, col, _ = site_at(atom, plane, sites.shape)
        origin[i, 0], origin[i, 1] = place_of(row, col, plane)
        lanes[STATIC + i] = sites[row, col].depth
        lanes[X + i], lanes[Y + i], lanes[Z + i] = atom[0] - origin[i, 0], atom[1] - origin[i, 1], atom[2]
        lanes[VX + i], lanes[VY + i], lanes[VZ + i] = atom[3], atom[4], atom[5]
    for frame in range(k, last):
        for i in range(len(moving)):
            flight = flights[moving[i]]
            set_tweezer(lanes, i, flight, rows, cols, frame, origin[i, 0], origin[i, 1], plane)
        move(lanes, machine, frame_s, n_steps)
    for i in range(len(moving)):
        atom = state[moving[i]]
        atom[0], atom[1], atom[2] = origin[i, 0] + lanes[X + i], origin[i, 1] + lanes[Y + i], lanes[Z + i]
        atom[3], atom[4], atom[5] = lanes[VX + i], lanes[VY + i], lanes[VZ + i]


@helper_kernel()
def lose(flight: Flight, fate: int, atom: Floats, plane: Floats, t_s: float) -> None:
    """Record when, where and by what an atom was lost."""
    flight.fate, flight.lost_s = fate, t_s
    flight.lost_row, flight.lost_col = sites_of(atom[0], atom[1], plane)


@helper_kernel()
def fall_out(flight: Flight, atom: Floats, plane: Floats, shape: tuple[int, int], t_s: float) -> None:
    """Lose an atom that no tweezer binds, and say by what."""
    inside = site_at(atom, plane, shape)[2]
    fate = PROGRAM if flight.until_s > flight.cut_s - 1.5 * BLOCK_S else TRANSPORT
    lose(flight, fate if inside else EJECTED, atom, plane, t_s)


@helper_kernel()
def check_atom(
    flight: Flight, atom: Floats, rows: Floats, cols: Floats, k: int, sites: Records, t_s: float,
    lasted_s: float, plane: Floats, machine: Machine,
) -> None:  # fmt: skip
    """See what holds an atom at frame k; it is lost once it is unbound and far from everything."""
    row, col, _ = site_at(atom, plane, sites.shape)
    x, y = place_of(row, col, plane)
    depth, mobile, to_x, to_y = sites[row, col].depth, 0.0, 0.0, 0.0
    near = square(atom[0] - x, atom[1] - y) < (GONE * machine.static_waist) ** 2
    if flight.row >= 0:
        row_tone, col_tone = rows[flight.row, k - 1], cols[flight.col, k - 1]
        factor = (row_tone[DEPTH] + row_tone[CHANGE]) * (col_tone[DEPTH] + col_tone[CHANGE])
        if factor > 0.0:
            mobile = machine.mobile_depth * factor
            at_x, at_y = place_of(row_tone[PLACE] + row_tone[WAY], col_tone[PLACE] + col_tone[WAY], plane)
            to_x, to_y = atom[0] - at_x, atom[1] - at_y
            away = square(to_x, to_y)
            near = near or away < (GONE * machine.mobile_waist) ** 2
            if mobile > depth and away < machine.mobile_waist**2:
                record_hold(flight, math.sqrt(square(at_x - x, at_y - y)), mobile, t_s)
                flight.glow_s += lasted_s * mobile / machine.static_depth
    if near and abs(atom[2]) < HIGH * machine.mobile_rayleigh:
        return
    energy = energy_in(atom, x, y, depth, machine.static_waist, machine.static_rayleigh)
    energy += pull(to_x, to_y, atom[2], mobile, machine.mobile_waist, machine.mobile_rayleigh)[3]
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
    flight: Flight, atom: Floats, rows: Floats, row_faults: Ints, cols: Floats, col_faults: Ints, k: int,
    start_s: float, frame_s: float, plane: Floats,
) -> None:  # fmt: skip
    """Note when the tweezer that holds an atom at frame k is cut off; lose an atom whose tones mix.

    A tone may be cut off when the other one has gone down in a ramp: then the tweezer was off before.
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
    state: Floats, moving: Ints, flights: Records, plane: Floats, machine: Machine, t_s: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Of two moving atoms within a waist of each other, collisions in the light leave one or none."""
    for m in range(len(moving)):
        for n in range(m):
            i, j = moving[m], moving[n]
            x, y = state[i, 0] - state[j, 0], state[i, 1] - state[j, 1]
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
    """Way of the fastest tone from each frame to the next, in sites (n_frames,)."""
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
    """Steps from frame to frame; ``factor``: that of the depth of the deepest tweezer."""
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
    flight: Flight, atom: Floats, sites: Records, plane: Floats, machine: Machine, end_s: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Decide the fate of an atom that is left at the end: its nearest site keeps it, if it binds it."""
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
    flights: Records, state: Floats, sites: Records, plane: Floats, end_s: float, lost: Ints
) -> None:
    """Put the atoms on their sites, two on one are lost, and count the losses."""
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
COURSES, FAULTS, SHOT = const("float64", 3), const("int64", 2), f"{MACHINE}, {TABLE}, npy_rng, int64[::1]"


@helper_kernel(f"{FLIGHTS}({SITES}, {COURSES}, {FAULTS}, {COURSES}, {FAULTS}, float64, float64, {SHOT})")
def fly(
    sites: Records, rows: Floats, row_faults: Ints, cols: Floats, col_faults: Ints, start_s: float,
    frame_s: float, numbers: tuple[float, ...], plane: Floats, rng: np.random.Generator, lost: Ints,
) -> Records:  # fmt: skip
    """Move the atoms in the light of a batch.

    Between frames, positions and depths change evenly. An atom feels its nearest static tweezer and its
    nearest mobile one. One that its static tweezer binds is not moved while no mobile one is near.

    Args:
        sites: The sites and their atoms; changed in place.
        rows: The row tones.
        row_faults: Their faults, see ``CUT`` (n_row_tones, 2).
        cols: The column tones.
        col_faults: Their faults.
        start_s: Time of the first frame.
        frame_s: Time from frame to frame.
        numbers: The numbers of :class:`Machine`.
        plane: The plane of the sites.
        rng: Random numbers of the shot.
        lost: Number of atoms of each of ``FATES`` (6,); changed in place.

    Returns:
        What happened to the atoms that tweezers came near (n_atoms,).
    """
    machine = Machine(*numbers)
    flights: Records = np.empty(sites.size, FLIGHT)
    state, n = np.empty((sites.size, 6)), 0
    moving, lanes = np.empty(sites.size, np.int64), np.empty(LANES * N_NUMBERS, np.float32)
    origin, awake = np.empty((LANES, 2)), np.full(sites.shape, -1)
    ways, k, end_s = ways_of(rows, cols), 0, start_s
    n_steps = steps_of(machine, greatest(rows) * greatest(cols), frame_s)
    while k < len(ways) - 1:
        last, n_moving = end_of_block(k, ways, round(BLOCK_S / frame_s)), 0
        now_s, end_s = end_s, start_s + last * frame_s
        n = wake_atoms(rows, cols, k, last, flights, state, n, awake, sites, now_s, plane, machine, rng)
        for i in range(n):
            if must_move(flights[i], state[i], rows, cols, k, last, awake, sites, plane, machine):
                moving[n_moving] = i
                n_moving += 1
        for m in range(0, n_moving, LANES):
            some = moving[m : min(m + LANES, n_moving)]
            move_some(
                lanes,
                origin,
                some,
                state,
                flights,
                rows,
                cols,
                k,
                last,
                n_steps,
                sites,
                frame_s,
                plane,
                machine,
            )
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
    frame_s: float, numbers: tuple[float, ...], plane: Floats, rng: np.random.Generator, lost: Ints,
) -> Records:  # fmt: skip
    """Move the atoms in the light of tones: places (sites) and depth factors (n_tracks, n_frames)."""
    row_faults, col_faults = np.full((len(rows), 2), NEVER), np.full((len(cols), 2), NEVER)
    of_rows, of_cols = course_of(rows, row_depth), course_of(cols, col_depth)
    return fly(sites, of_rows, row_faults, of_cols, col_faults, start_s, frame_s, numbers, plane, rng, lost)


@kernel(
    f"void({SITES}, {TONES}, {OFFSETS}, {TONES}, {OFFSETS}, {const('float64', 1)}, {const('int8', 1)}, "
    f"int64, UniTuple(float64, 2), float64, float64, {SHOT})"
)
def fly_in_program(
    sites: Records, rows: Records, row_offsets: NDArray[np.int32], cols: Records,
    col_offsets: NDArray[np.int32], durations_s: Floats, courses: NDArray[np.int8], n_segments: int,
    step_hz: tuple[float, float], start_s: float, frame_s: float, numbers: tuple[float, ...], plane: Floats,
    rng: np.random.Generator, lost: Ints,
) -> None:  # fmt: skip
    """Move the atoms in the light of the first segments of a program, batch by batch.

    Args:
        sites: The sites and their atoms; changed in place.
        rows: The row tones of all segments (n_tones,).
        row_offsets: Where those of each segment begin.
        cols: The column tones.
        col_offsets: Likewise.
        durations_s: Durations of the segments.
        courses: Courses of their frequencies.
        n_segments: Number of segments that are played.
        step_hz: Difference of the frequencies of neighbouring rows, and columns.
        start_s: When the program starts.
        frame_s: Time from frame to frame.
        numbers: The numbers of :class:`Machine`.
        plane: The plane of the sites.
        rng: Random numbers of the shot.
        lost: Number of atoms of each of ``FATES`` (6,); changed in place.
    """
    for first, last in find_batches(rows, row_offsets, cols, col_offsets, n_segments):
        rows_now, row_faults = light_of_axis(
            rows, row_offsets, durations_s, courses, first, last, frame_s, step_hz[0]
        )
        cols_now, col_faults = light_of_axis(
            cols, col_offsets, durations_s, courses, first, last, frame_s, step_hz[1]
        )
        first_s = start_s + durations_s[:first].sum() - HALF * frame_s
        fly(sites, rows_now, row_faults, cols_now, col_faults, first_s, frame_s, numbers, plane, rng, lost)
