"""Kernels that follow the motion of atoms in the light of all tweezers.

Energies and depths are per mass, in m^2/s^2. Some arrays stand for several numbers:

- ``atom``: position (m) and velocity (m/s), (6,).
- ``plane``: position of site (0, 0), step from row to row, step from column to column, in m; then
  the inverse of the steps, so that ``plane[3:] @ (x, y)`` is in sites (5, 2).
- ``beams``: waist and Rayleigh length of the static tweezers, then of the mobile ones (4,).
- ``tweezer``: position of a mobile tweezer, its way until the next frame, its depth and the
  rows' and columns' factors of the depth with their changes until then (9,).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel

Floats = NDArray[np.float64]

TABLE = const("float64", 2)
LIST = const("float64", 1)
OWN = "float64[::1]"

NEAR = 3.5
"""Waists from a tweezer beyond which an atom does not feel it: 2e-11 of its depth."""
GONE = 2.0
"""Waists from every tweezer beyond which an atom that nothing binds is lost."""
HIGH = 4.0
"""Rayleigh lengths from the plane beyond which an atom that nothing binds is lost."""

HELD_S, OFFSET, DEPTH, LOST_S, LOST_ROW, LOST_COL, PAIRED = range(7)
"""Columns of the diary: when a mobile tweezer first held the atom, and how far from the nearest site it
then was; its greatest depth; when and where (in sites) the atom was lost; whether with another."""
N_DIARY = 7


@kernel("UniTuple(float64, 4)(float64, float64, float64, float64, float64, float64)")
def pull(
    x: float, y: float, z: float, depth: float, waist: float, rayleigh: float
) -> tuple[float, float, float, float]:
    """Acceleration of an atom by a Gaussian beam along z, and its potential energy per mass.

    ``U = -depth / s exp(-2 r^2 / (waist^2 s))`` with ``s = 1 + (z / rayleigh)^2``
    (R. Grimm, M. Weidemueller, Y. Ovchinnikov, Adv. At. Mol. Opt. Phys. 42, 95, 2000).

    Args:
        x: Position beside the beam's axis, in metres.
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


@kernel(f"float64[::1]({TABLE}, {TABLE}, {LIST}, float64, float64)")
def energies(state: Floats, sites: Floats, depth: Floats, waist: float, rayleigh: float) -> Floats:
    """Energies of atoms (n_atoms, 6), each in a beam of its own at ``sites`` (n_atoms, 2), per mass."""
    found = np.empty(len(state))
    for i in range(len(state)):
        x, y, z, vx, vy, vz = state[i]
        energy = pull(x - sites[i, 0], y - sites[i, 1], z, depth[i], waist, rayleigh)[3]
        found[i] = energy + 0.5 * (vx * vx + vy * vy + vz * vz)
    return found


@kernel(f"Tuple((int64, float64))({TABLE}, int64, float64)")
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


@kernel(f"boolean({LIST}, {TABLE}, {TABLE}, {TABLE}, {TABLE}, int64, {TABLE}, float64, float64, {OWN})")
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


@kernel(f"void({OWN}, {LIST}, float64, {LIST}, {LIST}, float64, int64)")
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


