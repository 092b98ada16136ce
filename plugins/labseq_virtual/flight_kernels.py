"""Kernels that integrate the motion of atoms in the light of static and mobile tweezers.

Energies and depths are per mass, in m^2/s^2. Two arrays stand for several numbers:

- ``atom``: position (m) and velocity (m/s), (6,).
- ``plane``: position of site (0, 0), step from row to row, step from column to column, in m; then
  the inverse of the steps, so that ``plane[3:] @ (x, y)`` is in sites (5, 2).
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq_virtual.records import record, signature

Floats = NDArray[np.float64]
Records = Any
"""An array of records: numpy has no type for one that knows its columns."""

TABLE = const("float64", 2)
VECTOR = const("float64", 1)

NEAR = 3.5
"""Distance in waists beyond which a tweezer is neglected: there it has 2e-11 of its depth."""
GONE = 2.0
"""Distance in waists from every tweezer beyond which an unbound atom counts as lost (ours)."""
HIGH = 4.0
"""Distance from the plane in Rayleigh lengths beyond which an unbound atom counts as lost (ours)."""


class Beams(NamedTuple):
    """Waists and Rayleigh lengths of the static tweezers and of the mobile ones."""

    static_waist: float
    static_rayleigh: float
    mobile_waist: float
    mobile_rayleigh: float


class Site(NamedTuple):
    """The site nearest to an atom: its place in metres, and its depth."""

    x: float
    y: float
    depth: float


class Spot(NamedTuple):
    """A mobile tweezer from one frame to the next, in which all changes linearly.

    Attributes:
        x: Its place at the first frame.
        y: Likewise.
        way_x: Its displacement until the next one.
        way_y: Likewise.
        depth: Its depth if both tones have their intended power.
        row: Depth factor of its row tone.
        row_change: Its change until the next frame.
        col: Depth factor of its column tone.
        col_change: Its change.
    """

    x: float
    y: float
    way_x: float
    way_y: float
    depth: float
    row: float
    row_change: float
    col: float
    col_change: float


class Flight:
    """What is recorded of an atom; nan where it did not happen.

    Attributes:
        held_s: When a mobile tweezer first held it.
        offset: How far that tweezer was from the nearest site, in metres.
        depth: Greatest depth of the tweezer.
        lost_s: When the atom was lost.
        lost_row: Where, in sites.
        lost_col: Likewise.
        collided: Whether it collided, 1 or 0.
    """

    held_s: float
    offset: float
    depth: float
    lost_s: float
    lost_row: float
    lost_col: float
    collided: float


FLIGHT: Final = record(Flight)


def new_flights(n_atoms: int) -> Records:
    """Records of atoms of which nothing has happened yet (n_atoms,)."""
    return np.full((n_atoms, len(FLIGHT.names or ())), np.nan).view(FLIGHT)[:, 0]


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


@kernel(f"float64[::1]({TABLE}, {TABLE}, {VECTOR}, float64, float64)")
def energies(state: Floats, sites: Floats, depth: Floats, waist: float, rayleigh: float) -> Floats:
    """Energies of atoms (n_atoms, 6), each in its own beam at ``sites`` (n_atoms, 2), per mass."""
    found = np.empty(len(state))
    for i in range(len(state)):
        x, y, z, vx, vy, vz = state[i]
        energy = pull(x - sites[i, 0], y - sites[i, 1], z, depth[i], waist, rayleigh)[3]
        found[i] = energy + 0.5 * (vx * vx + vy * vy + vz * vz)
    return found


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
def nearest(tracks: Floats, k: int, place: float) -> int:
    """The tone nearest to a place, in sites, that is on at frame k or the next; -1 if none is."""
    best, least = -1, np.inf
    for j in range(tracks.shape[1]):
        for frame in (k, k + 1):
            away = abs(tracks[frame, j] - place)
            if away < least:  # never for nan
                best, least = j, away
    return best


@helper_kernel()
def course(tracks: Floats, depth: Floats, k: int, j: int) -> tuple[float, float, float, float]:
    """Place of a tone at frame k and its depth factor, and how they change until the next frame.

    A tone that is off at one of the two frames has depth 0 there, and does not move.
    """
    here, there = tracks[k, j], tracks[k + 1, j]
    first, last = depth[k, j], depth[k + 1, j]
    if math.isnan(here):
        here, first = there, 0.0
    if math.isnan(there):
        there, last = here, 0.0
    return here, there - here, first, last - first


@helper_kernel()
def find_spot(
    atom: Floats, rows: Floats, row_depth: Floats, cols: Floats, col_depth: Floats, k: int, plane: Floats,
    reach: float, depth: float,
) -> Spot:  # fmt: skip
    """The mobile tweezer nearest to an atom; of depth 0 if it stays beyond ``reach`` until the next frame."""
    dark = Spot(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    row, col = sites_of(atom[0], atom[1], plane)
    i, j = nearest(rows, k, row), nearest(cols, k, col)
    if i < 0 or j < 0:
        return dark
    row, down, row_factor, row_change = course(rows, row_depth, k, i)
    col, right, col_factor, col_change = course(cols, col_depth, k, j)
    x, y = place_of(row, col, plane)
    way_x, way_y = down * plane[1, 0] + right * plane[2, 0], down * plane[1, 1] + right * plane[2, 1]
    to_x, to_y = atom[0] - x, atom[1] - y
    if min(math.hypot(to_x, to_y), math.hypot(to_x - way_x, to_y - way_y)) >= reach:
        return dark
    return Spot(x, y, way_x, way_y, depth, row_factor, row_change, col_factor, col_change)


@helper_kernel()
def move(atom: Floats, site: Site, spot: Spot, beams: Beams, duration: float, n_steps: int) -> None:
    """Move an atom from one frame to the next, in a static tweezer and a mobile one: leapfrog."""
    x, y, z, vx, vy, vz = atom
    dt = duration / n_steps
    for step in range(n_steps):
        x += 0.5 * dt * vx
        y += 0.5 * dt * vy
        z += 0.5 * dt * vz
        part = (step + 0.5) / n_steps
        ax, ay, az, _ = pull(x - site.x, y - site.y, z, site.depth, beams.static_waist, beams.static_rayleigh)
        mobile = spot.depth * (spot.row + part * spot.row_change) * (spot.col + part * spot.col_change)
        if mobile > 0.0:
            away_x, away_y = x - spot.x - part * spot.way_x, y - spot.y - part * spot.way_y
            bx, by, bz, _ = pull(away_x, away_y, z, mobile, beams.mobile_waist, beams.mobile_rayleigh)
            ax, ay, az = ax + bx, ay + by, az + bz
        vx += dt * ax
        vy += dt * ay
        vz += dt * az
        x += 0.5 * dt * vx
        y += 0.5 * dt * vy
        z += 0.5 * dt * vz
    atom[0], atom[1], atom[2], atom[3], atom[4], atom[5] = x, y, z, vx, vy, vz


@helper_kernel()
def check_bound(
    atom: Floats, site: Site, spot: Spot, beams: Beams, flight: Flight, t_s: float
) -> tuple[bool, float]:
    """Whether an atom is still trapped at the end of a frame, and its energy; records when it is held.

    An unbound atom is lost once it is far from every tweezer or far from the plane.
    """
    x, y, z = atom[0] - site.x, atom[1] - site.y, atom[2]
    from_site = math.hypot(x, y)
    energy = pull(x, y, z, site.depth, beams.static_waist, beams.static_rayleigh)[3]
    energy += 0.5 * (atom[3] ** 2 + atom[4] ** 2 + atom[5] ** 2)
    near = from_site < GONE * beams.static_waist
    mobile = spot.depth * (spot.row + spot.row_change) * (spot.col + spot.col_change)
    if mobile > 0.0:
        x, y = atom[0] - spot.x - spot.way_x, atom[1] - spot.y - spot.way_y
        energy += pull(x, y, z, mobile, beams.mobile_waist, beams.mobile_rayleigh)[3]
        from_spot = math.hypot(x, y)
        near = near or from_spot < GONE * beams.mobile_waist
        if mobile > site.depth and from_spot < beams.mobile_waist:
            record_hold(site, spot, mobile, flight, t_s)
    return energy < 0.0 or (near and abs(z) < HIGH * beams.mobile_rayleigh), energy


@helper_kernel()
def record_hold(site: Site, spot: Spot, depth: float, flight: Flight, t_s: float) -> None:
    """Record that a mobile tweezer holds an atom."""
    if math.isnan(flight.held_s):
        flight.held_s, flight.depth = t_s, 0.0
        flight.offset = math.hypot(spot.x + spot.way_x - site.x, spot.y + spot.way_y - site.y)
    flight.depth = max(flight.depth, depth)


@helper_kernel()
def record_loss(atom: Floats, plane: Floats, flight: Flight, t_s: float, collided: float) -> None:
    """Record when and where an atom was lost, and whether in a collision."""
    flight.lost_s, flight.collided = t_s, collided
    flight.lost_row, flight.lost_col = sites_of(atom[0], atom[1], plane)


@helper_kernel()
def find_site(atom: Floats, plane: Floats, static_depth: Floats) -> Site:
    """The site nearest to an atom."""
    at_row, at_col = sites_of(atom[0], atom[1], plane)
    row = min(max(round(at_row), 0), static_depth.shape[0] - 1)
    col = min(max(round(at_col), 0), static_depth.shape[1] - 1)
    x, y = place_of(row, col, plane)
    return Site(x, y, static_depth[row, col])


@helper_kernel()
def collide(
    state: Floats, alive: NDArray[np.bool_], moving: NDArray[np.bool_], flights: Records, plane: Floats,
    within: float, luck: Floats, pair_survival: float, t_s: float,
) -> None:  # fmt: skip
    """Of two moving atoms that are closer than ``within``, collisions in the light leave one or none."""
    for i in range(len(alive)):
        for j in range(i):
            if not (moving[i] and moving[j] and alive[i] and alive[j]):
                continue
            if math.hypot(state[i, 0] - state[j, 0], state[i, 1] - state[j, 1]) < within:
                one_left = luck[i] < pair_survival
                alive[i], alive[j] = one_left and luck[j] < 0.5, one_left and luck[j] >= 0.5
                for atom in (i, j):
                    if not alive[atom]:
                        record_loss(state[atom], plane, flights[atom], t_s, 1.0)


@kernel(
    f"void(float64[:, ::1], boolean[::1], Array({signature(FLIGHT)}, 1, 'C'), {TABLE}, {TABLE}, {TABLE}, "
    f"{TABLE}, {VECTOR}, {TABLE}, float64, {TABLE}, {VECTOR}, int64, {VECTOR}, float64)"
)
def follow_atoms(
    state: Floats,
    alive: NDArray[np.bool_],
    flights: Records,
    rows: Floats,
    row_depth: Floats,
    cols: Floats,
    col_depth: Floats,
    t_s: Floats,
    static_depth: Floats,
    mobile_depth: float,
    plane: Floats,
    widths: Floats,
    n_steps: int,
    luck: Floats,
    pair_survival: float,
) -> None:
    """Follow every atom from the first frame to the last.

    Between frames, positions and depths change linearly. An atom feels its nearest static tweezer and its
    nearest mobile one. An atom bound by its static tweezer is not moved while no mobile one is near. Of two
    atoms that come within a waist of each other, collisions in the light leave one or none, at once.

    Args:
        state: The atoms, (n_atoms, 6); changed in place.
        alive: Which atoms are still trapped, (n_atoms,); changed in place.
        flights: A record of each atom, see :func:`new_flights`; changed in place.
        rows: Row tones, in sites (n_frames, n_tracks), nan where off.
        row_depth: Their depth factors, likewise.
        cols: Column tones, likewise.
        col_depth: Likewise.
        t_s: Times of the frames (n_frames,).
        static_depth: Depths of the static tweezers (n_rows, n_cols).
        mobile_depth: Depth of a mobile tweezer whose factors are 1.
        plane: The plane of the sites.
        widths: The numbers of :class:`Beams` (4,).
        n_steps: Integration steps from frame to frame.
        luck: A uniform random number for each atom (n_atoms,).
        pair_survival: Probability that one of two atoms is left.
    """
    beams = Beams(widths[0], widths[1], widths[2], widths[3])
    moving = np.zeros(len(alive), np.bool_)
    for k in range(len(t_s) - 1):
        for i in range(len(alive)):
            moving[i] = False
            if not alive[i]:
                continue
            atom, flight = state[i], flights[i]
            site = find_site(atom, plane, static_depth)
            spot = find_spot(
                atom, rows, row_depth, cols, col_depth, k, plane, NEAR * beams.mobile_waist, mobile_depth
            )
            if spot.depth == 0.0:
                there, energy = check_bound(atom, site, spot, beams, flight, t_s[k])
                if there and energy < 0.0:
                    continue
            moving[i] = True
            move(atom, site, spot, beams, t_s[k + 1] - t_s[k], n_steps)
            alive[i], _ = check_bound(atom, site, spot, beams, flight, t_s[k + 1])
            if not alive[i]:
                record_loss(atom, plane, flight, t_s[k + 1], 0.0)
        collide(state, alive, moving, flights, plane, beams.mobile_waist, luck, pair_survival, t_s[k + 1])
