"""Settings of the target patterns that come with labseq."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from labseq.config.drawings import read_drawing
from labseq.config.fields import setting_error
from labseq.config.settings import FilePath, Settings
from labseq.errors import ConfigError
from labseq.geometry import DrawingError, read_bitmap

Index = Annotated[int, Field(ge=0)]
"""Index of a row or a column, from 0."""


class CompactSettings(Settings):
    """A full block of sites."""

    rows: int = Field(ge=1, description="rows of the block")
    cols: int = Field(ge=1, description="columns of the block")
    origin: tuple[Index, Index] | None = Field(
        default=None, description="[row, column] of its top left site, from 0; centred if left out"
    )


class BitmapSettings(Settings):
    r"""Sites as they are drawn, in the sequence or in a file.

    Example:
        >>> BitmapSettings(sites="#.#\n.#.").mask.astype(int).tolist()
        [[1, 0, 1], [0, 1, 0]]
    """

    sites: str | None = Field(
        default=None, description="the drawing: one line of text per row, all of the same length"
    )
    file: FilePath | None = Field(
        default=None,
        description="a file with the drawing, instead of sites: text, or a PNG with one pixel per site",
    )
    fill: str = Field(
        default="#",
        min_length=1,
        description="characters of a text that stand for an atom; all others are empty sites",
    )
    origin: tuple[Index, Index] | None = Field(
        default=None, description="[row, column] of its top left site, from 0; centred if left out"
    )
    clear: Literal["bounding_box", "none"] = Field(
        default="bounding_box",
        description="bounding_box: all other sites of the drawing must be empty; none: they are reservoir",
    )
    _mask: NDArray[np.bool_] = PrivateAttr()

    @property
    def mask(self) -> NDArray[np.bool_]:
        """What is drawn: bool (rows, cols), True where an atom must be."""
        return self._mask

    @model_validator(mode="after")
    def _read(self) -> Self:
        if self.sites is not None and self.file is not None:
            raise setting_error("'file' stands beside 'sites'", "one of them", at=("file",), key=True)
        if self.file is not None:
            try:
                self._mask = read_drawing(self.file, self.fill)
            except ConfigError as error:
                raise setting_error(str(error), at=("file",)) from None
        elif self.sites is not None:
            try:
                self._mask = read_bitmap(self.sites, self.fill)
            except DrawingError as error:
                raise setting_error(str(error), at=("sites",)) from None
        else:
            raise setting_error("a bitmap needs a drawing", "'sites' or 'file'")
        return self
