"""Transport of atoms by the light of a played RF output: drawing atoms, and moving them.

Energies and depths inside are per mass of the atom, in m^2/s^2.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import MotionSpec, SiteGrid
from labseq_virtual.atoms import Atoms
from labseq_virtual.handover import KELVIN, full_volts, pair_survival
from labseq_virtual.jumps import JUMPS, find_jumps
from labseq_virtual.rf_analysis import (
    WINDOW,
    RfPulse,
    Tracks,
    bands,
    check_resolvable,
    forget_transforms,
    reach_hz,
    track_tones,
)
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.tone_positions import TonePositions

Floats = NDArray[np.float64]

WIDER: Final = np.array([2.2, 2.2, 4.0])
"""Width of the proposed positions relative to a harmonic well's, (x, y, z): covers a beam's weaker flanks."""
PROPOSALS: Final = 32
"""Proposals drawn at once for each atom still to be placed; about one in twenty is accepted."""


def draw_atoms(
    depth: Floats, temperature: float | Floats, waist: float, rayleigh: float, rng: np.random.Generator
) -> Floats:
    """Draw atoms from the Boltzmann distribution in a Gaussian beam, restricted to bound atoms.

    Positions have the density ``exp(a) P(a)``, where ``a = -U / kT`` and
    ``P(a) = erf(sqrt(a)) - 2 sqrt(a / pi) exp(-a)`` is the fraction of the Maxwell distribution slow enough
    to be bound there. They are drawn by rejection from a wider Gaussian. This distribution is stationary;
    the harmonic one would breathe. In tweezers too shallow for the temperature, the temperature is half of
    the depth: hotter atoms have evaporated.

    Args:
        depth: Depth of each atom's tweezer per mass, (n_atoms,), above 0.
        temperature: kT per mass, of all or of each atom.
        waist: 1/e^2 radius of the intensity.
        rayleigh: Rayleigh length.
        rng: Random numbers.

    Returns:
        Positions relative to the tweezers' foci, and velocities, (n_atoms, 6).
    """
    from scipy.special import erf

    kt = np.minimum(temperature, depth / 2)
    most = depth / kt
    size = np.array([waist, waist, rayleigh])
    spread = WIDER / np.sqrt(np.array([4.0, 4.0, 2.0]) * most[:, None])
    atoms = np.empty((len(depth), 6))
    bound = np.zeros(len(depth))
    remaining = np.arange(len(depth))
    while len(remaining):
        normal = rng.standard_normal((len(remaining), PROPOSALS, 3))
        place = normal * spread[remaining, None]
        s = 1.0 + place[..., 2] ** 2
        a = most[remaining, None] / s * np.exp(-2 * (place[..., 0] ** 2 + place[..., 1] ** 2) / s)
        slow = erf(np.sqrt(a)) - 2 * np.sqrt(a / np.pi) * np.exp(-a)
        weight = np.exp(a - most[remaining, None] + 0.5 * (normal**2).sum(axis=-1)) * slow
        is_accepted = rng.random(weight.shape) < weight
        first = is_accepted.argmax(axis=1)
        is_placed = is_accepted[np.arange(len(remaining)), first]
        atoms[remaining[is_placed], :3] = place[is_placed, first[is_placed]] * size
        bound[remaining[is_placed]] = a[is_placed, first[is_placed]]
        remaining = remaining[~is_placed]
    remaining = np.arange(len(depth))
    while len(remaining):
        velocity = rng.standard_normal((len(remaining), 3))
        slow = 0.5 * (velocity**2).sum(axis=1) < bound[remaining]
        atoms[remaining[slow], 3:] = np.sqrt(kt[remaining[slow], None]) * velocity[slow]
        remaining = remaining[~slow]
    return atoms


Mask = NDArray[np.bool_]

STEP_S: Final = 0.1e-6
"""Step of the integration, in seconds: a seventieth of a period in a tweezer of 2.1 mK."""
DARK: Final = 0.1
"""Fraction of the full depth below which the tweezers of a batch have let go of their atoms (ours)."""
MIN_TONE_DEPTH: Final = 2e-3
"""Fraction of the full depth below which a tone counts as off (ours)."""
SLEW_HZ: Final = 4e6
"""Largest deviation of a tone from its extrapolated frequency in a transit time (ours: 1100 um/ms at
1.6 MHz per site)."""

FLIGHTS: Final = np.dtype(
    [
        ("held_s", np.float64),
        ("from_row", np.int16),
        ("from_col", np.int16),
        ("to_row", np.int16),
        ("to_col", np.int16),
        ("offset_m", np.float32),
        ("depth_K", np.float32),
        ("fate", "S9"),
        ("lost_s", np.float64),
        ("lost_row", np.float32),
        ("lost_col", np.float32),
    ],
    metadata={
        "descriptions": {
            "held_s": "when a mobile tweezer first held the atom, from the start of the shot; nan: never",
            "from_row": "row of its site before",
            "from_col": "column of its site before",
            "to_row": "row of the site that it came to, if it was kept",
            "to_col": "column of the site that it came to, if it was kept",
            "offset_m": "how far the tweezer was from the site when it first held the atom",
            "depth_K": "greatest depth of the tweezer",
            "fate": "kept, or the cause of the loss: ejected, collision, transport or hand_over",
            "lost_s": "when it was lost, from the start of the shot; nan: never",
            "lost_row": "row where it was lost, in sites",
            "lost_col": "column where it was lost, in sites",
        }
    },
)
"""The path of an atom that a mobile tweezer held, or that was lost: "ejected" beyond the grid, in a
"collision" with another, fallen out of its tweezer in "transport", or by the transport loss, "hand_over"."""


class RfTransport:
    """Moves atoms in the light of what the mobile tweezers' outputs played."""

    def __init__(
        self,
        grid: SiteGrid,
        motion: MotionSpec,
        settings: SimulationSettings,
        positions: TonePositions | None = None,
    ) -> None:
        light = settings.mobile_light
        self._grid, self._motion, self._settings, self._light = grid, motion, settings, light
        self._positions = positions or TonePositions(grid, light)
        self._full_v = full_volts(grid, motion)
        self._bands = bands(grid)
        axes_hz = grid.row_frequency_hz, grid.column_frequency_hz
        self.reach_hz = [reach_hz(hz, motion.eject_slots) for hz in axes_hz]
        a1, a2 = grid.axes
        inverse = np.linalg.inv(np.stack([a2, a1], axis=1))
        self._plane = np.ascontiguousarray(np.vstack([grid.positions_m[0, 0], a2, a1, inverse]))
        waists = settings.static_waist, light.waist
        rayleigh = [
            math.pi * w**2 / wavelength
            for w, wavelength in zip(waists, (settings.static_wavelength, light.wavelength), strict=True)
        ]
        self._beams = np.array([waists[0], rayleigh[0], waists[1], rayleigh[1]])
        self.margin_s = (WINDOW + 0.5) * light.transit_time
        self._flights: list[NDArray[Any]] = []
        self._jumps: list[tuple[Any, ...]] = []

    def check_resolvable(self) -> None:
        """Check that :func:`labseq_virtual.rf_analysis.track_tones` can resolve the tones of the sites.

        Raises:
            LimitError: They are too close, or move too fast, for the transit time of the sound.
        """
        check_resolvable(self._grid, self._motion, self._light.transit_time)

    def begin_shot(self) -> None:
        """Forget the flights of the last shot."""
        self._flights, self._jumps = [], []

    def tables(self, since_s: float) -> dict[str, NDArray[Any]]:
        """Tables "flights" and "jumps" of this shot, with times counted from ``since_s``."""
        flights = np.concatenate([np.empty(0, FLIGHTS), *self._flights])
        jumps = np.array(sorted(self._jumps, key=lambda jump: jump[0]), JUMPS)
        for name in ("held_s", "lost_s"):
            flights[name] -= since_s
        jumps["t_s"] -= since_s
        return {"flights": flights.view(FLIGHTS), "jumps": jumps.view(JUMPS)}  # with their descriptions

    def carry(
        self,
        atoms: Atoms,
        pulse: RfPulse,
        depth: Floats,
        rng: np.random.Generator,
        loss_factor: float,
        relax: Callable[[Floats, Floats], Floats] = lambda heat, _elapsed_s: heat,
        pairs: float | None = None,
    ) -> Counter[str]:
        """Move the atoms in the light of a pulse.

        Args:
            atoms: The atoms; changed in place.
            pulse: The output that was played.
            depth: float64 (n_rows, n_cols), depths of the static tweezers relative to the nominal one.
            rng: Random numbers of the shot.
            loss_factor: The shot's factor on the transport loss.
            relax: Temperatures after a time without moves, in s.
            pairs: Probability that one of two atoms that meet is left. By default that of the settings.

        Returns:
            Number of atoms lost by each cause: hand_over, transport, collision, ejected.
        """
        lost: Counter[str] = Counter()
        pairs = pair_survival(self._settings) if pairs is None else pairs
        for tones, t_s in self.find_tones(pulse):
            bright = np.flatnonzero(_light([tones[1], tones[3]]) > DARK)
            on_s, off_s = t_s[bright[[0, -1]]] if len(bright) else t_s[[0, -1]]
            atoms.heat = relax(atoms.heat, np.maximum(0.0, on_s - atoms.since_s))
            atoms.since_s[...] = on_s
            lost += self._carry_batch(atoms, tones, t_s, depth, rng, loss_factor, off_s, pairs)
        return lost

    def _carry_batch(
        self,
        atoms: Atoms,
        tones: tuple[Floats, ...],
        t_s: Floats,
        depth: Floats,
        rng: np.random.Generator,
        loss_factor: float,
        off_s: float,
        pairs: float,
    ) -> Counter[str]:
        from labseq_virtual.flight_kernels import follow_atoms, new_flights

        rows, row_depth, cols, col_depth = tones
        row, col = np.nonzero(atoms.occupied & self._near(rows, cols) & (depth > 0))
        static = KELVIN * self._settings.static_depth * np.ascontiguousarray(depth)
        kt = KELVIN * atoms.heat[row, col] * np.sqrt(depth[row, col])
        state = draw_atoms(static[row, col], kt, self._beams[0], self._beams[1], rng)
        state[:, :2] += self._grid.positions_m[row, col]
        alive = np.ones(len(row), np.bool_)
        record = new_flights(len(row))
        n_steps = math.ceil((t_s[1] - t_s[0]) / STEP_S)
        full = KELVIN * self._light.depth
        luck = rng.spawn(1)[0].random(len(row))
        follow_atoms(
            state, alive, record, rows, row_depth, cols, col_depth, t_s,
            static, full, self._plane, self._beams, n_steps, luck, pairs,
        )  # fmt: skip
        to_row, to_col, energy = self._arrivals(state, static)
        bound = energy < 0
        held = ~np.isnan(record["held_s"])
        flights = np.zeros(len(row), FLIGHTS)
        flights["offset_m"], flights["depth_K"] = record["offset"], record["depth"] / KELVIN
        for name in ("held_s", "lost_s", "lost_row", "lost_col"):
            flights[name] = record[name]
        flights["from_row"], flights["from_col"] = row, col
        flights["to_row"], flights["to_col"] = to_row, to_col
        n_tones = max(0, _max_on(rows) + _max_on(cols) - 2)
        loss = self._settings.transport_loss + n_tones * self._settings.transport_loss_per_tone
        unlucky = held & (rng.random(len(row)) < loss * loss_factor)
        self._assign_fates(flights, alive, record["collided"] == 1, bound, unlucky, float(t_s[-1]))
        kept = flights["fate"] == b"kept"
        atoms.occupied[row, col] = False
        atoms.occupied[to_row[kept], to_col[kept]] = True
        moved = kept & held
        at = to_row[moved], to_col[moved]
        atoms.heat[at] = (energy[moved] + static[at]) / 3 / KELVIN / np.sqrt(depth[at])
        atoms.since_s[at] = off_s
        self._flights.append(flights[held | ~kept])
        return Counter(fate.decode() for fate in flights["fate"][~kept].tolist())

    def find_tones(self, pulse: RfPulse) -> Iterator[tuple[tuple[Floats, ...], Floats]]:
        """Positions (in sites) and depth factors of row and column tones, and the times of the frames.

        Those of one batch after the other: batches without a pause are separated by the dark between them.
        """
        tracks_of_axes: list[Tracks] = []
        for axis, spans in enumerate((pulse.rows, pulse.columns)):
            if not spans:
                return
            start_s, end_s = pulse.start_s - self.margin_s, pulse.end_s + 2 * self.margin_s
            min_v = float(self._full_v[axis].min()) * math.sqrt(MIN_TONE_DEPTH)
            transit_s = self._light.transit_time
            tracks_of_axes.append(
                track_tones(spans, start_s, end_s, self._bands[axis], transit_s, min_v, SLEW_HZ)
            )
        forget_transforms()
        n_frames = min(len(tracks.t_s) for tracks in tracks_of_axes)
        sites: list[Floats] = []
        depths: list[Floats] = []
        for axis, tracks in enumerate(tracks_of_axes):
            hz, volts = tracks.frequency_hz[:n_frames], tracks.amplitude_v[:n_frames]
            intended, full_v = self._positions.intended(axis, hz), self._full_v[axis]
            sites.append(self._positions.actual(axis, hz))
            depths.append((volts / np.interp(intended, np.arange(len(full_v)), full_v)) ** 2)
        bright = _light(depths) > DARK
        self._jumps += find_jumps(tracks_of_axes, sites, depths, bright)
        for frames in _batches(bright):
            on = [~np.isnan(positions[frames]).all(axis=0) for positions in sites]
            parts = (values[frames][:, on[axis]] for axis in (0, 1) for values in (sites[axis], depths[axis]))
            yield tuple(map(np.ascontiguousarray, parts)), tracks_of_axes[0].t_s[frames]

    def _near(self, rows: Floats, cols: Floats) -> Mask:
        """Sites that any tweezer comes close to, bool (n_rows, n_cols)."""
        n_rows, n_cols = self._grid.shape
        return _lines(rows, n_rows).T.astype(np.float32) @ _lines(cols, n_cols).astype(np.float32) > 0

    def _arrivals(self, state: Floats, static: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
        """Row, column of the site nearest to each atom, its energy there; -1 and inf beyond the grid."""
        from labseq_virtual.flight_kernels import energies

        waist, rayleigh = self._beams[:2]
        place = np.rint((state[:, :2] - self._plane[0]) @ self._plane[3:].T).astype(np.intp)
        inside = ((place >= 0) & (place < self._grid.shape)).all(axis=1)
        row, col = np.where(inside[:, None], place, 0).T
        sites = self._grid.positions_m[row, col]
        energy = np.where(inside, energies(state, sites, static[row, col], waist, rayleigh), np.inf)
        return np.where(inside, row, -1), np.where(inside, col, -1), energy

    def _assign_fates(
        self, flights: NDArray[Any], alive: Mask, paired: Mask, bound: Mask, unlucky: Mask, end_s: float
    ) -> None:
        """Fill in the fates; atoms lost without a recorded time are lost at the end, where they are then."""
        flights["fate"] = b"transport"
        flights["fate"][alive & bound] = b"kept"
        flights["fate"][alive & bound & unlucky] = b"hand_over"
        to_row, to_col = flights["to_row"], flights["to_col"]
        kept = np.flatnonzero(flights["fate"] == b"kept")
        _, index, count = np.unique(
            np.stack([to_row[kept], to_col[kept]]), axis=1, return_inverse=True, return_counts=True
        )
        flights["fate"][kept[count[index.ravel()] > 1]] = b"collision"
        flights["fate"][paired] = b"collision"
        flights["fate"][(to_row < 0) & ~paired] = b"ejected"
        lost = flights["fate"] != b"kept"
        late = lost & np.isnan(flights["lost_s"])
        flights["lost_s"][late] = end_s
        flights["lost_row"][late], flights["lost_col"][late] = to_row[late], to_col[late]
        to_row[lost] = to_col[lost] = -1


def _lines(tracks: Floats, n_sites: int) -> Mask:
    """The rows or columns on both sides of the tones of each frame, bool (n_frames, n_sites)."""
    frame, tone = np.nonzero(~np.isnan(tracks))
    below = np.clip(np.floor(tracks[frame, tone]).astype(np.intp), -2, n_sites) + 2
    lines = np.zeros((len(tracks), n_sites + 4), np.bool_)
    lines[frame, below] = lines[frame, below + 1] = True
    return lines[:, 2 : n_sites + 2]


def _light(depths: list[Floats]) -> Floats:
    """Depth factor of the deepest tweezer in each frame, (n_frames,)."""
    rows, cols = (np.nan_to_num(depth).max(axis=1, initial=0.0) for depth in depths)
    return rows * cols


def _batches(bright: Mask) -> list[slice]:
    """The frames of each batch: cut in the middle of the dark between two that are bright."""
    edges = np.flatnonzero(np.diff(bright, prepend=False, append=False))
    cuts = [0, *((edges[1:-1:2] + edges[2::2]) // 2).tolist(), len(bright) - 1]
    return [slice(first, last + 1) for first, last in pairwise(cuts)]


def _max_on(tracks: Floats) -> int:
    return int((~np.isnan(tracks)).sum(axis=1).max(initial=0))
