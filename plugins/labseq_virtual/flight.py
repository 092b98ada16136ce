"""Atoms that fly in the light of the mobile tweezers, from a tone program or a played RF output.

The tweezers are the crossings of the row tones and the column tones that are on. The purpose of a segment
(its kind, its batch) is ignored. Only tones count, so a wrong program has the same effect as in
the lab.

Energies and depths inside are per mass of the atom, in m^2/s^2.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import MotionSpec, SiteGrid, ToneProgram
from labseq.plugin.motion import FrequencyCourse
from labseq_virtual.atoms import Atoms
from labseq_virtual.formulas import (
    KELVIN,
    MIN_TONE_DEPTH,
    full_amplitudes,
    full_volts,
    noise_hz,
    pair_survival,
    rayleigh_length,
)
from labseq_virtual.jumps import JUMPS, find_jumps
from labseq_virtual.records import FATES, SITE, TONE, plane_of
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
Mask = NDArray[np.bool_]

DARK: Final = 0.1
"""Fraction of the full depth below which the tweezers of a batch no longer hold atoms (ours)."""
SLEW_HZ: Final = 4e6
"""Largest deviation of a tone from its extrapolated frequency in a transit time (ours, 1100 um/ms at
1.6 MHz per site)."""

_FATE: Final = f"S{max(map(len, FATES))}"

FLIGHTS: Final = np.dtype(
    [
        ("held_s", np.float64),
        ("from_row", np.int16),
        ("from_col", np.int16),
        ("to_row", np.int16),
        ("to_col", np.int16),
        ("offset_m", np.float32),
        ("depth_K", np.float32),
        ("fate", _FATE),
        ("lost_s", np.float64),
        ("lost_row", np.float32),
        ("lost_col", np.float32),
    ],
    metadata={
        "descriptions": {
            "held_s": "when a mobile tweezer first held the atom, from the start of the shot (nan if never)",
            "from_row": "row of its site before the flight",
            "from_col": "column of its site before the flight",
            "to_row": "row of its final site, if it was kept",
            "to_col": "column of its final site, if it was kept",
            "offset_m": "how far the tweezer was from the site when it first held the atom",
            "depth_K": "greatest depth of the tweezer",
            "fate": "kept, or the cause of the loss: ejected, collision, transport, hand_over or program",
            "lost_s": "when it was lost, from the start of the shot (nan if never)",
            "lost_row": "row where it was lost, in sites",
            "lost_col": "column where it was lost, in sites",
        }
    },
)
"""The path of an atom that was held by a mobile tweezer or lost. Causes are "ejected" beyond the grid, a
"collision" with another atom, falling out in "transport", and the transport loss, "hand_over"."""


@dataclass(frozen=True, slots=True)
class RunningProgram:
    """A program that is being played.

    Attributes:
        program: The program.
        t_start_s: When it started.
    """

    program: ToneProgram
    t_start_s: float

    @property
    def t_end_s(self) -> float:
        """Time of the program's end."""
        return self.t_start_s + self.program.total_duration_s

    def segment_at(self, t_s: float) -> tuple[int, float]:
        """The segment played at a time, and its elapsed time. After the end, one past the last segment."""
        joint_s = self.program.joint_s
        k = int(np.searchsorted(joint_s[1:], t_s - self.t_start_s, side="right"))
        return k, max(0.0, t_s - self.t_start_s - joint_s[k])


@dataclass(frozen=True, slots=True)
class Conditions:
    """Influences on the atoms during a program, in addition to the tweezers.

    Attributes:
        loss_factor: Factor on the transport loss.
        cooled: Fraction of the time with cooling light.
    """

    loss_factor: float = 1.0
    cooled: float = 1.0


