"""Plans: batches of atom moves, and the report of a checked plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.model.arrays import read_only


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Atom moves that are carried out at the same time.

    Attributes:
        from_sites: int16 (n, 2), (row, col) of each atom before.
        to_sites: int16 (n, 2), (row, col) of each atom after; a site outside the
            grid ejects the atom.
        linked: Whether the tweezers stay on from the batch before, so that there
            is no drop-off and pick-up between the two.
    """

    from_sites: NDArray[np.int16]
    to_sites: NDArray[np.int16]
    linked: bool = False

    def __post_init__(self) -> None:
        from_sites = read_only(self.from_sites, np.int16, (-1, 2), "from_sites")
        object.__setattr__(self, "from_sites", from_sites)
        to_sites = read_only(self.to_sites, np.int16, (len(from_sites), 2), "to_sites")
        object.__setattr__(self, "to_sites", to_sites)

    def __len__(self) -> int:
        return len(self.from_sites)


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Batches in order, held as flat arrays.

    Predicted occupancy and duration are worked out by :func:`labseq.check_plan`,
    never by the planner.

    Attributes:
        moves: int16 (n_atom_moves, 4), (from row, from col, to row, to col).
        batch_offsets: int32 (n_batches + 1,); batch i is ``moves[o[i]:o[i + 1]]``.
        linked: bool (n_batches,), see :class:`Batch`.
    """

    moves: NDArray[np.int16]
    batch_offsets: NDArray[np.int32]
    linked: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))

    def __post_init__(self) -> None:
        moves = read_only(self.moves, np.int16, (-1, 4), "moves")
        offsets = read_only(self.batch_offsets, np.int32, (-1,), "batch_offsets")
        if len(offsets) == 0 or offsets[0] != 0 or offsets[-1] != len(moves):
            raise ValueError(f"batch_offsets must run from 0 to the number of moves, {len(moves)}")
        if (offsets[1:] < offsets[:-1]).any():
            raise ValueError("batch_offsets must not decrease")
        n_batches = len(offsets) - 1
        linked = self.linked if len(self.linked) else np.zeros(n_batches, np.bool_)
        object.__setattr__(self, "moves", moves)
        object.__setattr__(self, "batch_offsets", offsets)
        object.__setattr__(self, "linked", read_only(linked, np.bool_, (n_batches,), "linked"))

    @classmethod
    def from_batches(cls, batches: Sequence[Batch | tuple[ArrayLike, ArrayLike]]) -> Plan:
        """Build a plan from batches, or from pairs (from_sites, to_sites).

        Example:
            >>> Plan.from_batches([([(0, 0)], [(0, 3)])]).n_atom_moves
            1
        """
        made = [b if isinstance(b, Batch) else Batch(_sites(b[0]), _sites(b[1])) for b in batches]
        offsets = np.cumsum([0, *(len(batch) for batch in made)], dtype=np.int32)
        moves = np.empty((int(offsets[-1]), 4), np.int16)
        for batch, start in zip(made, offsets, strict=False):
            moves[start : start + len(batch), :2] = batch.from_sites
            moves[start : start + len(batch), 2:] = batch.to_sites
        return cls(moves, offsets, np.array([batch.linked for batch in made], np.bool_))

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return len(self.batch_offsets) - 1

    @property
    def n_atom_moves(self) -> int:
        """Number of atom moves, over all batches."""
        return len(self.moves)

    @property
    def batches(self) -> tuple[Batch, ...]:
        """The batches, as views of the flat arrays."""
        return tuple(self.batch(i) for i in range(self.n_batches))

    def batch(self, index: int) -> Batch:
        """One batch, as a view of the flat arrays."""
        start, stop = self.batch_offsets[index : index + 2]
        moves = self.moves[start:stop]
        return Batch(moves[:, :2], moves[:, 2:], bool(self.linked[index]))

    def first(self, n_batches: int) -> Plan:
        """The plan cut after its first ``n_batches`` batches."""
        offsets = self.batch_offsets[: n_batches + 1]
        return Plan(self.moves[: offsets[-1]], offsets, self.linked[:n_batches])


@dataclass(frozen=True, slots=True, eq=False)
class PlanReport:
    """The effect of a checked plan.

    Attributes:
        predicted: bool (n_rows, n_cols), occupancy after the plan if no atom is lost.
        batch_end_s: float64 (n_batches,), time from the start of the cycle to the
            end of each batch, overheads included.
        n_tweezers: int32 (n_batches,), mobile tweezers on in each batch, crossings
            that carry no atom included.
        n_defects: Empty target sites after the plan.
        n_surplus: Atoms left on sites that must be empty.
    """

    predicted: NDArray[np.bool_]
    batch_end_s: NDArray[np.float64]
    n_tweezers: NDArray[np.int32]
    n_defects: int
    n_surplus: int

    @property
    def duration_s(self) -> float:
        """Time from the start of the cycle to the end of its last batch (0 for an empty plan)."""
        return float(self.batch_end_s[-1]) if len(self.batch_end_s) else 0.0

    @property
    def meets_target(self) -> bool:
        """Whether the plan, if no atom is lost, ends with the target exactly met."""
        return self.n_defects == 0 and self.n_surplus == 0


def _sites(values: ArrayLike) -> NDArray[Any]:
    array: NDArray[Any] = np.asarray(values)
    return array.reshape(-1, 2) if array.size == 0 else array
