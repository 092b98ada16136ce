"""The patterns that come with labseq: compact blocks and drawn bitmaps."""

from __future__ import annotations

from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.geometry.placing import check_size, place
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
    def mask(self) -> NDArray[np.bool_]:
        """What is drawn: bool (rows, cols), True where an atom must be."""
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
        LimitError: The mask holds no atom, is larger than the grid or sticks out of it.

    Example:
        >>> target = pattern(np.eye(2, dtype=np.bool_), SiteGrid(2, 3), name="diagonal")
        >>> target.clear.astype(int).tolist()
        [[0, 1, 0], [1, 0, 0]]
    """
    if not mask.any():
        raise LimitError(f"the number of atoms of {name}", 0, "at least 1", "choose a larger target")
    fill = place(mask, grid.shape, origin)
    empty = ~mask if clear == "bounding_box" else np.zeros_like(mask)
    return TargetPattern(fill, place(empty, grid.shape, origin), name)


def compact(settings: CompactLike, grid: SiteGrid) -> TargetPattern:
    """A full block of sites, for example the paper's 15 x 15 out of 20 x 20.

    Raises:
        LimitError: It is larger than the grid or sticks out of it.
    """
    check_size((settings.rows, settings.cols), grid.shape)
    mask = np.ones((settings.rows, settings.cols), np.bool_)
    name = f"compact {settings.rows} x {settings.cols}"
    return pattern(mask, grid, origin=settings.origin, name=name)


def bitmap(settings: BitmapLike, grid: SiteGrid) -> TargetPattern:
    """Sites as they are drawn; the bounding box is the whole drawing, margins included.

    Raises:
        LimitError: It is larger than the grid or sticks out of it.
    """
    mask = settings.mask
    name = f"bitmap {mask.shape[0]} x {mask.shape[1]}"
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=name)