class Flights:
    """Moves atoms in the light of the mobile tweezers."""

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
        self._full, self._full_v = full_amplitudes(grid, motion), full_volts(grid, motion)
        self._bands = bands(grid)
        axes_hz = grid.row_frequency_hz, grid.column_frequency_hz
        self.reach_hz = [reach_hz(hz, motion.eject_slots) for hz in axes_hz]
        row_hz, col_hz = (float(np.abs(np.diff(hz)).mean()) if len(hz) > 1 else 0.0 for hz in axes_hz)
        self._step_hz = row_hz, col_hz
        a1, a2 = grid.axes
        self._plane = plane_of(grid.positions_m[0, 0], a2, a1)
        self.margin_s = (WINDOW + 0.5) * light.transit_time
        self._flights: list[NDArray[Any]] = []
        self._jumps: list[tuple[Any, ...]] = []

    def check_resolvable(self) -> None:
        """Check that :func:`labseq_virtual.rf_analysis.track_tones` can resolve the tones of the sites.

        Raises:
            LimitError: The tones are too close, or move too fast, for the transit time of the sound.
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

    def carry_program(
        self,
        atoms: Atoms,
        running: RunningProgram,
        depth: Floats,
        rng: np.random.Generator,
        conditions: Conditions = Conditions(),
        until_s: float = math.inf,
    ) -> Counter[str]:
        """Move the atoms by a program, whose tones are played exactly.

        Args:
            atoms: The atoms. Changed in place.
            running: The program.
            depth: float64 (n_rows, n_cols), depths of the static tweezers relative to the nominal one.
            rng: Random numbers of the shot.
            conditions: Other influences on the atoms.
            until_s: Time at which all tones go off, if before the end of the program.

        Returns:
            Number of lost atoms by cause, only for causes with losses.
        """
        from labseq_virtual.flight_kernels import fly_in_program
        from labseq_virtual.light_kernels import FRAMES_PER_TRANSIT

        program, n_lost = running.program, np.zeros(len(FATES), np.int64)
        sites, durations_s = self._sites(atoms, depth), program.duration_s
        rows, cols = self._tones(program, 0), self._tones(program, 1)
        n_segments, played_s = running.segment_at(until_s)
        if n_segments < program.n_segments and played_s > 0:
            for axis, tones in ((program.row, rows), (program.column, cols)):
                part = tones[axis.offsets[n_segments] : axis.offsets[n_segments + 1]]
                _cut(part, FrequencyCourse(program.course[n_segments]), played_s / durations_s[n_segments])
            durations_s = np.append(durations_s[:n_segments], played_s)
            n_segments += 1
        fly_in_program(
            sites, rows, program.row.offsets, cols, program.column.offsets, durations_s, program.course,
            n_segments, self._step_hz, running.t_start_s, self._light.transit_time / FRAMES_PER_TRANSIT,
            machine(self._settings, conditions), self._plane, rng, n_lost,
        )  # fmt: skip
        return _settle(atoms, sites, n_lost)

    def carry_pulse(
        self,
        atoms: Atoms,
        pulse: RfPulse,
        depth: Floats,
        rng: np.random.Generator,
        conditions: Conditions = Conditions(),
    ) -> Counter[str]:
        """Move the atoms in the light of a pulse that the outputs played. Arguments as ``carry_program``."""
        from labseq_virtual.flight_kernels import fly_in_light

        n_lost, numbers = np.zeros(len(FATES), np.int64), machine(self._settings, conditions)
        sites = self._sites(atoms, depth)
        for tones, t_s in self.find_tones(pulse):
            rows, row_depth, cols, col_depth = (np.ascontiguousarray(values.T) for values in tones)
            flights = fly_in_light(
                sites, rows, row_depth, cols, col_depth, t_s[0], t_s[1] - t_s[0], numbers, self._plane, rng,
                n_lost,
            )  # fmt: skip
            self._flights.append(_table(flights))
        return _settle(atoms, sites, n_lost)

    def find_tones(self, pulse: RfPulse) -> Iterator[tuple[tuple[Floats, ...], Floats]]:
        """Positions (in sites) and depth factors of row and column tones, and the times of the frames.

        Yields one batch after the other. Batches without a pause are separated by the dark between them.
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

    def _sites(self, atoms: Atoms, depth: Floats) -> NDArray[Any]:
        """The sites and their atoms (n_rows, n_cols), see :class:`labseq_virtual.records.Site`."""
        sites = np.zeros(depth.shape, SITE)
        sites["atom"], sites["depth"] = atoms.occupied, KELVIN * self._settings.static_depth * depth
        sites["heat"], sites["since_s"] = atoms.heat, atoms.since_s
        return sites

    def _tones(self, program: ToneProgram, index: int) -> NDArray[Any]:
        """The tones of all segments of an axis (n_tones,), see :class:`labseq_virtual.records.Tone`."""
        axis, full = (program.row, program.column)[index], self._full[index]
        sites = np.arange(len(full))
        tones = np.empty(len(axis.start_hz), TONE)
        for at, hz, amplitude in (
            ("start", axis.start_hz, axis.start_amplitude),
            ("end", axis.end_hz, axis.end_amplitude),
        ):
            intended = self._positions.intended(index, hz)
            tones[at] = self._positions.actual(index, hz)
            tones[f"power_{at}"] = (amplitude / np.interp(intended, sites, full)) ** 2
        return tones


