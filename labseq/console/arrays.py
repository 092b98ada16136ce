"""Occupancies drawn as text, with one character per site or per two rows of sites."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.style import Style
from rich.text import Text

from labseq.console.text import encodes
from labseq.model import Occupancy, TargetPattern

EMPTY, RESERVOIR, SURPLUS, ATOM, DEFECT = range(5)
"""State of a site. RESERVOIR is an atom outside the target, SURPLUS an atom where none is allowed, ATOM an
atom on a target site, and DEFECT a target site without an atom."""

_COLOURS: Final = ("default", "bright_black", "yellow", "green", "red")
_STYLES: Final = tuple(Style(color=colour, bold=i == DEFECT) for i, colour in enumerate(_COLOURS))


@dataclass(frozen=True, slots=True)
class Glyphs:
    """The characters with which arrays are drawn.

    Attributes:
        sites: One character for each of EMPTY, RESERVOIR, SURPLUS, ATOM and DEFECT.
        levels: A cell that is filled from below, from the lowest level to the whole cell.
        blocks: Upper half, lower half and whole cell. "" without half blocks.
    """

    sites: str
    levels: str
    blocks: str = ""


UNICODE: Final = Glyphs(" ·×●○", "▁▂▃▄▅▆▇█", "▀▄█")  # noqa: RUF001 - a multiplication sign
ASCII: Final = Glyphs(" .x@o", ".:#")


def glyphs_for(encoding: str | None) -> Glyphs:
    """The characters that a terminal with this encoding can show.

    Example:
        >>> glyphs_for("cp1252").sites
        ' .x@o'
    """
    return UNICODE if encodes(encoding, UNICODE.sites + UNICODE.levels + UNICODE.blocks) else ASCII


@dataclass(frozen=True, slots=True)
class Scale:
    """Size of a site in the drawing, in characters.

    Attributes:
        cell: Characters per site along a row.
        rows: Rows of sites per line of text.
    """

    cell: int
    rows: int

    def size(self, n_rows: int, n_cols: int, shear: int) -> tuple[int, int]:
        """Width and height of the drawing in characters. ``shear`` is as for :func:`draw_array`."""
        return n_cols * self.cell + self.indent(0 if shear < 0 else n_rows - 1, n_rows, shear), -(
            -n_rows // self.rows
        )

    def indent(self, row: int, n_rows: int, shear: int) -> int:
        """Number of characters by which a row is shifted to the right, which is half a site per row."""
        last = n_rows - 1
        return abs(shear) * (
            row * self.cell // 2 if shear > 0 else last * self.cell // 2 - row * self.cell // 2
        )


ROOMY: Final = Scale(cell=2, rows=1)
DENSE: Final = Scale(cell=1, rows=1)
HALF_BLOCKS: Final = Scale(cell=1, rows=2)


def scales(glyphs: Glyphs) -> tuple[Scale, ...]:
    """The possible scales with these characters, largest first."""
    return (ROOMY, DENSE, HALF_BLOCKS) if glyphs.blocks else (ROOMY, DENSE)


def site_kinds(occupancy: Occupancy, target: TargetPattern) -> NDArray[np.int8]:
    """The state of each site, int8 (n_rows, n_cols): EMPTY, RESERVOIR, SURPLUS, ATOM or DEFECT."""
    atoms = np.where(target.fill, ATOM, np.where(target.clear, SURPLUS, RESERVOIR))
    return np.where(occupancy, atoms, np.where(target.fill, DEFECT, EMPTY)).astype(np.int8)


def draw_array(
    occupancy: Occupancy, target: TargetPattern, shear: int, scale: Scale, glyphs: Glyphs
) -> list[Text]:
    """Draw an occupancy, one line of text per row of sites (or per two rows)."""
    rows: list[list[int]] = site_kinds(occupancy, target).tolist()
    n_rows = len(rows)
    if scale.rows == 1:
        lines = [_site_line(row, scale.cell, glyphs) for row in rows]
    else:
        rows.append([EMPTY] * len(rows[0]))
        lines = [_half_line(rows[i], rows[i + 1], glyphs) for i in range(0, n_rows, 2)]
    for i, line in enumerate(lines):
        line.pad_left(scale.indent(i * scale.rows, n_rows, shear))
    return lines


def _site_line(row: list[int], cell: int, glyphs: Glyphs) -> Text:
    line = Text(no_wrap=True)
    for kind, sites in groupby(row):
        line.append(glyphs.sites[kind].ljust(cell) * len(list(sites)), _STYLES[kind])
    return line


def _half_line(upper: list[int], lower: list[int], glyphs: Glyphs) -> Text:
    """Two rows of sites on one line, the upper row in the text's colour and the lower row behind it."""
    half_upper, half_lower, whole = glyphs.blocks
    line = Text(no_wrap=True)
    for (a, b), sites in groupby(zip(upper, lower, strict=True)):
        block = whole if a == b != EMPTY else half_upper if a else half_lower if b else " "
        style = Style(color=_COLOURS[a or b], bgcolor=_COLOURS[b] if a and b else None)
        line.append(block * len(list(sites)), style)
    return line


