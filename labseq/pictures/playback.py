"""Computes the places of the tweezers and atoms of a plan at any time, for animations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from labseq.assembly.occupancies import image_before
from labseq.assembly.recorded import machine_of_shot
from labseq.data.shot import Shot
from labseq.errors import RecordingError
from labseq.model import (
    AxisTones,
    FrequencyCourse,
    MotionSpec,
    Occupancy,
    Plan,
    RfSpec,
    SegmentKind,
    SiteGrid,
    TargetPattern,
    ToneProgram,
)
from labseq.motion import tone_program
from labseq.motion.survival import landings

Floats = NDArray[np.float64]
Knot = tuple[float, float, float]
Fate = Literal["kept", "ejected", "lost", "missing"]

SITE_0_HZ, SITE_HZ = 1e9, 1e6
"""Frequency of site 0 and step from site to site, in the programs that places are read from."""


@dataclass(frozen=True, slots=True, eq=False)
class AtomTrack:
    """The path of one atom.

    Attributes:
        knots: float64 (n, 3), time in s, row, column. Straight between knots, at rest before and after them.
        fate: "kept", "ejected" beyond the grid, "lost" at a known time, or "missing" on the next image.
        end_s: When it was ejected or lost, the end of the motion for a missing atom, or inf if it is kept.
    """

    knots: Floats
    fate: Fate = "kept"
    end_s: float = math.inf

    @property
    def is_lost(self) -> bool:
        """True if it is lost at any time, known or not."""
        return self.fate in ("lost", "missing")

    def ended(self, fate: Fate, end_s: float) -> AtomTrack:
        """The same atom, at rest from ``end_s`` on."""
        before = self.knots[self.knots[:, 0] < end_s]
        return AtomTrack(np.vstack([before, [end_s, *self.place(end_s)]]), fate, end_s)

    def place(self, t_s: float) -> Floats:
        """Row and column at a time, float64 (2,)."""
        return place_at(self.knots, t_s)


def place_at(knots: Floats, t_s: float) -> Floats:
    """The values of knots (n, 1 + m), whose first column is the time, at a time, float64 (m,).

    Example:
        >>> place_at(np.array([[0.0, 1.0, 5.0], [2.0, 3.0, 5.0]]), 0.5).tolist()
        [1.5, 5.0]
    """
    if len(knots) == 1:
        return knots[0, 1:]
    return np.array([np.interp(t_s, knots[:, 0], values) for values in knots[:, 1:].T])


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Everything at one time, in sites.

    Attributes:
        batch: Index of the batch that is played, or played next. After the end the number of batches.
        rows: float64 (n, 2), place and depth of each row tone that is on.
        columns: float64 (n, 2), the same for the column tones.
        atoms: float64 (n_atoms, 2), row and column of each atom.
        is_there: bool (n_atoms,), True for an atom that is not ejected or lost yet.
    """

    batch: int
    rows: Floats
    columns: Floats
    atoms: Floats
    is_there: NDArray[np.bool_]

    @property
    def tweezers(self) -> Floats:
        """The crossings of the tones, float64 (n, 4) of row, column, depth, and 1 with an atom."""
        atoms = {tuple(place) for place in self.atoms[self.is_there].round(6).tolist()}
        crossings = [
            (row, column, deep * depth, float((round(row, 6), round(column, 6)) in atoms))
            for row, deep in self.rows.tolist()
            for column, depth in self.columns.tolist()
        ]
        return np.array(crossings).reshape(-1, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Playback:
    """The motion of one cycle as it is played. Times are in seconds from the start of the cycle.

    Attributes:
        grid: The grid of sites.
        target: The target.
        start_s: Start of the first batch, after the time for the plan, the tones and the transfer.
        end_s: End of the last batch.
        batch_s: float64 (n_batches, 2), start and end of each batch.
        rows: The tones of the rows while they are on. Each is float64 (n, 3) of time, place in sites and
            depth relative to full depth. Straight between these knots.
        columns: The same for the tones of the columns.
        atoms: The atoms.
    """

    grid: SiteGrid
    target: TargetPattern
    start_s: float
    end_s: float
    batch_s: Floats
    rows: tuple[Floats, ...]
    columns: tuple[Floats, ...]
    atoms: tuple[AtomTrack, ...]

    def at(self, t_s: float) -> Frame:
        """The place of everything at a time."""
        return Frame(
            batch=self.at_batch(t_s),
            rows=_on(self.rows, t_s),
            columns=_on(self.columns, t_s),
            atoms=np.array([atom.place(t_s) for atom in self.atoms]).reshape(-1, 2),
            is_there=np.array([t_s < atom.end_s for atom in self.atoms], np.bool_),
        )

    @property
    def speed(self) -> float:
        """Motion shown in a second, in seconds. 1, 2 or 5 times a power of ten, at least 0.1 ms."""
        steps = (factor * 10.0**power for power in range(-4, -1) for factor in (1, 2, 5))
        # longest animation, except of motion that takes longer than a second
        return next((step for step in steps if self.end_s - self.start_s <= 20.0 * step), 0.05)

    def trails(self, t_s: float) -> list[Floats]:
        """The paths of the atoms in the batch that is played, until a time, float64 (n, 2) each, in sites."""
        batch = self.at_batch(t_s)
        since_s = self.batch_s[batch, 0] if batch < len(self.batch_s) else math.inf
        passed = [
            (atom, atom.knots[(atom.knots[:, 0] >= since_s) & (atom.knots[:, 0] < t_s), 1:])
            for atom in self.atoms
        ]
        return [np.vstack([places, atom.place(t_s)]) for atom, places in passed if len(places)]

    def at_batch(self, t_s: float) -> int:
        """Index of the batch that is played, or played next. After the end the number of batches."""
        return int(np.searchsorted(self.batch_s[:, 1], t_s, side="right"))

    def as_json(self) -> dict[str, Any]:
        """Everything that ``player.js`` needs to draw it at any time, with times in ms."""
        return {
            "n_rows": self.grid.n_rows,
            "n_cols": self.grid.n_cols,
            "axes": (self.grid.axes / self.grid.spacing_m).round(6).tolist(),
            "fill": ["".join("01"[int(site)] for site in row) for row in self.target.fill],
            "start": round(1e3 * self.start_s, 6),
            "end": round(1e3 * self.end_s, 6),
            "speed": 1e3 * self.speed,
            "batches": _rounded(1e3 * self.batch_s),
            "row_tones": [_rounded(knots * (1e3, 1, 1)) for knots in self.rows],
            "column_tones": [_rounded(knots * (1e3, 1, 1)) for knots in self.columns],
            "atoms": [_rounded(atom.knots * (1e3, 1, 1)) for atom in self.atoms],
            "fates": [
                None if atom.fate == "kept" else [atom.fate, round(1e3 * atom.end_s, 6)]
                for atom in self.atoms
            ],
        }


def _rounded(values: Floats) -> list[Any]:
    return values.round(6).tolist()


def _on(tracks: Iterable[Floats], t_s: float) -> Floats:
    """Place and depth of the tones that are on at a time."""
    places = [place_at(knots, t_s) for knots in tracks if knots[0, 0] <= t_s < knots[-1, 0]]
    return np.array(places).reshape(-1, 2)


def play_back(
    plan: Plan,
    occupancy: Occupancy,
    target: TargetPattern,
    grid: SiteGrid,
    motion: MotionSpec,
    end_s: float,
) -> Playback:
    """Compute the places of tweezers and atoms while a checked plan is played.

    Atoms on which a tweezer without an atom is ramped down are lost at the end of its batch if the profile's
    ``losses.landing`` is more than half. No other loss of a single atom can be predicted.

    Args:
        plan: The batches that are played.
        occupancy: bool (n_rows, n_cols), before.
        motion: How the tweezers move.
        end_s: End of the last batch, from the start of the cycle.
    """
    program = _program(plan, grid, motion)
    joint_s = end_s - program.total_duration_s + program.joint_s
    on = program.kind != SegmentKind.IDLE
    segments = [np.flatnonzero(on & (program.batch == batch)) for batch in range(plan.n_batches)]
    batch_s = [(joint_s[own[0]], joint_s[own[-1] + 1]) for own in segments]
    depths = motion.max_row_tones**2, motion.max_column_tones**2  # relative to an equal share for each tone
    return Playback(
        grid=grid,
        target=target,
        start_s=float(joint_s[0]),
        end_s=float(joint_s[-1]),
        batch_s=np.array(batch_s).reshape(-1, 2),
        rows=_tone_tracks(program, program.row, joint_s, depths[0]),
        columns=_tone_tracks(program, program.column, joint_s, depths[1]),
        atoms=_atom_tracks(plan, program, joint_s, segments, occupancy, motion),
    )


def _program(plan: Plan, grid: SiteGrid, motion: MotionSpec) -> ToneProgram:
    """The tones on AODs without limits, whose frequency tells the place in sites at any calibration."""
    band_hz = 0.0, 2 * SITE_0_HZ
    rf = RfSpec(row_band_hz=band_hz, column_band_hz=band_hz, min_spacing_hz=0.0)
    rows_hz, columns_hz = (SITE_0_HZ + SITE_HZ * np.arange(n) for n in grid.shape)
    even = replace(grid, row_frequency_hz=rows_hz, column_frequency_hz=columns_hz)
    return tone_program(plan, even, replace(motion, rf=rf))


def _places(axis: AxisTones, segment: int) -> Floats:
    """Start and end of each tone of a segment in sites, float64 (n_tones, 2)."""
    part = slice(axis.offsets[segment], axis.offsets[segment + 1])
    hz = np.stack([axis.start_hz[part], axis.end_hz[part]], axis=1)
    return ((hz - SITE_0_HZ) / SITE_HZ).round(9)


def _pieces(program: ToneProgram, segment: int, joint_s: Floats) -> Iterator[tuple[float, float, float]]:
    """Time of each knot of a segment, and fractions of its duration and its paths until then."""
    course = FrequencyCourse(int(program.course[segment]))
    first_s, last_s = joint_s[segment : segment + 2].tolist()
    # 12 straight pieces for a segment in which the speed changes
    for u in np.linspace(0.0, 1.0, 2 if course is FrequencyCourse.LINEAR else 13).tolist():
        yield first_s + u * (last_s - first_s), u, course.fraction(u)


def _tone_tracks(
    program: ToneProgram, axis: AxisTones, joint_s: Floats, full_depth: float
) -> tuple[Floats, ...]:
    """Each tone of an axis from its switching on to its switching off."""
    tracks: list[list[Knot]] = []
    on: dict[float, list[Knot]] = {}  # knots of each tone, by its place now
    for segment in range(program.n_segments):
        part = slice(axis.offsets[segment], axis.offsets[segment + 1])
        amplitudes = np.stack([axis.start_amplitude[part], axis.end_amplitude[part]], axis=1)
        depths = (full_depth * amplitudes**2).round(9)
        pieces, goes_on = list(_pieces(program, segment, joint_s)), dict[float, list[Knot]]()
        for (start, end), (deep, depth) in zip(_places(axis, segment).tolist(), depths.tolist(), strict=True):
            track = on.get(start)
            if track is None:
                tracks.append(track := [])
            for t_s, u, way in pieces:
                _add(track, (t_s, start + way * (end - start), deep + u * (depth - deep)))
            goes_on[end] = track
        on = goes_on
    return tuple(np.array(track) for track in tracks)


def _add(track: list[Knot], knot: Knot) -> None:
    """Add a knot, which replaces the last knot if nothing has changed since the knot before it."""
    if len(track) > 1 and track[-1][1:] == track[-2][1:] == knot[1:]:
        track[-1] = knot
    elif not track or track[-1] != knot:
        track.append(knot)


def _atom_tracks(
    plan: Plan,
    program: ToneProgram,
    joint_s: Floats,
    segments: list[NDArray[np.intp]],
    occupancy: Occupancy,
    motion: MotionSpec,
) -> tuple[AtomTrack, ...]:
    """The path of each atom, which follows the tones that cross on it while its batch is played."""
    homes = np.argwhere(occupancy)
    tracks: list[list[Knot]] = [[(float(joint_s[0]), float(row), float(col))] for row, col in homes.tolist()]
    on_site = np.full(occupancy.shape, -1)
    on_site[tuple(homes.T)] = np.arange(len(homes))
    ends: dict[int, tuple[Fate, float]] = {}
    for batch, own in zip(plan.batches, segments, strict=True):
        moved = on_site[tuple(batch.from_sites.T)]
        on_site[tuple(batch.from_sites.T)] = -1
        for segment in own.tolist():
            _carry([tracks[atom] for atom in moved], program, segment, joint_s)
        end_s = float(joint_s[own[-1] + 1])
        if batch.tones is not None and motion.losses.landing > 0.5:
            for site in landings(batch, batch.tones, on_site >= 0):
                ends.setdefault(int(on_site[site]), ("lost", end_s))
        stays = ((batch.to_sites >= 0) & (batch.to_sites < occupancy.shape)).all(axis=1)
        on_site[tuple(batch.to_sites[stays].T)] = moved[stays]
        ends |= {int(atom): ("ejected", end_s) for atom in moved[~stays] if int(atom) not in ends}
    atoms = [AtomTrack(np.array(track)) for track in tracks]
    return tuple(atom.ended(*ends[i]) if i in ends else atom for i, atom in enumerate(atoms))


def _carry(tracks: list[list[Knot]], program: ToneProgram, segment: int, joint_s: Floats) -> None:
    """Continue the paths of atoms by a segment. Atoms whose tones are already off stay at rest."""
    rows, columns = (dict(_places(axis, segment).tolist()) for axis in (program.row, program.column))
    pieces = list(_pieces(program, segment, joint_s))
    for track in tracks:
        _, row, col = track[-1]
        if row in rows and col in columns:
            for t_s, _, way in pieces:
                place = row + way * (rows[row] - row), col + way * (columns[col] - col)
                _add(track, (t_s, *place))


def play_back_cycle(shot: Shot, index: int) -> Playback:
    """Compute the places of tweezers and atoms in a cycle of a recorded shot, and which atoms were lost.

    Args:
        index: Index of the cycle, from 0 over all rearrangements of the shot.

    Raises:
        RecordingError: The shot has no such cycle or no image before it, or its file is damaged.
        ConfigError: The recorded settings are invalid.
    """
    cycles, images = shot.cycles, shot.images
    if not 0 <= index < len(cycles):
        raise RecordingError(shot.file, f"has no cycle {index}; it has {len(cycles)}, counted from 0")
    cycle = cycles[index]
    before = image_before(cycle, images)
    if before is None:
        raise RecordingError(shot.file, f"has no image before cycle {index}")
    machine = machine_of_shot(shot)
    grid, motion = machine.grid, machine.motion
    plan = cycle.plan.first(cycle.n_batches_played)
    nothing_foreseen = replace(motion, losses=replace(motion.losses, landing=0.0))
    playback = play_back(plan, before.occupancy, shot.target, grid, nothing_foreseen, cycle.moves_s)
    numbers = [i for i, image in enumerate(images) if (image.step, image.cycle) == (cycle.step, cycle.cycle)]
    if not numbers:  # it was interrupted
        return playback
    after = _true_atoms(shot, numbers[0])
    seen = images[numbers[0]].occupancy if after is None else after
    return replace(playback, atoms=tuple(_with_losses(shot, cycle.t_start_s, playback, seen)))


def _true_atoms(shot: Shot, image: int) -> Occupancy | None:
    """The atoms present when an image was taken, if a simulation recorded them."""
    atoms = shot.atom_events.get("atoms")
    if atoms is None:
        return None
    there, own = np.zeros(shot.target.shape, np.bool_), atoms[atoms["exposure"] == image]
    there[own["row"], own["col"]] = True
    return there


def _with_losses(
    shot: Shot, cycle_start_s: float, playback: Playback, seen: Occupancy
) -> Iterator[AtomTrack]:
    """The atoms, where an atom that is not in its place is missing, or lost if this is known."""
    flights = shot.atom_events.get("flights")
    losses = np.empty((0, 3))
    if flights is not None:
        losses = np.stack([flights[name] for name in ("lost_s", "lost_row", "lost_col")], axis=1)
        losses = losses[flights["fate"] != b"ejected"] - (cycle_start_s, 0.0, 0.0)
    for atom in playback.atoms:
        site = tuple(int(n) for n in atom.place(playback.end_s).round())
        if atom.fate == "ejected" or seen[site]:
            yield atom
            continue
        lost_s = [
            t_s
            for t_s, *place in losses.tolist()
            if playback.start_s <= t_s <= playback.end_s and _is_near(atom.place(t_s), place)
        ]
        yield atom.ended("lost", lost_s[0]) if lost_s else atom.ended("missing", playback.end_s)


def _is_near(place: Floats, other: Iterable[float]) -> bool:
    """True if two places are less than 0.6 sites apart, so no two atoms are near the same place."""
    return bool(np.abs(place - np.array([*other])).max() < 0.6)
