"""Kernels that integrate the motion of atoms in the light of static and mobile tweezers.

Energies and depths are per mass, in m^2/s^2. Some arrays stand for several numbers:

- ``atom``: position (m) and velocity (m/s), (6,).
- ``plane``: position of site (0, 0), step from row to row, step from column to column, in m; then
  the inverse of the steps, so that ``plane[3:] @ (x, y)`` is in sites (5, 2).
- ``beams``: waist and Rayleigh length of the static tweezers, then of the mobile ones (4,).
- ``tweezer``: position of a mobile tweezer, its displacement until the next frame, its depth, and the
  depth factors of its row and column tones, each with its change until then (9,).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel

Floats = NDArray[np.float64]

TABLE = const("float64", 2)
VECTOR = const("float64", 1)
OUTPUT = "float64[::1]"

NEAR = 3.5
"""Distance in waists beyond which a tweezer is neglected: there it has 2e-11 of its depth."""
GONE = 2.0
"""Distance in waists from every tweezer beyond which an unbound atom counts as lost (ours)."""
HIGH = 4.0
"""Distance from the plane in Rayleigh lengths beyond which an unbound atom counts as lost (ours)."""

HELD_S, OFFSET, DEPTH, LOST_S, LOST_ROW, LOST_COL, COLLIDED = range(7)
"""Columns of an atom's record: when a mobile tweezer first held it, and how far that tweezer was from the
nearest site; the tweezer's greatest depth; when and where (in sites) the atom was lost; whether it
collided."""
N_COLUMNS = 7


@helper_kernel("UniTuple(float64, 4)(float64, float64, float64, float64, float64, float64)")
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


@helper_kernel(f"Tuple((int64, float64))({TABLE}, int64, float64)")
def nearest(tracks: Floats, k: int, place: float) -> tuple[int, float]:
    """The tone nearest to a place, in sites, that is on at frame k or the next, and its distance."""
    best, least = -1, np.inf
    for j in range(tracks.shape[1]):
        for frame in (k, k + 1):
            away = abs(tracks[frame, j] - place)
            if away < least:  # never for nan
                best, least = j, away
    return best, least


@kernel(f"UniTuple(float64, 4)({TABLE}, {TABLE}, int64, int64)")
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


@helper_kernel(
    f"boolean({VECTOR}, {TABLE}, {TABLE}, {TABLE}, {TABLE}, int64, {TABLE}, float64, float64, {OUTPUT})"
)
def find_tweezer(
    atom: Floats,
    rows: Floats,
    row_depth: Floats,
    cols: Floats,
    col_depth: Floats,
    k: int,
    plane: Floats,
    reach: float,
    depth: float,
    tweezer: Floats,
) -> bool:
    """Find the mobile tweezer nearest to an atom; whether it comes within ``reach`` until the next frame."""
    x, y = atom[0] - plane[0, 0], atom[1] - plane[0, 1]
    i, _ = nearest(rows, k, plane[3, 0] * x + plane[3, 1] * y)
    j, _ = nearest(cols, k, plane[4, 0] * x + plane[4, 1] * y)
    tweezer[:] = 0.0
    if i < 0 or j < 0:
        return False
    row, down, tweezer[5], tweezer[6] = course(rows, row_depth, k, i)
    col, right, tweezer[7], tweezer[8] = course(cols, col_depth, k, j)
    for axis in range(2):
        tweezer[axis] = plane[0, axis] + row * plane[1, axis] + col * plane[2, axis]
        tweezer[2 + axis] = down * plane[1, axis] + right * plane[2, axis]
    tweezer[4] = depth
    x, y = atom[0] - tweezer[0], atom[1] - tweezer[1]
    return min(math.hypot(x, y), math.hypot(x - tweezer[2], y - tweezer[3])) < reach


@helper_kernel(f"void({OUTPUT}, {VECTOR}, float64, {VECTOR}, {VECTOR}, float64, int64)")
def move(
    atom: Floats, site: Floats, depth: float, tweezer: Floats, beams: Floats, duration: float, n_steps: int
) -> None:
    """Move an atom for a while, in a static tweezer at ``site`` and a mobile one: leapfrog."""
    x, y, z, vx, vy, vz = atom
    dt = duration / n_steps
    for step in range(n_steps):
        x += 0.5 * dt * vx
        y += 0.5 * dt * vy
        z += 0.5 * dt * vz
        part = (step + 0.5) / n_steps
        ax, ay, az, _ = pull(x - site[0], y - site[1], z, depth, beams[0], beams[1])
        mobile = tweezer[4] * (tweezer[5] + part * tweezer[6]) * (tweezer[7] + part * tweezer[8])
        if mobile > 0.0:
            away_x, away_y = x - tweezer[0] - part * tweezer[2], y - tweezer[1] - part * tweezer[3]
            bx, by, bz, _ = pull(away_x, away_y, z, mobile, beams[2], beams[3])
            ax, ay, az = ax + bx, ay + by, az + bz
        vx += dt * ax
        vy += dt * ay
        vz += dt * az
        x += 0.5 * dt * vx
        y += 0.5 * dt * vy
        z += 0.5 * dt * vz
    atom[0], atom[1], atom[2], atom[3], atom[4], atom[5] = x, y, z, vx, vy, vz


@helper_kernel(
    f"Tuple((boolean, float64))({VECTOR}, {VECTOR}, float64, {VECTOR}, {VECTOR}, {OUTPUT}, float64)"
)
def check_bound(
    atom: Floats, site: Floats, depth: float, tweezer: Floats, beams: Floats, record: Floats, t_s: float
) -> tuple[bool, float]:
    """Whether an atom is still trapped at the end of a frame, and its energy; records when it is held.

    An unbound atom is lost once it is far from every tweezer or far from the plane.
    """
    x, y, z = atom[0] - site[0], atom[1] - site[1], atom[2]
    from_site = math.hypot(x, y)
    energy = pull(x, y, z, depth, beams[0], beams[1])[3]
    energy += 0.5 * (atom[3] ** 2 + atom[4] ** 2 + atom[5] ** 2)
    mobile = tweezer[4] * (tweezer[5] + tweezer[6]) * (tweezer[7] + tweezer[8])
    if mobile <= 0.0:
        near = from_site < GONE * beams[0]
    else:
        x, y = atom[0] - tweezer[0] - tweezer[2], atom[1] - tweezer[1] - tweezer[3]
        energy += pull(x, y, z, mobile, beams[2], beams[3])[3]
        from_tweezer = math.hypot(x, y)
        near = from_site < GONE * beams[0] or from_tweezer < GONE * beams[2]
        if mobile > depth and from_tweezer < beams[2]:
            if math.isnan(record[HELD_S]):
                record[HELD_S], record[DEPTH] = t_s, 0.0
                x, y = tweezer[0] + tweezer[2] - site[0], tweezer[1] + tweezer[3] - site[1]
                record[OFFSET] = math.hypot(x, y)
            record[DEPTH] = max(record[DEPTH], mobile)
    return energy < 0.0 or (near and abs(z) < HIGH * beams[3]), energy


@helper_kernel(f"void({VECTOR}, {TABLE}, {OUTPUT}, float64, float64)")
def record_loss(atom: Floats, plane: Floats, record: Floats, t_s: float, collided: float) -> None:
    """Record when and where an atom was lost, and whether in a collision."""
    x, y = atom[0] - plane[0, 0], atom[1] - plane[0, 1]
    record[LOST_S], record[COLLIDED] = t_s, collided
    record[LOST_ROW] = plane[3, 0] * x + plane[3, 1] * y
    record[LOST_COL] = plane[4, 0] * x + plane[4, 1] * y


@helper_kernel(f"float64({VECTOR}, {TABLE}, {TABLE}, {OUTPUT})")
def find_site(atom: Floats, plane: Floats, static_depth: Floats, site: Floats) -> float:
    """Find the site nearest to an atom: its position, row and column; returns its depth."""
    x, y = atom[0] - plane[0, 0], atom[1] - plane[0, 1]
    row = min(max(round(plane[3, 0] * x + plane[3, 1] * y), 0), static_depth.shape[0] - 1)
    col = min(max(round(plane[4, 0] * x + plane[4, 1] * y), 0), static_depth.shape[1] - 1)
    for axis in range(2):
        site[axis] = plane[0, axis] + row * plane[1, axis] + col * plane[2, axis]
    site[2], site[3] = row, col
    return float(static_depth[row, col])


@kernel(
    f"void(float64[:, ::1], boolean[::1], float64[:, ::1], {TABLE}, {TABLE}, {TABLE}, {TABLE}, {VECTOR}, "
    f"{TABLE}, float64, {TABLE}, {VECTOR}, int64, {VECTOR}, float64)"
)
def follow_atoms(
    state: Floats,
    alive: NDArray[np.bool_],
    record: Floats,
    rows: Floats,
    row_depth: Floats,
    cols: Floats,
    col_depth: Floats,
    t_s: Floats,
    static_depth: Floats,
    mobile_depth: float,
    plane: Floats,
    beams: Floats,
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
        record: A record of each atom, (n_atoms, N_COLUMNS), nan at the start; changed in place.
        rows: Row tones, in sites (n_frames, n_tracks), nan where off.
        row_depth: Their depth factors, likewise.
        cols: Column tones, likewise.
        col_depth: Likewise.
        t_s: Times of the frames (n_frames,).
        static_depth: Depths of the static tweezers (n_rows, n_cols).
        mobile_depth: Depth of a mobile tweezer whose factors are 1.
        plane: The plane of the sites.
        beams: The beams.
        n_steps: Integration steps from frame to frame.
        luck: A uniform random number for each atom (n_atoms,).
        pair_survival: Probability that one of two atoms is left.
    """
    site, tweezer = np.empty(4), np.empty(9)
    moving = np.zeros(len(alive), np.bool_)
    for k in range(len(t_s) - 1):
        for i in range(len(alive)):
            moving[i] = False
            if not alive[i]:
                continue
            atom = state[i]
            depth = find_site(atom, plane, static_depth, site)
            near = find_tweezer(
                atom, rows, row_depth, cols, col_depth, k, plane, NEAR * beams[2], mobile_depth, tweezer
            )
            if not near:
                tweezer[4] = 0.0
                there, energy = check_bound(atom, site, depth, tweezer, beams, record[i], t_s[k])
                if there and energy < 0.0:
                    continue
            moving[i] = True
            move(atom, site, depth, tweezer, beams, t_s[k + 1] - t_s[k], n_steps)
            alive[i], _ = check_bound(atom, site, depth, tweezer, beams, record[i], t_s[k + 1])
            if not alive[i]:
                record_loss(atom, plane, record[i], t_s[k + 1], 0.0)
        for i in range(len(alive)):
            for j in range(i):
                if not (moving[i] and moving[j] and alive[i] and alive[j]):
                    continue
                if math.hypot(state[i, 0] - state[j, 0], state[i, 1] - state[j, 1]) < beams[2]:
                    one_left = luck[i] < pair_survival
                    alive[i], alive[j] = one_left and luck[j] < 0.5, one_left and luck[j] >= 0.5
                    if not alive[i]:
                        record_loss(state[i], plane, record[i], t_s[k + 1], 1.0)
                    if not alive[j]:
                        record_loss(state[j], plane, record[j], t_s[k + 1], 1.0)
