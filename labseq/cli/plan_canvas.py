"""Two arrays side by side, or one below the other, as wide as the screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from labseq.cli.array import DENSE, ROOMY, Scale, draw_array, kinds
from labseq.cli.glyphs import Glyphs
from labseq.model import Occupancy, TargetPattern

GAP: Final = 4
"""Characters between two arrays."""
LEAST: Final = len("before")
"""Characters that an array takes at least."""

Sites = NDArray[np.int16]
NOWHERE: Final[Sites] = np.empty((0, 2), np.int16)

_KEY: Final = (
    ("atom on a target site", True, True, False),
    ("empty target site", False, True, False),
    ("surplus atom", True, False, True),
    ("atom in the reservoir", True, False, False),
)


@dataclass(frozen=True, slots=True)
class Canvas:
    """Draws arrays of one grid.

    Attributes:
        target: What the array shall look like.
        shear: As of :class:`labseq.model.SiteGrid`; 0 on a square lattice.
        width: Characters per line.
        glyphs: The characters to draw with.
    """

    target: TargetPattern
    shear: int
    width: int
    glyphs: Glyphs

    def pair(
        self,
        titles: Sequence[str],
        arrays: Sequence[Occupancy],
        marked: Sequence[Sites] = (NOWHERE, NOWHERE),
    ) -> list[Text]:
        """Draw two arrays, as large as there is room; no arrays where even small ones find none.

        Args:
            titles: What stands above the one and the other.
            arrays: Both occupancies, bool (n_rows, n_cols).
            marked: Sites on the grid that are shown inverted in them, int16 (n, 2) each.
        """
        beside, scale = self._arrangement
        if scale is None:
            n_rows, n_cols = self.target.shape
            return [Text(f"({n_rows} x {n_cols} sites find no room in {self.width} characters)", "dim")]
        drawn = [
            [Text(title, "bold"), *self._numbered(self._draw(array, sites, scale), scale)]
            for title, array, sites in zip(titles, arrays, marked, strict=True)
        ]
        if not beside:
            return [*drawn[0], Text(), *drawn[1]]
        left_width = max(line.cell_len for line in drawn[0])
        lines: list[Text] = []
        for left, right in zip(*drawn, strict=True):
            left.pad_right(left_width + GAP - left.cell_len)
            lines.append(Text.assemble(left, right))
        return lines

    def key(self, *arrays: Occupancy) -> Text:
        """Explain the characters that occur in these arrays; empty if none does."""
        if self._arrangement[1] is None:
            return Text()
        shown = {int(kind) for array in arrays for kind in np.unique(kinds(array, self.target))}
        parts: list[Text] = []
        for text, atom, fill, clear in _KEY:
            site = np.array([[atom]])
            target = TargetPattern(np.array([[fill]]), np.array([[clear]]))
            if int(kinds(site, target)[0, 0]) in shown:
                parts.append(Text.assemble(draw_array(site, target, 0, DENSE, self.glyphs)[0], f" {text}"))
        return Text("   ").join(parts)

    @property
    def _arrangement(self) -> tuple[bool, Scale | None]:
        """Whether two arrays stand side by side, and the scale; None if there is no room."""
        widths = [(scale, scale.size(*self.target.shape, self.shear != 0)[0]) for scale in (ROOMY, DENSE)]
        for beside in (True, False):
            for scale, width in widths:
                each = max(width + self._margin, LEAST)
                if (2 * each + GAP if beside else each) <= self.width:
                    return beside, scale
        return False, None

    @property
    def _margin(self) -> int:
        """Characters that the row numbers take."""
        return len(str(self.target.shape[0] - 1)) + 1

    def _draw(self, array: Occupancy, marked: Sites, scale: Scale) -> list[Text]:
        lines = draw_array(array, self.target, self.shear, scale, self.glyphs)
        for row, col in marked.tolist():
            line, at = lines[row], self._column(row, col, scale)
            line.pad_right(max(0, at + 1 - line.cell_len))
            line.stylize("reverse", at, at + 1)
        return lines

    def _column(self, row: int, col: int, scale: Scale) -> int:
        """Where a site stands in its line."""
        return scale.indent(row, self.target.shape[0], self.shear) + col * scale.cell

    def _numbered(self, lines: list[Text], scale: Scale) -> list[Text]:
        """Number the rows on the left, and every fifth column above the first row."""
        head = ""
        for col in range(0, self.target.shape[1], 5):
            head = head.ljust(self._margin + self._column(0, col, scale)) + str(col)
        width = self._margin + scale.size(*self.target.shape, self.shear != 0)[0]
        numbered = [Text(head if len(head) <= width else head.rstrip("0123456789"), "dim")]
        for i, line in enumerate(lines):
            number = f"{i:>{self._margin - 1}} "
            numbered.append(Text.assemble((number, "dim"), line))
        return numbered