_GAP: Final = 4
"""Number of characters between two arrays."""
_MIN_WIDTH: Final = len("before")
"""Minimum width of an array in characters."""

Sites = NDArray[np.int16]
_NOWHERE: Final[Sites] = np.empty((0, 2), np.int16)

_KEY: Final = {
    ATOM: "atom on a target site",
    DEFECT: "empty target site",
    SURPLUS: "surplus atom",
    RESERVOIR: "atom in the reservoir",
}


@dataclass(frozen=True, slots=True)
class ArrayPair:
    """Draws two arrays on the same grid, before and after, with numbered rows and columns.

    Attributes:
        target: The target.
        shear: As in :class:`labseq.model.SiteGrid`. 0 on a square lattice.
        width: Number of characters per line.
        glyphs: The characters with which to draw.
    """

    target: TargetPattern
    shear: int
    width: int
    glyphs: Glyphs

    def lines(
        self,
        titles: Sequence[str],
        arrays: Sequence[Occupancy],
        marked: Sequence[Sites] = (_NOWHERE, _NOWHERE),
    ) -> list[Text]:
        """Draw two arrays as large as possible. Return only a note if there is no room.

        Args:
            arrays: Both occupancies, bool (n_rows, n_cols).
            marked: Sites of each array that are shown inverted, int16 (n, 2).
        """
        beside, scale = self._arrangement
        if scale is None:
            n_rows, n_cols = self.target.shape
            return [Text(f"({n_rows} x {n_cols} sites do not fit into {self.width} characters)", "dim")]
        drawn = [
            [Text(title, "bold"), *self._numbered(self._draw(array, sites, scale), scale)]
            for title, array, sites in zip(titles, arrays, marked, strict=True)
        ]
        if not beside:
            return [*drawn[0], Text(), *drawn[1]]
        left_width = max(line.cell_len for line in drawn[0])
        lines: list[Text] = []
        for left, right in zip(*drawn, strict=True):
            left.pad_right(left_width + _GAP - left.cell_len)
            lines.append(Text.assemble(left, right))
        return lines

    def key(self, *arrays: Occupancy) -> Text:
        """Explain the characters that occur in these arrays. Empty if there are none."""
        if self._arrangement[1] is None:
            return Text()
        shown = {int(kind) for array in arrays for kind in np.unique(site_kinds(array, self.target))}
        parts = [
            Text.assemble((self.glyphs.sites[kind], _STYLES[kind]), f" {text}")
            for kind, text in _KEY.items()
            if kind in shown
        ]
        return Text("   ").join(parts)

    @property
    def _arrangement(self) -> tuple[bool, Scale | None]:
        """Whether the arrays are drawn side by side, and the scale. None if they do not fit."""
        widths = [(scale, scale.size(*self.target.shape, self.shear)[0]) for scale in (ROOMY, DENSE)]
        for beside in (True, False):
            for scale, width in widths:
                each = max(width + self._margin, _MIN_WIDTH)
                if (2 * each + _GAP if beside else each) <= self.width:
                    return beside, scale
        return False, None

    @property
    def _margin(self) -> int:
        """Width of the row numbers in characters."""
        return len(str(self.target.shape[0] - 1)) + 1

    def _draw(self, array: Occupancy, marked: Sites, scale: Scale) -> list[Text]:
        lines = draw_array(array, self.target, self.shear, scale, self.glyphs)
        for row, col in marked.tolist():
            line, at = lines[row], self._column(row, col, scale)
            line.pad_right(max(0, at + 1 - line.cell_len))
            line.stylize("reverse", at, at + 1)
        return lines

    def _column(self, row: int, col: int, scale: Scale) -> int:
        """The column of a site in its line of text."""
        return scale.indent(row, self.target.shape[0], self.shear) + col * scale.cell

    def _numbered(self, lines: list[Text], scale: Scale) -> list[Text]:
        """Number the rows on the left, and every fifth column above the first row."""
        head = ""
        for col in range(0, self.target.shape[1], 5):
            head = head.ljust(self._margin + self._column(0, col, scale)) + str(col)
        width = self._margin + scale.size(*self.target.shape, self.shear)[0]
        numbered = [Text(head if len(head) <= width else head.rstrip("0123456789"), "dim")]
        for i, line in enumerate(lines):
            number = f"{i:>{self._margin - 1}} "
            numbered.append(Text.assemble((number, "dim"), line))
        return numbered
