"""An occupancy drawn as text: one character per site, or one per two rows of sites."""

from __future__ import annotations

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
"""What is on a site: nothing, or an atom that is outside the target, where it must not be, or on a target
site; or no atom on a target site."""

_COLOURS: Final = ("default", "bright_black", "yellow", "green", "red")
_STYLES: Final = tuple(Style(color=colour, bold=i == DEFECT) for i, colour in enumerate(_COLOURS))


@dataclass(frozen=True, slots=True)
class Glyphs:
    """The characters to draw with.

    Attributes:
        sites: One for each of EMPTY, RESERVOIR, SURPLUS, ATOM and DEFECT.
        levels: A cell that is filled from below, from the least to the whole.
        blocks: Upper half, lower half and whole cell; "" where there are no half blocks.
    """

    sites: str
    levels: str
    blocks: str = ""


UNICODE: Final = Glyphs(" ·×●○", "▁▂▃▄▅▆▇█", "▀▄█")  # noqa: RUF001 - the multiplication sign is meant
ASCII: Final = Glyphs(" .x@o", ".:#")


def glyphs_for(encoding: str | None) -> Glyphs:
    """The characters for a terminal with this encoding.

    Example:
        >>> glyphs_for("cp1252").sites
        ' .x@o'
    """
    return UNICODE if encodes(encoding, UNICODE.sites + UNICODE.levels + UNICODE.blocks) else ASCII


@dataclass(frozen=True, slots=True)
class Scale:
    """How large sites are drawn.

    Attributes:
        cell: Characters per site along a row.
        rows: Rows of sites per line of text.
    """

    cell: int
    rows: int

    def size(self, n_rows: int, n_cols: int, shear: int) -> tuple[int, int]:
        """Width and height of the drawing in characters; ``shear`` as for :func:`draw_array`."""
        return n_cols * self.cell + self.indent(0 if shear < 0 else n_rows - 1, n_rows, shear), -(
            -n_rows // self.rows
        )

    def indent(self, row: int, n_rows: int, shear: int) -> int:
        """How many characters a row is moved to the right: half a site per row."""
        last = n_rows - 1
        return abs(shear) * (
            row * self.cell // 2 if shear > 0 else last * self.cell // 2 - row * self.cell // 2
        )


ROOMY: Final = Scale(cell=2, rows=1)
DENSE: Final = Scale(cell=1, rows=1)
HALF_BLOCKS: Final = Scale(cell=1, rows=2)


def scales(glyphs: Glyphs) -> tuple[Scale, ...]:
    """The scales that these characters allow, largest first."""
    return (ROOMY, DENSE, HALF_BLOCKS) if glyphs.blocks else (ROOMY, DENSE)


def site_kinds(occupancy: Occupancy, target: TargetPattern) -> NDArray[np.int8]:
    """What is on each site, int8 (n_rows, n_cols): EMPTY, RESERVOIR, SURPLUS, ATOM or DEFECT."""
    atoms = np.where(target.fill, ATOM, np.where(target.clear, SURPLUS, RESERVOIR))
    return np.where(occupancy, atoms, np.where(target.fill, DEFECT, EMPTY)).astype(np.int8)


def draw_array(
    occupancy: Occupancy, target: TargetPattern, shear: int, scale: Scale, glyphs: Glyphs
) -> list[Text]:
    """Draw an occupancy, one line of text per row of sites (or per two rows).

    Args:
        occupancy: bool (n_rows, n_cols).
        target: The target.
        shear: +1 if rows shift to the right on the way down, -1 to the left, 0 on a square lattice.
        scale: How large.
        glyphs: The characters to draw with.
    """
    rows: list[list[int]] = site_kinds(occupancy, target).tolist()
    n_rows = len(rows)
    if scale.rows == 1:
        lines = [_site_line(row, scale.cell, glyphs) for row in rows]
    else:
        rows.append([EMPTY] * len(rows[0]))
        lines = [_half_line(*rows[i : i + 2], glyphs) for i in range(0, n_rows, 2)]
    for i, line in enumerate(lines):
        line.pad_left(scale.indent(i * scale.rows, n_rows, shear))
    return lines


def _site_line(row: list[int], cell: int, glyphs: Glyphs) -> Text:
    line = Text(no_wrap=True)
    for kind, sites in groupby(row):
        line.append(glyphs.sites[kind].ljust(cell) * len(list(sites)), _STYLES[kind])
    return line


def _half_line(upper: list[int], lower: list[int], glyphs: Glyphs) -> Text:
    """Two rows of sites on one line: the upper one in the text's colour, the lower one behind it."""
    half_upper, half_lower, whole = glyphs.blocks
    line = Text(no_wrap=True)
    for (a, b), sites in groupby(zip(upper, lower, strict=True)):
        block = whole if a == b != EMPTY else half_upper if a else half_lower if b else " "
        style = Style(color=_COLOURS[a or b], bgcolor=_COLOURS[b] if a and b else None)
        line.append(block * len(list(sites)), style)
    return line
