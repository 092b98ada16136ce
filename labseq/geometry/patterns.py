"""The patterns that come with labseq: compact blocks and drawn bitmaps."""

from __future__ import annotations

from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.geometry.placing import place
from labseq.model import SiteGrid, TargetPattern

Origin: TypeAlias = tuple[int, int] | None
"""(row, col) of the pattern's top left site; None centres it."""
Clear: TypeAlias = Literal["bounding_box", "none"]
"""Which sites must be empty: every other site of the pattern's block, or none."""


class CompactLike(Protocol):
    """Settings of :func:`compact`."""

    @property
    def rows(self) -> int:
        """Rows of the block."""
        ...

    @property
    def cols(self) -> int:
        """Columns of the block."""
        ...

    @property
    def origin(self) -> Origin:
        """Where it sits."""
        ...


class BitmapLike(Protocol):
    """Settings of :func:`bitmap`."""

    @property
    def sites(self) -> str:
        """The drawing, one line per row."""
        ...

    @property
    def fill(self) -> str:
        """Characters that stand for an atom."""
        ...

    @property
    def origin(self) -> Origin:
        """Where it sits."""
        ...

    @property
    def clear(self) -> Clear:
        """Which sites must be empty."""
        ...


def pattern(
    mask: NDArray[np.bool_],
    grid: SiteGrid,
    *,
    origin: Origin = None,
    clear: Clear = "bounding_box",
    name: str = "target",
) -> TargetPattern:
    """Make a target of a mask; what a plugin's own pattern ends with.

    Args:
        mask: bool (rows, cols), True where an atom must be.
        grid: The grid that the target lies on.
        origin: (row, col) of the mask's top left site; None centres it (one site
            nearer to the top and to the left if it cannot be even).
        clear: "bounding_box": all other sites of the mask's block must be empty;
            "none": they are reservoir.
        name: For records and the screen.

    Raises:
        LimitError: The mask is larger than the grid or sticks out of it.

    Example:
        >>> target = pattern(np.eye(2, dtype=np.bool_), SiteGrid(2, 3), name="diagonal")
        >>> target.clear.astype(int).tolist()
        [[0, 1, 0], [1, 0, 0]]
    """
    fill = place(mask, grid.shape, origin)
    empty = ~mask if clear == "bounding_box" else np.zeros_like(mask)
    return TargetPattern(fill, place(empty, grid.shape, origin), name)


def compact(settings: CompactLike, grid: SiteGrid) -> TargetPattern:
    """A full block of sites, for example the paper's 15 x 15 out of 20 x 20.

    Raises:
        LimitError: It is larger than the grid or sticks out of it.
    """
    mask = np.ones((settings.rows, settings.cols), np.bool_)
    name = f"compact {settings.rows} x {settings.cols}"
    return pattern(mask, grid, origin=settings.origin, name=name)


def bitmap(settings: BitmapLike, grid: SiteGrid) -> TargetPattern:
    """Sites as they are drawn; the bounding box is the whole drawing, margins included.

    Raises:
        ValueError: The drawing is empty, holds no atom, or its rows differ in length.
        LimitError: It is larger than the grid or sticks out of it.
    """
    mask = read_bitmap(settings.sites, settings.fill)
    name = f"bitmap {mask.shape[0]} x {mask.shape[1]}"
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=name)


def read_bitmap(text: str, fill: str = "#") -> NDArray[np.bool_]:
    """Read a drawing, one line per row; empty lines before and after it do not count.

    Args:
        text: The drawing.
        fill: Characters that stand for an atom; all others stand for none.

    Returns:
        bool (rows, cols).

    Raises:
        ValueError: The drawing is empty, holds no atom, or its rows differ in length.

    Example:
        >>> read_bitmap("#.#").astype(int).tolist()
        [[1, 0, 1]]
    """
    lines = text.strip("\r\n").splitlines()
    if not lines or not lines[0]:
        raise ValueError("the bitmap is empty; draw rows such as '#.#', with '#' for an atom")
    for number, line in enumerate(lines, start=1):
        if len(line) != len(lines[0]):
            raise ValueError(
                f"row {number} of the bitmap has {len(line)} characters and row 1 has {len(lines[0])}; "
                "every row must have the same number"
            )
    mask = np.array([[character in fill for character in line] for line in lines], np.bool_)
    if not mask.any():
        raise ValueError(f"the bitmap holds no atom; draw an atom as one of '{fill}', or set `fill`")
    return mask