def machine(settings: SimulationSettings, conditions: Conditions) -> tuple[float, ...]:
    """The numbers of :class:`labseq_virtual.atom_kernels.Machine`."""
    light = settings.mobile_light
    return (
        KELVIN * settings.static_depth,
        settings.static_waist,
        rayleigh_length(settings.static_waist, settings.static_wavelength),
        KELVIN * light.depth,
        light.waist,
        rayleigh_length(light.waist, light.wavelength),
        settings.temperature,
        conditions.cooled / settings.cooling_time,
        noise_hz(settings),
        settings.transport_loss * conditions.loss_factor,
        pair_survival(settings) if conditions.cooled > 0 else 0.0,
    )


def _cut(tones: NDArray[Any], course: FrequencyCourse, u: float) -> None:
    """End the tones of a segment after a fraction u of the segment."""
    tones["end"] = tones["start"] + (tones["end"] - tones["start"]) * course.fraction(u)
    tones["power_end"] = tones["power_start"] + (tones["power_end"] - tones["power_start"]) * u


def _settle(atoms: Atoms, sites: NDArray[Any], n_lost: NDArray[np.int64]) -> Counter[str]:
    """Take over the atoms from the sites, and return the number of atoms lost by each cause."""
    atoms.occupied[...] = sites["atom"]
    atoms.heat[...], atoms.since_s[...] = sites["heat"], sites["since_s"]
    causes: dict[str, int] = dict(zip(FATES[1:], n_lost[1:].tolist(), strict=True))
    return +Counter(causes)


def _table(flights: NDArray[Any]) -> NDArray[Any]:
    """The rows of :data:`FLIGHTS` for atoms that were held or lost."""
    flights = flights[~np.isnan(flights["held_s"]) | (flights["fate"] > 0)]
    table = np.zeros(len(flights), FLIGHTS)
    for name in ("held_s", "from_row", "from_col", "to_row", "to_col", "lost_s", "lost_row", "lost_col"):
        table[name] = flights[name]
    table["offset_m"], table["depth_K"] = flights["offset"], flights["depth"] / KELVIN
    table["fate"] = np.array(FATES, _FATE)[flights["fate"]]
    lost = flights["fate"] > 0
    table["to_row"][lost] = table["to_col"][lost] = -1
    return table


def _light(depths: list[Floats]) -> Floats:
    """Depth factor of the deepest tweezer in each frame, (n_frames,)."""
    rows, cols = (np.nan_to_num(depth).max(axis=1, initial=0.0) for depth in depths)
    return rows * cols


def _batches(bright: Mask) -> list[slice]:
    """The frames of each batch, cut in the middle of the dark between two batches."""
    edges = np.flatnonzero(np.diff(bright, prepend=False, append=False))
    cuts = [0, *((edges[1:-1:2] + edges[2::2]) // 2).tolist(), len(bright) - 1]
    return [slice(first, last + 1) for first, last in pairwise(cuts)]
