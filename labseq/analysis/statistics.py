"""Statistics of a run's shots: filling, defect-free fraction, losses and survival, with their errors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.data.shot import Shot
from labseq.errors import RecordingError
from labseq.model import Occupancy, TargetPattern, follow_atoms
from labseq.model.estimate import Estimate, Rate, mean
from labseq.recording.index import IndexRow

Counts = NDArray[np.int64]

LOST: Final = "lost."
"""Prefix of the readings in which a simulation reports its losses."""


@dataclass(frozen=True, slots=True)
class CycleStatistics:
    """Statistics of one cycle over the shots that reached it.

    Standard errors are over shots, not sites, because the losses within a shot are correlated.

    Attributes:
        cycle: Index of the cycle, from 0, over all rearrangements of the shot.
        n_shots: Number of shots that reached it.
        defect_free: Shots in which the image that ends it is defect-free.
        seen: Shots in which that image, or the image at the end of an earlier cycle, is defect-free.
        filling: Filling of the target on that image.
        n_atom_moves: Number of atom moves that were played.
        n_batches: Number of batches that were played.
        n_left_out: Number of batches that did not fit into the window.
        period_s: Time from the start of the previous exposure to the start of its own.
        defects: Number of shots with 0, 1, 2, ... empty target sites on its image.
    """

    cycle: int
    n_shots: int
    defect_free: Rate
    seen: Rate
    filling: Estimate
    n_atom_moves: Estimate
    n_batches: Estimate
    n_left_out: Estimate
    period_s: Estimate
    defects: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of several shots.

    Attributes:
        n_shots: Number of shots.
        defect_free: Judged shots that met the target. A shot is judged on its last ``image``
            step, if no rearrangement follows.
        seen: Shots in which some image after a rearrangement is defect-free.
        filling: Filling of the target in the judged shots.
        cycles: Statistics of each cycle.
        defects: Number of judged shots with 0, 1, 2, ... empty target sites on that image.
        too_short: Shots in which the plan of a cycle did not fit into its window.
        losses: Cause -> atoms lost in a shot, known in simulations. Empty on real hardware.
        defects_true: Empty target sites at the end of a shot, known in simulations.
        defects_seen: Empty target sites on the last image of the same shots.
    """

    n_shots: int
    defect_free: Rate
    seen: Rate
    filling: Estimate
    cycles: tuple[CycleStatistics, ...]
    defects: tuple[int, ...]
    too_short: Rate
    losses: Mapping[str, Estimate]
    defects_true: Estimate
    defects_seen: Estimate


def statistics_of(shots: Iterable[Shot], target: TargetPattern) -> Statistics:
    """Compute the statistics of shots from the index, or from their files if needed. Reads no frames."""
    rows = [shot.row for shot in shots]
    judged = [row for row in rows if not math.isnan(row.filling_fraction) and row.ends_with_image_step]
    # the same shots for both, so that true and seen defects can be compared
    with_truth = [row for row in rows if "n_defects_true" in row.simulation and len(row.images)]
    return Statistics(
        n_shots=len(rows),
        defect_free=Rate(sum(bool(row.success) for row in judged), len(judged)),
        seen=Rate(sum(row.was_defect_free for row in rows), len(rows)),
        filling=mean([row.filling_fraction for row in judged]),
        cycles=_cycles(rows, target),
        defects=_histogram([row.images.n_defects[-1] for row in judged if len(row.images)]),
        too_short=Rate(sum(row.cycles.n_batches_played != row.cycles.n_batches for row in rows), len(rows)),
        losses=_losses(rows),
        defects_true=mean([row.simulation["n_defects_true"] for row in with_truth]),
        defects_seen=mean([row.images.n_defects[-1] for row in with_truth]),
    )


@dataclass(frozen=True, slots=True)
class _ShotCycle:
    """One cycle of one shot."""

    is_met: bool
    n_defects: int
    n_atom_moves: int
    n_batches: int
    n_left_out: int
    period_s: float


def _shot_cycles(row: IndexRow) -> list[_ShotCycle]:
    """The cycles of a shot that end with an image."""
    images, cycles = row.images, row.cycles
    ends = [i for i, cycle in enumerate(images.cycle) if cycle >= 0]
    return [
        _ShotCycle(
            is_met=not images.n_defects[i] and not images.n_surplus[i],
            n_defects=images.n_defects[i],
            n_atom_moves=cycles.n_atom_moves[k],
            n_batches=cycles.n_batches_played[k],
            n_left_out=cycles.n_batches[k] - cycles.n_batches_played[k],
            period_s=images.t_start_s[i] - images.t_start_s[i - 1] if i else math.nan,
        )
        for k, i in enumerate(ends[: len(cycles)])
    ]


def _cycles(rows: Sequence[IndexRow], target: TargetPattern) -> tuple[CycleStatistics, ...]:
    per_shot = list(map(_shot_cycles, rows))
    seen = [list(accumulate((cycle.is_met for cycle in cycles), max)) for cycles in per_shot]
    n_most = max(map(len, per_shot), default=0)
    return tuple(
        _cycle(
            i,
            [cycles[i] for cycles in per_shot if len(cycles) > i],
            # a shot that ended after fewer cycles keeps its last result
            Rate(sum(any(met[: i + 1][-1:]) for met in seen), len(seen)),
            target.n_atoms,
        )
        for i in range(n_most)
    )


