"""A scan: which addresses change from shot to shot, and the values they take."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from labseq.config.document import Document
from labseq.config.nodes import Loc, Mark, Node
from labseq.config.wording import clean
from labseq.errors import ConfigError, Problem

if TYPE_CHECKING:
    from labseq.config.adaptive import Adaptive

ScanOrder = Literal["sequential", "shuffled"]

PROFILE: Final = "profile."
"""What the addresses of profile values begin with."""

_ORDER_KEY: Final = 0x5CA4  # apart from every shot's own random numbers, whose keys have two parts


@dataclass(frozen=True, slots=True)
class Axis:
    """One scanned address.

    Attributes:
        address: As written: "planner.degree_of_parallelism", "profile.mobile_tweezers.speed".
        loc: Where its value is, in the sequence or in the profile.
        values: One per position of its group.
        key: Where the address stands.
    """

    address: str
    loc: Loc
    values: tuple[Node, ...]
    key: Mark

    @property
    def of_profile(self) -> bool:
        """Whether the value is the profile's."""
        return self.address.startswith(PROFILE)


Group = tuple[Axis, ...]
"""Axes that go together: all have as many values."""


@dataclass(frozen=True, slots=True)
class Scan:
    """The points of a scan: the outer product of its groups, the first slowest.

    Attributes:
        name: The sequence's name in messages.
        groups: The groups, in the order written; without any there is one point.
        repeats: Shots of each point.
        order: "sequential" or "shuffled".
        notes: What the user should know, for example that ``--set`` replaced an axis.
        adaptive: What chooses the points, if they are not known beforehand: then the groups are of one
            axis each, whose two values are the ends of its range.
    """

    name: str
    groups: tuple[Group, ...]
    repeats: int
    order: ScanOrder
    notes: tuple[str, ...] = ()
    adaptive: Adaptive | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of positions of each group."""
        return tuple(len(group[0].values) for group in self.groups)

    @property
    def n_points(self) -> int:
        """Number of points; of an adaptive scan, the most that there may be."""
        return math.prod(self.shape) if self.adaptive is None else self.adaptive.n_points

    @property
    def axes(self) -> tuple[Axis, ...]:
        """All axes, in the order written."""
        return tuple(axis for group in self.groups for axis in group)

    def positions(self, point: int) -> tuple[int, ...]:
        """The position in each group that makes a point, counted from 0."""
        return tuple(int(i) for i in np.unravel_index(point, self.shape)) if self.groups else ()

    def values(self, point: int) -> Iterator[tuple[Axis, Node]]:
        """Each axis with its value at a point."""
        for group, position in zip(self.groups, self.positions(point), strict=True):
            for axis in group:
                yield axis, axis.values[position]

    def points_of_shots(self, seed: int) -> NDArray[np.int32]:
        """The point of each shot, int32 (n_points * repeats,).

        Sequential: all shots of a point, then the next. Shuffled: round by round; each round
        takes every point once, in an order drawn from the run's seed, so that a drift of the
        machine meets all points alike, also in a run that is stopped early.
        """
        points = np.arange(self.n_points, dtype=np.int32)
        if self.order == "sequential":
            return np.repeat(points, self.repeats)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_ORDER_KEY,)))
        return np.concatenate([rng.permutation(points) for _ in range(self.repeats)])

    def at(self, values: Sequence[float]) -> Scan:
        """A point of an adaptive scan, as a scan of that point alone.

        Args:
            values: A value for each axis, SI.
        """
        assert self.adaptive is not None
        pairs = zip(self.axes, self.adaptive.ends, values, strict=True)
        groups = tuple((replace(axis, values=(ends.node(value),)),) for axis, ends, value in pairs)
        return replace(self, groups=groups)

    def begun(self, document: Document, *, profile: bool) -> Document:
        """A copy of the sequence or of the profile with the values that a run begins with.

        Those of the first point; of an adaptive scan, which has none yet, those of the file.
        """
        return document if self.adaptive is not None else self.put(document, 0, profile=profile)

    def put(self, document: Document, point: int, *, profile: bool) -> Document:
        """A copy of the sequence or of the profile with the values of a point."""
        root = document.written
        for axis, node in self.values(point):
            if axis.of_profile == profile:
                root = root.replaced(axis.loc, node)
        return document.replaced(root)

    def explained(self, error: ConfigError) -> ConfigError:
        """An error that says of each wrong value which address the scan puts it into."""
        places = {
            (mark.line, mark.column): axis.address
            for axis in self.axes
            for node in axis.values
            for mark in _marks(node)
        }

        def with_address(problem: Problem) -> Problem:
            address = places.get((problem.line, problem.column)) if problem.source == self.name else None
            note = f"the scan puts it into '{clean(address or '')}'"
            is_told = address is None or note in problem.notes
            return problem if is_told else replace(problem, notes=(*problem.notes, note))

        return ConfigError([with_address(problem) for problem in error.problems])


def _marks(node: Node) -> Iterator[Mark]:
    yield node.mark
    yield from node.keys.values()
    if isinstance(node.value, dict | list):
        for child in node.value.values() if isinstance(node.value, dict) else node.value:
            yield from _marks(child)
