"""Which batches share a panel of a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Any, Final

from labseq.drawing.batches import Axis, BatchSummary, lines_label

MAX_PANELS: Final = 38
"""Most panels of batches; with the ones before and after that makes 40."""
MAX_WORDS: Final = 24
"""Characters for the lines in a panel's title; if they are more, the lines are only counted."""


@dataclass(frozen=True, slots=True)
class Panel:
    """Batches that are drawn together.

    Attributes:
        first: Index of the first batch.
        last: Index of the last one.
        moves_along: Axis and sorted lines, one pair for each axis.
    """

    first: int
    last: int
    moves_along: tuple[tuple[Axis, tuple[int, ...]], ...]

    @property
    def n_batches(self) -> int:
        """How many batches."""
        return self.last - self.first + 1

    @property
    def title(self) -> str:
        """Numbers of the batches, from 1, and the lines that they move along.

        Example:
            >>> Panel(2, 4, (("row", (7, 9)),)).title
            'batches 3-5: rows 7, 9'
        """
        numbers = f"batch {self.first + 1}" if self.n_batches == 1 else f"batches {self._numbers}"
        return f"{numbers}: " + "; ".join(_words(axis, lines) for axis, lines in self.moves_along)

    @property
    def _numbers(self) -> str:
        return f"{self.first + 1}-{self.last + 1}"


def make_panels(summaries: Sequence[BatchSummary], max_panels: int = MAX_PANELS) -> list[Panel]:
    """Share out batches among panels, in order.

    A batch has a panel of its own if there are enough. If not, successive batches
    along the same lines share one; then as many successive batches along the same
    axis as it takes, evenly; and only if the axis changes too often, any.

    Args:
        stories: The batches.
        max_panels: Most panels, at least 1.

    Example:
        >>> rows = [BatchSummary("row", (i // 2,), 3, 0, 5) for i in range(8)]
        >>> [(panel.first, panel.last) for panel in make_panels(rows, 4)]
        [(0, 1), (2, 3), (4, 5), (6, 7)]
    """
    groups = [[i] for i in range(len(summaries))]
    if len(groups) > max_panels:
        groups = _together(summaries, lambda summary: (summary.axis, summary.lines))
    if len(groups) > max_panels:
        phases = _together(summaries, lambda summary: summary.axis)
        if len(phases) > max_panels:
            phases = [list(range(len(summaries)))]
        groups = _evenly(phases, max_panels)
    return [_panel(summaries, group) for group in groups]


def _words(axis: Axis, lines: tuple[int, ...]) -> str:
    words = lines_label(axis, lines)
    return words if len(words) <= MAX_WORDS else f"{len(lines)} {axis}s"


def _together(summaries: Sequence[BatchSummary], key: Callable[[BatchSummary], Any]) -> list[list[int]]:
    runs = groupby(range(len(summaries)), lambda i: key(summaries[i]))
    return [list(run) for _, run in runs]


def _evenly(phases: list[list[int]], max_panels: int) -> list[list[int]]:
    """Cut phases into pieces of about the same length, the shortest that are few enough."""
    size = 1
    while sum(-(-len(phase) // size) for phase in phases) > max_panels:
        size += 1
    pieces: list[list[int]] = []
    for phase in phases:
        n = -(-len(phase) // size)
        cuts = [round(i * len(phase) / n) for i in range(n + 1)]
        pieces += [phase[a:b] for a, b in pairwise(cuts)]
    return pieces


def _panel(summaries: Sequence[BatchSummary], group: list[int]) -> Panel:
    lines: dict[Axis, set[int]] = {}
    for i in group:
        lines.setdefault(summaries[i].axis, set()).update(summaries[i].lines)
    return Panel(group[0], group[-1], tuple((axis, tuple(sorted(found))) for axis, found in lines.items()))
