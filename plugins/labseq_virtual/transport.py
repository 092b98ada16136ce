"""Where the mobile tweezers take the atoms: a tone program, taken at its word.

The tweezers are the crossings of the row tones and the column tones that are on.
What a segment is *meant* for (its kind, its batch) is not looked at: only tones
count, so that a wrong program does here what it would do in the lab.

Rules, in the order in which they act on a segment:

1. A crossing that was on at the end of the segment before, within the site
   tolerance on both axes, is the same tweezer and keeps its atom. An atom whose
   tweezer has no such successor is lost: its tone jumped or went out.
2. A crossing that comes on takes the atom of the nearest site, if it is near and deep enough
   (``handover.py``).
3. Tones of one axis that come nearer than half a site, or pass one another, mix
   the atoms on both: they are lost.
4. A crossing that moves over a standing atom, or ends on one, throws it out, if it is
   deeper than a static tweezer. The first to arrive loses its own atom too.
5. A crossing that goes out sets its atom down on the nearest site, less the losses
   of ``handover.py``, which are drawn then; two atoms on one site are both lost; outside of the
   grid the atom is gone (ejected).

Atoms still held when the program ends are lost. The course of the speed within a
segment changes nothing here: all tones follow the same one, so what meets, and in which
order, is the same.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import FrequencyCourse, MotionSpec, SiteGrid, ToneProgram
from labseq_virtual.axis_tones import full_amplitudes, tone_table
from labseq_virtual.handover import constants, merging_distance
from labseq_virtual.places import Places
from labseq_virtual.settings import WorldSettings

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

CAUSES: Final[tuple[str, ...]] = ("hand_over", "transport", "collision", "ejected", "program")
"""What moved atoms are lost by. "program": their tweezer went out or jumped."""
HAND_OVER, TRANSPORT, COLLISION, EJECTED, PROGRAM = range(5)
"""Places of these causes in the array that the kernels count in."""
FASTEST: Final = np.array([course.fastest for course in FrequencyCourse])
"""Greatest speed over the mean, for each course."""


@dataclass(frozen=True, slots=True)
class Playing:
    """A program on its way.

    Attributes:
        program: What is played.
        t_start_s: When it started.
    """

    program: ToneProgram
    t_start_s: float

    @property
    def t_end_s(self) -> float:
        """When it ends."""
        return self.t_start_s + self.program.total_duration_s

    def n_segments_until(self, t_s: float) -> int:
        """How many segments are over at a time."""
        ends_s = self.t_start_s + np.cumsum(self.program.duration_s)
        return int(np.searchsorted(ends_s, t_s, side="right"))


class Transport:
    """Carries atoms by tone programs.

    Args:
        grid: The grid of sites, with its frequencies.
        motion: The amplitudes that are meant to give the full depth.
        settings: Tolerances and losses.
        places: Where the tones put their light; by default without errors of the tones.
    """

    def __init__(
        self, grid: SiteGrid, motion: MotionSpec, settings: WorldSettings, places: Places | None = None
    ) -> None:
        self._settings = settings
        self._places = places or Places(grid, settings.mobile_light)
        self._full = full_amplitudes(grid, motion)
        self._law = constants(grid, settings)
        self._reach = np.stack(merging_distance(settings.static_waist, settings.mobile_light.waist))

    def carry(
        self,
        occupied: Mask,
        program: ToneProgram,
        n_segments: int,
        depth: Floats,
        rng: np.random.Generator,
        loss_factor: float,
    ) -> Counter[str]:
        """Carry out the first segments of a program.

        Args:
            occupied: bool (n_rows, n_cols), C-contiguous, sites that hold an atom; changed in place.
            program: What the tweezers play.
            n_segments: How many segments are played; atoms held after them are lost.
            depth: float64 (n_rows, n_cols), depths of the static tweezers, of the nominal one.
            rng: Random numbers of the shot; how many are drawn depends on the program alone.
            loss_factor: The shot's factor on the transport loss.

        Returns:
            How many atoms were lost by each of :data:`CAUSES` that lost any.
        """
        from labseq_virtual._kernels_transport import carry_atoms, most_let_go

        rows, cols = self._tones(program, 0), self._tones(program, 1)
        offsets = program.row.offsets, program.column.offsets
        n_segments = min(n_segments, program.n_segments)
        draws = rng.random((most_let_go(rows, offsets[0], cols, offsets[1], n_segments), 3))
        lost = carry_atoms(
            occupied, depth * self._settings.static_depth, rows, offsets[0], cols, offsets[1],
            program.duration_s, FASTEST[program.course], n_segments, loss_factor, draws, self._law,
            self._reach,
        )  # fmt: skip
        by_cause: Counter[str] = Counter(dict(zip(CAUSES, lost.tolist(), strict=True)))
        return +by_cause

    def _tones(self, program: ToneProgram, index: int) -> Floats:
        axis = (program.row, program.column)[index]
        start, end = self._places.sites(index, axis.start_hz), self._places.sites(index, axis.end_hz)
        return tone_table(axis, start, end, self._full[index], self._settings.on_amplitude)
