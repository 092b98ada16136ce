"""Draws an occupancy as the array looks."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.style import Style
from rich.text import Text

from labseq.cli.glyphs import Glyphs
from labseq.model import Occupancy, TargetPattern

EMPTY, RESERVOIR, SURPLUS, ATOM, DEFECT = range(5)

_COLOURS: Final = ("default", "bright_black", "yellow", "green", "red")
_STYLES: Final = tuple(Style(color=colour, bold=i == DEFECT) for i, colour in enumerate(_COLOURS))
_HALVES: Final = {
    (upper, lower): Style(
        color=_COLOURS[upper or lower], bgcolor=_COLOURS[lower] if upper and lower else None
    )
    for upper in range(5)
    for lower in range(5)
}


def kinds(occupancy: Occupancy, target: TargetPattern) -> NDArray[np.int8]:
    """What there is on each site, int8 (n_rows, n_cols): EMPTY, RESERVOIR, SURPLUS, ATOM or DEFECT."""
    atoms = np.where(target.fill, ATOM, np.where(target.clear, SURPLUS, RESERVOIR))
    return np.where(occupancy, atoms, np.where(target.fill, DEFECT, EMPTY)).astype(np.int8)


@dataclass(frozen=True, slots=True)
class Scale:
    """How large the sites are drawn.

    Attributes:
        cell: Characters per site along a row.
        rows: Rows of sites per line.
    """

    cell: int
    rows: int

    def size(self, n_rows: int, n_cols: int, sheared: bool) -> tuple[int, int]:
        """Width and height of the drawing, in characters."""
        height = -(-n_rows // self.rows)
        return n_cols * self.cell + (self._shift(n_rows - 1) if sheared else 0), height

    def indent(self, row: int, n_rows: int, shear: int) -> int:
        """By how many characters a row is moved to the right: half a site per row."""
        if not shear:
            return 0
        return self._shift(row) if shear > 0 else self._shift(n_rows - 1) - self._shift(row)

    def _shift(self, row: int) -> int:
        return row * self.cell // 2


ROOMY: Final = Scale(cell=2, rows=1)
DENSE: Final = Scale(cell=1, rows=1)
HALF_BLOCKS: Final = Scale(cell=1, rows=2)


def scales(glyphs: Glyphs) -> tuple[Scale, ...]:
    """The scales that these characters allow, largest first."""
    return (ROOMY, DENSE, HALF_BLOCKS) if glyphs.upper else (ROOMY, DENSE)


def draw_array(
    occupancy: Occupancy, target: TargetPattern, shear: int, scale: Scale, glyphs: Glyphs
) -> list[Text]:
    """Draw an occupancy, a line of text per row of sites (or per two rows).

    Args:
        occupancy: bool (n_rows, n_cols).
        target: What the array shall look like.
        shear: +1 if rows shift to the right on the way down, -1 to the left, 0 on a square lattice.
        scale: How large.
        glyphs: The characters to draw with.
    """
    n_rows = len(occupancy)
    rows: list[list[int]] = kinds(occupancy, target).tolist()
    if scale.rows == 1:
        lines = [_glyph_line(row, scale.cell, glyphs) for row in rows]
    else:
        blank = [EMPTY] * len(rows[0])
        lines = [_block_line(a, b, glyphs) for a, b in zip(rows[::2], [*rows[1::2], blank], strict=False)]
    for i, line in enumerate(lines):
        line.pad_left(scale.indent(i * scale.rows, n_rows, shear))
    return lines


def _glyph_line(row: list[int], cell: int, glyphs: Glyphs) -> Text:
    characters = (" ", glyphs.reservoir, glyphs.surplus, glyphs.atom, glyphs.defect)
    line = Text()
    for kind, run in groupby(row):
        line.append(characters[kind].ljust(cell) * len(list(run)), _STYLES[kind])
    return line


def _block_line(upper: list[int], lower: list[int], glyphs: Glyphs) -> Text:
    line = Text()
    for (a, b), run in groupby(zip(upper, lower, strict=True)):
        block = glyphs.both if a == b != EMPTY else glyphs.upper if a else glyphs.lower if b else " "
        line.append(block * len(list(run)), _HALVES[a, b])
    return line
