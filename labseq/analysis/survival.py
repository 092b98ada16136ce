"""Survival of atoms between an image and the next one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.model import Occupancy, follow_atoms
from labseq.model.estimate import Rate
from labseq.recording import Shot

Counts = NDArray[np.int64]


@dataclass(slots=True, eq=False)
class SurvivalCounts:
    """Number of atoms expected and seen on each site.

    Attributes:
        n_expected: int64 (n_rows, n_cols).
        n_seen: int64 (n_rows, n_cols), number of these detected on the next image.
    """

    n_expected: Counts
    n_seen: Counts

    @property
    def rate(self) -> Rate:
        """The survival over all sites."""
        return Rate(int(self.n_seen.sum()), int(self.n_expected.sum()))

    @property
    def fractions(self) -> NDArray[np.float64]:
        """The survival on each site, float64 (n_rows, n_cols); NaN where no atom was expected."""
        with np.errstate(invalid="ignore"):
            return np.where(self.n_expected > 0, self.n_seen / np.maximum(self.n_expected, 1), np.nan)

    def add(self, expected: Occupancy, seen: Occupancy) -> None:
        """Count the atoms of one shot."""
        self.n_expected += expected
        self.n_seen += expected & seen


@dataclass(slots=True, eq=False)
class Survival:
    """Survival of atoms between an image and the next one.

    As detected: an atom that is missed counts as lost, and another atom on its site counts as
    the atom.

    Attributes:
        moved: Atoms that were moved, by the site that they were moved to.
        kept: Atoms that stayed on their site.
        by_cycle: Moved and kept for each cycle, counted from 0 over all rearrangements of the shot.
        n_read: Number of shots.
    """

    moved: SurvivalCounts
    kept: SurvivalCounts
    by_cycle: list[tuple[SurvivalCounts, SurvivalCounts]] = field(
        default_factory=list[tuple[SurvivalCounts, SurvivalCounts]]
    )
    n_read: int = 0

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> Survival:
        """Empty counts for a grid of this shape."""
        return cls(_nothing(shape), _nothing(shape))

    def add(self, shot: Shot, loads: frozenset[int]) -> None:
        """Count the atoms of a shot.

        Args:
            loads: Indices of the steps that load atoms; survival is not counted across them.

        Raises:
            RecordingError: The file cannot be read.
        """
        occupancies, cycles, images = shot.occupancies, iter(shot.cycles), shot.summary.images
        loaded_s = [timing.t_start_s for timing in shot.timing if timing.step in loads]
        if len(images) != len(occupancies):
            raise RecordingError(shot.file, "has other images than the index says; restore it from a backup")
        last = -1
        for i, ended in enumerate(images.cycle):
            made = next(cycles, None) if ended >= 0 else None
            last += made is not None
            start_s, end_s = images.t_start_s[i - 1] if i else -1.0, images.t_start_s[i]
            if not i or any(start_s <= t_s < end_s for t_s in loaded_s):
                continue
            moved, kept = follow_atoms(occupancies[i - 1], () if made is None else (made,))
            self._count(moved, kept, occupancies[i], last if made is not None else -1)
        self.n_read += 1

    def _count(self, moved: Occupancy, kept: Occupancy, seen: Occupancy, cycle: int) -> None:
        self.moved.add(moved, seen)
        self.kept.add(kept, seen)
        if cycle >= 0:
            while len(self.by_cycle) <= cycle:
                self.by_cycle.append((_nothing(seen.shape), _nothing(seen.shape)))
            self.by_cycle[cycle][0].add(moved, seen)
            self.by_cycle[cycle][1].add(kept, seen)


def _nothing(shape: tuple[int, ...]) -> SurvivalCounts:
    return SurvivalCounts(np.zeros(shape, np.int64), np.zeros(shape, np.int64))
