"""Patterns that are drawn as text."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class DrawingError(ValueError):
    """A drawing is wrong.

    Attributes:
        line: The line of the text that is wrong, from 1; 0 if it is the whole.
    """

    def __init__(self, what: str, line: int = 0) -> None:
        self.line = line
        super().__init__(what)


def read_bitmap(text: str, fill: str = "#") -> NDArray[np.bool_]:
    """Read a drawing, one line per row; empty lines before and after it do not count.

    Args:
        text: The drawing.
        fill: Characters that stand for an atom; all others stand for none.

    Returns:
        bool (rows, cols).

    Raises:
        DrawingError: The drawing is empty, holds no atom, or its rows differ in length.

    Example:
        >>> read_bitmap("#.#").astype(int).tolist()
        [[1, 0, 1]]
    """
    lines = text.splitlines()
    first = next((i for i, line in enumerate(lines) if line), len(lines))
    drawn = "\n".join(lines[first:]).rstrip("\n").splitlines()
    if not drawn:
        raise DrawingError("the drawing is empty; draw rows such as '#.#', with '#' for an atom")
    for row, line in enumerate(drawn, start=1):
        if len(line) != len(drawn[0]):
            raise DrawingError(
                f"row {row} of the drawing has {len(line)} characters and row 1 has {len(drawn[0])}; "
                "every row must have the same number",
                first + row,
            )
    mask = np.array([[character in fill for character in line] for line in drawn], np.bool_)
    if not mask.any():
        raise DrawingError(f"the drawing holds no atom; draw an atom as one of '{fill}', or set `fill`")
    return mask
