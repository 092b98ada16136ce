"""Plans: batches of atom moves, and the report of a checked plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.model.grid import read_only


@dataclass(frozen=True, slots=True, eq=False)
class TonePaths:
    """Paths of the tones of a batch, and the knots at which tones are ramped down.

    All tones are ramped up at knot 0. From one knot to the next each tone goes straight, and at any time all
    have covered the same fraction of their paths. Positions are in sites, with the numbers of rows and
    columns. A *lane* has a fractional position between two rows or columns. At a knot where tones are ramped
    down, the others wait.

    Attributes:
        row: float64 (n_knots, n_row_tones), position of each row tone at each of at least two knots.
        column: float64 (n_knots, n_column_tones), the same for the column tones.
        row_off: int32 (n_row_tones,), the knot at which each row tone is ramped down, by default the last.
        column_off: int32 (n_column_tones,), the same for the column tones. In both axes at least one tone
            must stay on until the last knot.

    Raises:
        ValueError: A position is not finite, there are fewer than two knots, an axis has no tones, a tone
            goes off at knot 0 or after the last knot, or no tone stays on until the last knot.

    Example:
        >>> paths = TonePaths([[0.0, 2.0], [0.5, 2.5]], [[3.0], [3.0]])
        >>> paths.shape, paths.row_off.tolist()
        ((2, 2, 1), [1, 1])
    """

    row: NDArray[np.float64]
    column: NDArray[np.float64]
    row_off: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    column_off: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))

    def __post_init__(self) -> None:
        row = read_only(self.row, np.float64, (-1, -1), "row")
        column = read_only(self.column, np.float64, (len(row), -1), "column")
        if len(row) < 2 or not row.shape[1] or not column.shape[1]:
            raise ValueError(f"paths need at least two knots and one tone of each axis, not {self._text()}")
        if not (np.isfinite(row).all() and np.isfinite(column).all()):
            raise ValueError("a position of a tone is not finite")
        object.__setattr__(self, "row", row)
        object.__setattr__(self, "column", column)
        last = len(row) - 1
        for name, path in (("row_off", row), ("column_off", column)):
            n_tones = path.shape[1]
            given = getattr(self, name)
            off = read_only(given if len(given) else np.full(n_tones, last), np.int32, (n_tones,), name)
            if off.min() < 1 or off.max() != last:
                raise ValueError(
                    f"{name} must have knots from 1 to the last, {last}, and at least one must be the last"
                )
            object.__setattr__(self, name, off)

    def _text(self) -> str:
        return f"{np.shape(self.row)} and {np.shape(self.column)} positions"

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of knots, of row tones and of column tones."""
        return *self.row.shape, self.column.shape[1]

    def tones_of(self, sites: ArrayLike) -> NDArray[np.intp]:
        """The tones whose crossings start on sites.

        Args:
            sites: (n, 2), (row, col) of each.

        Returns:
            int (n, 2), row tone and column tone of each site, -1 if no tone starts there.
        """
        wanted = np.asarray(sites).reshape(-1, 2)
        tones = np.full(wanted.shape, -1)
        for axis, path in enumerate((self.row, self.column)):
            site, tone = np.nonzero(wanted[:, axis, None] == path[0])
            tones[site, axis] = tone
        return tones

    def path_of(self, row_tone: int, column_tone: int) -> NDArray[np.float64]:
        """Positions of a crossing at each knot until it goes off, float64 (n, 2), in sites."""
        end = min(self.row_off[row_tone], self.column_off[column_tone]) + 1
        return np.stack([self.row[:end, row_tone], self.column[:end, column_tone]], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Atom moves that are carried out at the same time.

    Without ``tones`` it is a *line batch*, in which all atoms go straight along the same axis at one speed.
    With ``tones`` the tones of both axes can take any paths. The moves must then include every crossing that
    starts on an atom.

    Attributes:
        from_sites: int16 (n, 2), (row, col) of each atom before.
        to_sites: int16 (n, 2), (row, col) of each atom after. A site outside the grid ejects the atom.
        linked: Whether the tweezers stay on from the batch before, without drop-off and pick-up in
            between. Only line batches can be linked.
        tones: The paths of the tones. None for a line batch.

    Example:
        Two atoms of row 0 go to row 2 along lanes between columns, each to another column.

        >>> paths = TonePaths(
        ...     row=[[0.0], [0.5], [1.5], [2.0]],
        ...     column=[[0.0, 2.0], [0.5, 2.5], [0.5, 2.5], [1.0, 3.0]],
        ... )
        >>> len(Batch([(0, 0), (0, 2)], [(2, 1), (2, 3)], tones=paths))
        2
    """

    from_sites: NDArray[np.int16]
    to_sites: NDArray[np.int16]
    linked: bool = False
    tones: TonePaths | None = None

    def __post_init__(self) -> None:
        from_sites = read_only(self.from_sites, np.int16, (-1, 2), "from_sites")
        object.__setattr__(self, "from_sites", from_sites)
        to_sites = read_only(self.to_sites, np.int16, (len(from_sites), 2), "to_sites")
        object.__setattr__(self, "to_sites", to_sites)
        if self.linked and self.tones is not None:
            raise ValueError("only line batches can be linked; use one batch with more knots instead")

    def __len__(self) -> int:
        return len(self.from_sites)


NO_SHAPES: Final[NDArray[np.int32]] = read_only([], np.int32, (-1, 3), "path_shapes")
NO_POSITIONS: Final[NDArray[np.float64]] = read_only([], np.float64, (-1,), "path_positions")
NO_KNOTS: Final[NDArray[np.int32]] = read_only([], np.int32, (-1,), "path_off")


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Batches in order, stored as flat arrays.

    :func:`labseq.check_plan` computes predicted occupancy and duration, never the planner. It also checks the
    paths.

    Attributes:
        moves: int16 (n_atom_moves, 4), (from row, from col, to row, to col).
        batch_offsets: int32 (n_batches + 1,). Batch i is ``moves[o[i]:o[i + 1]]``.
        linked: bool (n_batches,), see :class:`Batch`.
        path_shapes: int32 (n_batches, 3), numbers of knots, row tones and column tones of each batch. They
            are 0 for a line batch. A plan with only line batches has shape (0, 3).
        path_positions: float64, for each batch with paths ``row.ravel()``, then ``column.ravel()`` of
            :class:`TonePaths`.
        path_off: int32, for each batch with paths ``row_off``, then ``column_off``.
    """

    moves: NDArray[np.int16]
    batch_offsets: NDArray[np.int32]
    linked: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    path_shapes: NDArray[np.int32] = field(default_factory=lambda: NO_SHAPES)
    path_positions: NDArray[np.float64] = field(default_factory=lambda: NO_POSITIONS)
    path_off: NDArray[np.int32] = field(default_factory=lambda: NO_KNOTS)

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
        if self.path_shapes is not NO_SHAPES or len(self.path_positions) or len(self.path_off):
            self._check_paths(n_batches)

    def is_same(self, other: Plan) -> bool:
        """Whether another plan has the same moves in the same batches, along the same paths."""
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    def _check_paths(self, n_batches: int) -> None:
        shapes = read_only(self.path_shapes, np.int32, (-1, 3), "path_shapes")
        positions = read_only(self.path_positions, np.float64, (-1,), "path_positions")
        off = read_only(self.path_off, np.int32, (-1,), "path_off")
        if len(shapes) not in (0, n_batches):
            raise ValueError(f"path_shapes has {len(shapes)} rows, but the plan has {n_batches} batches")
        stop, off_stop = _path_ends(shapes)
        if (shapes < 0).any() or (len(positions), len(off)) != (stop, off_stop):
            given = f"{len(positions)} and {len(off)} are given"
            raise ValueError(f"path_shapes requires {stop} positions and {off_stop} knots, but {given}")
        object.__setattr__(self, "path_shapes", shapes if shapes.any() else NO_SHAPES)
        object.__setattr__(self, "path_positions", positions)
        object.__setattr__(self, "path_off", off)

    @classmethod
    def from_batches(cls, batches: Sequence[Batch | tuple[ArrayLike, ArrayLike]]) -> Plan:
        """Build a plan from batches, or from pairs (from_sites, to_sites).

        Example:
            >>> Plan.from_batches([([(0, 0)], [(0, 3)])]).n_atom_moves
            1
        """
        batch_list = [b if isinstance(b, Batch) else Batch(_sites(b[0]), _sites(b[1])) for b in batches]
        offsets = np.cumsum([0, *(len(batch) for batch in batch_list)], dtype=np.int32)
        moves = np.empty((int(offsets[-1]), 4), np.int16)
        for batch, start in zip(batch_list, offsets, strict=False):
            moves[start : start + len(batch), :2] = batch.from_sites
            moves[start : start + len(batch), 2:] = batch.to_sites
        linked = np.array([batch.linked for batch in batch_list], np.bool_)
        return cls(moves, offsets, linked, *_flat_paths([batch.tones for batch in batch_list]))

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
        """The batch with an index, as a view of the flat arrays."""
        start, stop = self.batch_offsets[index : index + 2]
        moves = self.moves[start:stop]
        return Batch(moves[:, :2], moves[:, 2:], bool(self.linked[index]), self.paths(index))

    @property
    def has_paths(self) -> bool:
        """Whether any batch has paths of tones."""
        return len(self.path_positions) > 0

    def paths(self, index: int) -> TonePaths | None:
        """Paths of the tones of one batch, as views of the flat arrays, or None for a line batch."""
        if not len(self.path_shapes) or not self.path_shapes[index].any():
            return None
        start, off_start = _path_ends(self.path_shapes[:index])
        n_knots, n_rows, n_cols = self.path_shapes[index].tolist()
        rows = self.path_positions[start : start + n_knots * n_rows]
        columns = self.path_positions[start + len(rows) : start + len(rows) + n_knots * n_cols]
        off = self.path_off[off_start : off_start + n_rows + n_cols]
        return TonePaths(
            rows.reshape(n_knots, n_rows), columns.reshape(n_knots, n_cols), off[:n_rows], off[n_rows:]
        )

    def first(self, n_batches: int) -> Plan:
        """The plan cut after its first ``n_batches`` batches."""
        return self.part(0, n_batches)

    def part(self, start: int, stop: int) -> Plan:
        """Batches ``start`` to ``stop - 1``, which must not cut a chain of linked batches."""
        offsets = self.batch_offsets[start : stop + 1]
        batches = self.moves[offsets[0] : offsets[-1]], offsets - offsets[0], self.linked[start:stop]
        if not self.has_paths:
            return Plan(*batches)
        (at, off_at), (end, off_end) = (_path_ends(self.path_shapes[:n]) for n in (start, stop))
        paths = self.path_shapes[start:stop], self.path_positions[at:end], self.path_off[off_at:off_end]
        return Plan(*batches, *paths)


@dataclass(frozen=True, slots=True, eq=False)
class PlanReport:
    """The effect of a checked plan.

    Attributes:
        predicted: bool (n_rows, n_cols), occupancy after the plan if no atom is lost.
        batch_end_s: float64 (n_batches,), time from the start of the cycle to the
            end of each batch, overheads included.
        n_tweezers: int32 (n_batches,), number of mobile tweezers on in each batch, including crossings
            without an atom.
        n_defects: Number of empty target sites after the plan.
        n_surplus: Number of atoms left on sites that must be empty.
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
        """Whether the plan meets the target exactly if no atom is lost."""
        return self.n_defects == 0 and self.n_surplus == 0


def _sites(values: ArrayLike) -> NDArray[Any]:
    array: NDArray[Any] = np.asarray(values)
    return array.reshape(-1, 2) if array.size == 0 else array


def _path_ends(shapes: NDArray[np.int32]) -> tuple[int, int]:
    """Numbers of positions and of knots in :class:`Plan` for the given batches."""
    if not len(shapes):
        return 0, 0
    n_tones = shapes[:, 1].astype(np.int64) + shapes[:, 2]
    return int(shapes[:, 0] @ n_tones), int(n_tones.sum())


def _flat_paths(
    paths: Sequence[TonePaths | None],
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]:
    """The last three arrays of a :class:`Plan`."""
    if not any(paths):
        return NO_SHAPES, NO_POSITIONS, NO_KNOTS
    shapes = np.array([(0, 0, 0) if path is None else path.shape for path in paths], np.int32)
    positions = [part.ravel() for path in paths if path for part in (path.row, path.column)]
    off = [part for path in paths if path for part in (path.row_off, path.column_off)]
    return shapes, np.concatenate(positions), np.concatenate(off)
