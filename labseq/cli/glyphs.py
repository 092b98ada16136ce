"""The characters that a screen can show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from labseq.cli.output import encodes


@dataclass(frozen=True, slots=True)
class Glyphs:
    """One character for each thing that is drawn.

    Attributes:
        atom: An atom on a target site.
        defect: An empty target site.
        surplus: An atom on a site that must be empty.
        reservoir: Any other atom.
        done: Part of a bar that is done.
        left: Part of a bar that is left.
        plus_minus: Before an uncertainty.
        to: Between the ends of an interval.
        levels: Parts of a cell that are filled from below, from the least to the whole.
        upper: Upper half of a cell; "" where there are no half blocks.
        lower: Lower half of a cell.
        both: A whole cell.
    """

    atom: str
    defect: str
    surplus: str
    reservoir: str
    done: str
    left: str
    plus_minus: str
    to: str
    levels: str
    upper: str = ""
    lower: str = ""
    both: str = ""

    @property
    def all(self) -> str:
        """All characters, to find out whether they can be encoded."""
        return "".join(getattr(self, name) for name in self.__slots__)


UNICODE: Final = Glyphs("●", "○", "×", "·", "━", "╌", "±", "–", "▁▂▃▄▅▆▇█", "▀", "▄", "█")  # noqa: RUF001 - meant
ASCII: Final = Glyphs("@", "o", "x", ".", "#", "-", "+-", "-", ".:#")


def glyphs_for(encoding: str | None) -> Glyphs:
    """The characters for a screen with this encoding.

    Example:
        >>> glyphs_for("cp1252").atom
        '@'
    """
    return UNICODE if encodes(encoding, UNICODE.all) else ASCII
