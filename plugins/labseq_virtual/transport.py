"""Transport of atoms by a tone program that is carried out exactly as written.

The tweezers are the crossings of the row tones and the column tones that are on. The purpose of a segment
(its kind, its batch) is ignored: only tones count, so a wrong program has the effect that it would have in
the lab.

Rules, in the order in which they act on a segment:

1. A crossing that was on at the end of the segment before, within the site tolerance on both axes, is the
   same tweezer and keeps its atom. An atom whose tweezer has no such successor is lost: its tone jumped or
   switched off.
2. A crossing that switches on takes the atom of the nearest site, if it is close and deep enough
   (``handover.py``).
3. Tones of one axis that come closer than 0.45 sites, or pass one another, mix the atoms on both: they are
   lost.
4. A crossing that moves over an atom on a site knocks it out, if it is deeper than a static tweezer. The
   first to arrive may lose its own atom too: two atoms in one tweezer collide in the light (``handover.py``).
5. A crossing that passes beside an atom may take it along, and lose its own; an empty one that goes off on an
   atom may take that (``responses.py``).
6. A crossing that switches off drops its atom on the nearest site, with the losses of ``handover.py``; of
   two atoms on one site one is left, or none; outside the grid the atom is gone (ejected).

Atoms still held when the program ends are lost. The velocity profile within a segment does not matter here:
all tones follow the same one, so it does not change which atoms meet, or in which order.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import MotionSpec, SiteGrid, ToneProgram
from labseq_virtual.atoms import Atoms
from labseq_virtual.handover import full_amplitudes, merging_distance, pair_survival
from labseq_virtual.records import SITE, TONE
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.tone_positions import TonePositions
from labseq_virtual.tweezer_kernels import CAUSES, LOSSES, N_DRAWS, constants

Floats = NDArray[np.float64]


ON: Final = 1e-3
"""Amplitude, as a fraction of full scale, above which a tone is on (ours)."""


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
        """Time of its end."""
        return self.t_start_s + self.program.total_duration_s

    def n_segments_until(self, t_s: float) -> int:
        """Number of segments that have ended at a time."""
        ends_s = self.t_start_s + np.cumsum(self.program.duration_s)
        return int(np.searchsorted(ends_s, t_s, side="right"))


class Transport:
    """Moves atoms according to tone programs."""

    def __init__(
        self,
        grid: SiteGrid,
        motion: MotionSpec,
        settings: SimulationSettings,
        positions: TonePositions | None = None,
    ) -> None:
        self._settings = settings
        self._positions = positions or TonePositions(grid, settings.mobile_light)
        self._full = full_amplitudes(grid, motion)
        self._grid = grid
        self._constants = constants(grid, settings)
        self._merging = np.stack(merging_distance(settings.static_waist, settings.mobile_light.waist))

    def carry(
        self,
        atoms: Atoms,
        program: ToneProgram,
        n_segments: int,
        depth: Floats,
        rng: np.random.Generator,
        loss_factor: float,
        start_s: float = 0.0,
        cooled: float = 1.0,
    ) -> Counter[str]:
        """Carry out the first segments of a program.

        Args:
            atoms: The atoms; changed in place.
            program: The program.
            n_segments: Number of segments played; atoms held after them are lost.
            depth: float64 (n_rows, n_cols), depths of the static tweezers relative to the nominal one.
            rng: Random numbers of the shot; the number of draws depends on the program alone.
            loss_factor: The shot's factor on the transport loss.
            start_s: When the program starts.
            cooled: Fraction of the time with cooling light.

        Returns:
            Number of atoms lost by each of :data:`CAUSES` that lost any.
        """
        from labseq_virtual.transport_kernels import carry_atoms, max_drop_offs

        rows, cols = self._tones(program, 0), self._tones(program, 1)
        offsets = program.row.offsets, program.column.offsets
        n_segments = min(n_segments, program.n_segments)
        draws = rng.random((max_drop_offs(rows, offsets[0], cols, offsets[1], n_segments), N_DRAWS))
        tables, *numbers = self._constants._replace(
            cooling_hz=cooled / self._settings.cooling_time,
            pair_survival=pair_survival(self._settings) if cooled > 0 else 0.0,
        )
        sites, lost = np.zeros(depth.shape, SITE), np.zeros(1, LOSSES)
        sites["atom"], sites["depth"] = atoms.occupied, depth * self._settings.static_depth
        sites["heat"], sites["since_s"] = atoms.heat, atoms.since_s
        carry_atoms(
            sites, start_s, rows, offsets[0], cols, offsets[1], program.duration_s, program.course,
            n_segments, loss_factor, draws, tables, tuple(numbers), self._merging, lost[0],
        )  # fmt: skip
        atoms.occupied[...] = sites["atom"]
        atoms.heat[...], atoms.since_s[...] = sites["heat"], sites["since_s"]
        if sites["hazard"].any():
            taken = atoms.lose(rng.random(depth.shape) < -np.expm1(-sites["hazard"]))
            lost["collision"] += taken
        return +Counter({cause: int(lost[cause][0]) for cause in CAUSES})

    def _tones(self, program: ToneProgram, index: int) -> NDArray[Any]:
        """The tones of all segments of an axis, (n_tones,); see :class:`labseq_virtual.records.Tone`."""
        axis, full = (program.row, program.column)[index], self._full[index]
        sites = np.arange(len(full))
        start, end = self._positions.actual(index, axis.start_hz), self._positions.actual(index, axis.end_hz)
        tones = np.empty(len(start), TONE)
        tones["start"], tones["end"] = start, end
        tones["power_start"] = (axis.start_amplitude / np.interp(start, sites, full)) ** 2
        tones["power_end"] = (axis.end_amplitude / np.interp(end, sites, full)) ** 2
        tones["on_start"], tones["on_end"] = axis.start_amplitude > ON, axis.end_amplitude > ON
        return tones