@kernel(f"Tuple((boolean, float64))({LIST}, {LIST}, float64, {LIST}, {LIST}, {OWN}, float64)")
def judge(
    atom: Floats, site: Floats, depth: float, tweezer: Floats, beams: Floats, diary: Floats, t_s: float
) -> tuple[bool, float]:
    """Whether an atom is still there at the end of a frame, and its energy; notes who held it.

    Lost is whom nothing binds, once far from every tweezer or far above the plane.
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
            if math.isnan(diary[HELD_S]):
                diary[HELD_S], diary[DEPTH] = t_s, 0.0
                x, y = tweezer[0] + tweezer[2] - site[0], tweezer[1] + tweezer[3] - site[1]
                diary[OFFSET] = math.hypot(x, y)
            diary[DEPTH] = max(diary[DEPTH], mobile)
    return energy < 0.0 or (near and abs(z) < HIGH * beams[3]), energy


@kernel(f"void({LIST}, {TABLE}, {OWN}, float64, float64)")
def note_loss(atom: Floats, plane: Floats, diary: Floats, t_s: float, paired: float) -> None:
    """Write down when and where an atom was lost, and whether with another."""
    x, y = atom[0] - plane[0, 0], atom[1] - plane[0, 1]
    diary[LOST_S], diary[PAIRED] = t_s, paired
    diary[LOST_ROW] = plane[3, 0] * x + plane[3, 1] * y
    diary[LOST_COL] = plane[4, 0] * x + plane[4, 1] * y


@kernel(f"float64({LIST}, {TABLE}, {TABLE}, {OWN})")
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
    f"void(float64[:, ::1], boolean[::1], float64[:, ::1], {TABLE}, {TABLE}, {TABLE}, {TABLE}, {LIST}, "
    f"{TABLE}, float64, {TABLE}, {LIST}, int64)"
)
def follow_atoms(
    state: Floats,
    alive: NDArray[np.bool_],
    diary: Floats,
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
) -> None:
    """Follow every atom from the first frame to the last.

    Between frames places and depths go evenly. An atom feels its nearest static tweezer and its
    nearest mobile one. Where no mobile one is near, an atom that its static tweezer binds is left
    alone. Two atoms within a waist of each other are both lost.

    Args:
        state: The atoms, (n_atoms, 6); changed in place.
        alive: Which are still there, (n_atoms,); changed in place.
        diary: What happened to each, (n_atoms, N_DIARY); nan where nothing did.
        rows: Row tones, in sites (n_frames, n_tracks), nan where off.
        row_depth: Their factors of the depth, likewise.
        cols: Column tones, likewise.
        col_depth: Likewise.
        t_s: Times of the frames (n_frames,).
        static_depth: Depths of the static tweezers (n_rows, n_cols).
        mobile_depth: Depth of a mobile tweezer whose factors are 1.
        plane: The plane of the sites.
        beams: The beams.
        n_steps: Steps of the integration from frame to frame.
    """
    site, tweezer = np.empty(4), np.empty(9)
    awake = np.zeros(len(alive), np.bool_)
    for k in range(len(t_s) - 1):
        for i in range(len(alive)):
            awake[i] = False
            if not alive[i]:
                continue
            atom = state[i]
            depth = find_site(atom, plane, static_depth, site)
            near = find_tweezer(
                atom, rows, row_depth, cols, col_depth, k, plane, NEAR * beams[2], mobile_depth, tweezer
            )
            if not near:
                tweezer[4] = 0.0
                there, energy = judge(atom, site, depth, tweezer, beams, diary[i], t_s[k])
                if there and energy < 0.0:
                    continue
            awake[i] = True
            move(atom, site, depth, tweezer, beams, t_s[k + 1] - t_s[k], n_steps)
            alive[i], _ = judge(atom, site, depth, tweezer, beams, diary[i], t_s[k + 1])
            if not alive[i]:
                note_loss(atom, plane, diary[i], t_s[k + 1], 0.0)
        for i in range(len(alive)):
            for j in range(i):
                if not (awake[i] and awake[j] and alive[i] and alive[j]):
                    continue
                if math.hypot(state[i, 0] - state[j, 0], state[i, 1] - state[j, 1]) < beams[2]:
                    alive[i] = alive[j] = False
                    note_loss(state[i], plane, diary[i], t_s[k + 1], 1.0)
                    note_loss(state[j], plane, diary[j], t_s[k + 1], 1.0)


Ints = NDArray[np.int64]

POWER = const("float32", 2)
LINES = "float64[:, ::1]"
SPECTRA = const("complex64", 2)

YOUNG = 8
"""Frames that a track must have to count as old."""


@kernel(f"int64({POWER}, int64, float64, int64, int64[::1])")
def find_peaks(power: NDArray[np.float32], k: int, threshold: float, reach: int, found: Ints) -> int:
    """Find the peaks of spectrum k, each the greatest within ``reach`` bins, rising; returns how many."""
    n = 0
    for b in range(1, power.shape[1] - 1):
        here = power[k, b]
        if here < threshold or here < power[k, b - 1] or here <= power[k, b + 1]:
            continue
        if n > 0 and b - found[n - 1] < reach:  # one of the two is a shoulder of the other
            if here > power[k, found[n - 1]]:
                found[n - 1] = b
        elif n < len(found):
            found[n] = b
            n += 1
    return n


@kernel(f"Tuple(({LINES}, int64[::1]))({POWER}, float64, int64, int64, int64)")
def find_tones(
    power: NDArray[np.float32], threshold: float, apart: int, reach: int, most: int
) -> tuple[Floats, Ints]:
    """Find the tones in each spectrum: the centroids of the power around its peaks.

    The centroid of a chirp is its mean frequency in the window. To a tone belongs what is within
    ``reach`` bins of its peak, up to the middle between it and the next.

    Args:
        power: (n_frames, n_bins), squared magnitudes.
        threshold: Least power of a peak.
        apart: Least distance of two peaks, in bins.
        reach: Half the width of the part of a spectrum that belongs to a tone, in bins.
        most: Most tones in a spectrum; the ones beyond are left out.

    Returns:
        The tones in bins (n_frames, most), rising, and how many there are (n_frames,).
    """
    n_frames, n_bins = power.shape
    centroid = np.full((n_frames, most), np.nan)
    count = np.zeros(n_frames, np.int64)
    peak = np.zeros(most, np.int64)
    for k in range(n_frames):
        count[k] = find_peaks(power, k, threshold, apart, peak)
        for i in range(count[k]):
            low, high = max(peak[i] - reach, 0), min(peak[i] + reach + 1, n_bins)
            if i > 0:
                low = max(low, (peak[i - 1] + peak[i] + 1) // 2)
            if i + 1 < count[k]:
                high = min(high, (peak[i] + peak[i + 1] + 1) // 2)
            total, moment = 0.0, 0.0
            for b in range(low, high):
                total += power[k, b]
                moment += power[k, b] * b
            centroid[k, i] = moment / total
    return centroid, count


@kernel(f"Tuple(({LINES}, int64))({LINES}, int64[::1], float64)")
def link_tones(centroid: Floats, count: Ints, slew: float) -> tuple[Floats, int]:
    """Follow tones from frame to frame, each to where its last two places point.

    A tone that jumps may look like two for a moment: the older track goes on.

    Args:
        centroid: Tones of each frame, rising, in bins (n_frames, most).
        count: How many there are in each frame.
        slew: Most bins that a tone is from where it was expected.

    Returns:
        Tracks in bins (n_frames, n_columns), nan where off, and how many columns are used. A
        column may hold several tones one after the other, with a frame of nan between them.
    """
    n_frames, most = centroid.shape
    tracks = np.full((n_frames, 2 * most), np.nan)
    since = np.zeros(2 * most, np.int64)
    used = 0
    for k in range(n_frames):
        for i in range(count[k]):
            best, least = -1, slew
            for column in range(used if k > 0 else 0):
                place = tracks[k - 1, column]
                if math.isnan(place) or not math.isnan(tracks[k, column]):
                    continue
                if k - since[column] > 1:
                    place += place - tracks[k - 2, column]
                away = abs(centroid[k, i] - place)
                if k - since[column] < YOUNG:
                    away += slew / 2
                if away < least:
                    best, least = column, away
            for column in range(2 * most if best < 0 else 0):
                if math.isnan(tracks[k, column]) and (k == 0 or math.isnan(tracks[k - 1, column])):
                    best, since[column] = column, k
                    break
            if best >= 0:
                tracks[k, best] = centroid[k, i]
                used = max(used, best + 1)
    return tracks, used


@kernel(f"Tuple(({LINES}, {LINES}))({SPECTRA}, {LINES}, int64, int64, float64, float64)")
def measure_tones(
    spectra: NDArray[np.complex64], tracks: Floats, first: int, reach: int, width: float, hop: float
) -> tuple[Floats, Floats]:
    """Amplitude and phase of followed tones: their overlap with a tone that chirps as they do.

    A tone of amplitude 1 and phase 0 in the middle of the window ``exp(-(n / tau)^2)``, with a
    chirp of c bins per frame, has the spectrum ``sqrt(pi / p) exp(-pi^2 f^2 / p)`` with
    ``p = 1 / tau^2 - i pi c``. The overlap of the measured spectrum with this one is the mean of the
    amplitude in the squared window. A tone ends in the middle between it and the next.

    Args:
        spectra: (n_frames, n_bins), phases as of the middle of the frames.
        tracks: (at least first + n_frames, n_tracks), in bins.
        first: Which frame of the tracks the first spectrum is.
        reach: Half the width of a tone's part of a spectrum, in bins.
        width: The window's tau times the width of a bin: a number without a unit.
        hop: From frame to frame, in units of one over the width of a bin.

    Returns:
        Amplitude and phase (rad) of each tone, (n_frames, n_tracks), nan where off. The
        amplitude is that of a window of sum 1.
    """
    n_frames, n_bins = spectra.shape
    n_tracks = tracks.shape[1]
    amplitude = np.full((n_frames, n_tracks), np.nan)
    phase = np.full((n_frames, n_tracks), np.nan)
    for k in range(n_frames):
        for j in range(n_tracks):
            at = first + k
            here = tracks[at, j]
            if math.isnan(here):
                continue
            before = tracks[at - 1, j] if at > 0 else np.nan
            after = tracks[at + 1, j] if at + 1 < len(tracks) else np.nan
            chirp = 0.0
            if not math.isnan(before) and not math.isnan(after):
                chirp = (after - before) / (2 * hop)
            p = 1.0 / width**2 - 1j * math.pi * chirp
            scale = np.sqrt(1.0 / (width**2 * p))
            product, norm = 0j, 0.0
            low, high = max(here - reach, 0.0), min(here + reach, n_bins - 1.0)
            for other in tracks[at]:
                if other < here:
                    low = max(low, (here + other) / 2)
                elif other > here:
                    high = min(high, (here + other) / 2)
            for b in range(math.ceil(low), math.floor(high) + 1):
                shape = scale * np.exp(-((math.pi * (b - here)) ** 2) / p)
                product += spectra[k, b] * np.conj(shape)
                norm += shape.real**2 + shape.imag**2
            value = product / norm
            amplitude[k, j] = abs(value)
            phase[k, j] = math.atan2(value.imag, value.real)
    return amplitude, phase
