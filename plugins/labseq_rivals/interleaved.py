"""The target of MTA1's geometry, with rows to fill and rows of the reservoir between them."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from labseq.plugin import Settings, SiteGrid, TargetPattern
from labseq.plugin.geometry import check_size, pattern

Index = Annotated[int, Field(ge=0)]


class InterleavedSettings(Settings):
    """Settings of the pattern ``interleaved``.

    Example:
        >>> InterleavedSettings(rows=16, cols=16).block_rows
        31
    """

    rows: int = Field(ge=1, description="rows to be filled")
    cols: int = Field(ge=1, description="columns to be filled")
    reservoir_rows: int = Field(default=1, ge=0, description="rows left free between two filled rows")
    origin: tuple[Index, Index] | None = Field(
        default=None, description="[row, column] of the top left site, from 0; centred by default"
    )
    clear: Literal["bounding_box", "none"] = Field(
        default="none",
        description="with 'bounding_box' the rows between must end up empty; with 'none' they are reservoir",
    )

    @property
    def block_rows(self) -> int:
        """Number of rows from the first to the last row to fill."""
        return (self.rows - 1) * (self.reservoir_rows + 1) + 1


def interleaved(settings: InterleavedSettings, grid: SiteGrid) -> TargetPattern:
    """Full rows with rows of the reservoir between them, one in the geometry of Ebadi et al.

    Args:
        settings: Size and place.
        grid: Any grid.

    Raises:
        LimitError: The block is larger than the grid or extends beyond it.

    Example:
        >>> interleaved(InterleavedSettings(rows=2, cols=2), SiteGrid(5, 2)).fill.astype(int).tolist()
        [[0, 0], [1, 1], [0, 0], [1, 1], [0, 0]]
    """
    shape = (settings.block_rows, settings.cols)
    check_size(shape, grid.shape)
    mask = np.zeros(shape, np.bool_)
    mask[:: settings.reservoir_rows + 1] = True
    name = f"interleaved {settings.rows} x {settings.cols}"
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=name)
