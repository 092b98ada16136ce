"""A plan batch by batch, in words and drawn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from rich.text import Text

from labseq.cli.plan_canvas import Canvas
from labseq.cli.words import plural
from labseq.drawing import occupancies, on_grid
from labseq.model import Batch
from labseq.session import PlannedMoves
from labseq.units import format_quantity


@dataclass(frozen=True, slots=True)
class Steps:
    """What is shown of each batch.

    Attributes:
        moves: The plan.
        canvas: Draws the array.
        arrow: Stands between the ends of a move.
    """

    moves: PlannedMoves
    canvas: Canvas
    arrow: str

    def __iter__(self) -> Iterator[list[Text]]:
        plan, shape = self.moves.plan, self.moves.grid.shape
        arrays = occupancies(plan, self.moves.occupancy)
        for i, batch in enumerate(plan.batches):
            landed = batch.to_sites[on_grid(batch.to_sites, shape)]
            drawn = self.canvas.pair(("before", "after"), arrays[i : i + 2], (batch.from_sites, landed))
            yield [
                Text.assemble((f"batch {i + 1} of {plan.n_batches}", "bold"), "  ", self._words(i, batch)),
                *(Text(f"  {line}") for line in moves_text(batch, shape, self.arrow)),
                *drawn,
            ]

    def _words(self, index: int, batch: Batch) -> str:
        report = self.moves.report
        n_ejected = int(np.count_nonzero(~on_grid(batch.to_sites, self.moves.grid.shape)))
        parts = [
            plural(len(batch), "atom") + (f", {n_ejected} ejected" if n_ejected else ""),
            plural(int(report.n_tweezers[index]), "tweezer"),
            f"done at {format_quantity(float(report.batch_end_s[index]), 'time')}",
        ]
        if batch.linked:
            parts.append("with the tweezers still on from the batch before")
        return ", ".join(parts)


def moves_text(batch: Batch, shape: tuple[int, int], arrow: str = "->") -> list[str]:
    """Name the moves of a batch, a line of text per row or column.

    Args:
        batch: The batch.
        shape: (n_rows, n_cols) of the grid.
        arrow: Stands between the ends of a move.

    Example:
        >>> moves_text(Batch([(2, 0), (2, 4)], [(2, 3), (2, 5)]), (5, 5))
        ['row 2: columns 0->3, 4->ejected']
    """
    along_column = bool(np.any(batch.from_sites[:, 0] != batch.to_sites[:, 0]))
    line_index, place = (1, 0) if along_column else (0, 1)
    line_name, place_name = ("column", "row") if along_column else ("row", "column")
    stays = on_grid(batch.to_sites, shape).tolist()
    found: dict[int, list[str]] = {}
    for start, end, lands in zip(batch.from_sites.tolist(), batch.to_sites.tolist(), stays, strict=True):
        goal = end[place] if lands else "ejected"
        found.setdefault(start[line_index], []).append(f"{start[place]}{arrow}{goal}")
    return [
        f"{line_name} {line}: {place_name}{'s' if len(ways) > 1 else ''} {', '.join(ways)}"
        for line, ways in sorted(found.items())
    ]