def _cycle(i: int, cycles: Sequence[_ShotCycle], seen: Rate, n_atoms: int) -> CycleStatistics:
    """Statistics of the cycle with index i.

    Args:
        cycles: This cycle in each shot that reached it.
        seen: See :class:`CycleStatistics`.
        n_atoms: Number of atoms in the target.
    """
    defects = np.array([cycle.n_defects for cycle in cycles])
    return CycleStatistics(
        cycle=i,
        n_shots=len(cycles),
        defect_free=Rate(sum(cycle.is_met for cycle in cycles), len(cycles)),
        seen=seen,
        filling=mean(1.0 - defects / n_atoms if n_atoms else np.ones(len(cycles))),
        n_atom_moves=mean([cycle.n_atom_moves for cycle in cycles]),
        n_batches=mean([cycle.n_batches for cycle in cycles]),
        n_left_out=mean([cycle.n_left_out for cycle in cycles]),
        period_s=mean([cycle.period_s for cycle in cycles]),
        defects=_histogram(defects.tolist()),
    )


def _histogram(numbers: Sequence[int]) -> tuple[int, ...]:
    return tuple(np.bincount(np.array(numbers, np.int64)).tolist())


def _losses(rows: Sequence[IndexRow]) -> dict[str, Estimate]:
    causes = dict.fromkeys(name for row in rows for name in row.simulation if name.startswith(LOST))
    return {
        name.removeprefix(LOST): mean([row.simulation[name] for row in rows if name in row.simulation])
        for name in causes
    }


@dataclass(slots=True, eq=False)
class SurvivalCounts:
    """Number of atoms expected and seen on each site.

    Attributes:
        n_expected: int64 (n_rows, n_cols), number of atoms expected.
        n_seen: int64 (n_rows, n_cols), number of expected atoms that the next image shows.
    """

    n_expected: Counts
    n_seen: Counts

    @property
    def rate(self) -> Rate:
        """The survival over all sites."""
        return Rate(int(self.n_seen.sum()), int(self.n_expected.sum()))

    @property
    def fractions(self) -> NDArray[np.float64]:
        """The survival on each site, float64 (n_rows, n_cols). NaN where no atom was expected."""
        with np.errstate(invalid="ignore"):
            return np.where(self.n_expected > 0, self.n_seen / np.maximum(self.n_expected, 1), np.nan)

    def add(self, expected: Occupancy, seen: Occupancy) -> None:
        """Count the atoms of one shot."""
        self.n_expected += expected
        self.n_seen += expected & seen


@dataclass(slots=True, eq=False)
class Survival:
    """Survival of atoms from one image to the next.

    Counts atoms as detected. An atom that the detector misses counts as lost, and another atom on its site
    counts as the atom.

    Attributes:
        moved: Atoms that were moved, by the site to which they were moved.
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
        return cls(_no_counts(shape), _no_counts(shape))

    def add(self, shot: Shot, loads: frozenset[int]) -> None:
        """Count the atoms of a shot.

        Args:
            loads: Indices of the steps that load atoms. Survival is not counted across them.

        Raises:
            RecordingError: The file cannot be read.
        """
        occupancies, cycles, images = shot.occupancies, iter(shot.cycles), shot.row.images
        loaded_s = [timing.t_start_s for timing in shot.timing if timing.step in loads]
        if len(images) != len(occupancies):
            raise RecordingError(
                shot.file, "does not have the images that the index lists", "restore it from a backup"
            )
        number = -1  # of the cycle, over all rearrangements of the shot
        for i, ended_cycle in enumerate(images.cycle):
            cycle = next(cycles, None) if ended_cycle >= 0 else None
            number += cycle is not None
            start_s, end_s = images.t_start_s[i - 1] if i else -1.0, images.t_start_s[i]
            # an atom that was loaded in between would count as a survivor
            if not i or any(start_s <= t_s < end_s for t_s in loaded_s):
                continue
            moved, kept = follow_atoms(occupancies[i - 1], () if cycle is None else (cycle,))
            self._count(moved, kept, occupancies[i], number if cycle is not None else -1)
        self.n_read += 1

    def _count(self, moved: Occupancy, kept: Occupancy, seen: Occupancy, cycle: int) -> None:
        self.moved.add(moved, seen)
        self.kept.add(kept, seen)
        if cycle >= 0:
            while len(self.by_cycle) <= cycle:
                self.by_cycle.append((_no_counts(seen.shape), _no_counts(seen.shape)))
            self.by_cycle[cycle][0].add(moved, seen)
            self.by_cycle[cycle][1].add(kept, seen)


def _no_counts(shape: tuple[int, ...]) -> SurvivalCounts:
    return SurvivalCounts(np.zeros(shape, np.int64), np.zeros(shape, np.int64))
