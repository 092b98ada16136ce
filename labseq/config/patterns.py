"""Settings of the target patterns that come with labseq."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from labseq.config.settings import Settings
from labseq.geometry import read_bitmap

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
    r"""Sites as they are drawn.

    Example:
        >>> BitmapSettings(sites="#.#\n.#.").clear
        'bounding_box'
    """

    sites: str = Field(description="the drawing: one line of text per row, all of the same length")
    fill: str = Field(
        default="#", min_length=1, description="characters that stand for an atom; all others are empty sites"
    )
    origin: tuple[Index, Index] | None = Field(
        default=None, description="[row, column] of its top left site, from 0; centred if left out"
    )
    clear: Literal["bounding_box", "none"] = Field(
        default="bounding_box",
        description="bounding_box: all other sites of the drawing must be empty; none: they are reservoir",
    )

    @model_validator(mode="after")
    def _drawing_is_right(self) -> Self:
        read_bitmap(self.sites, self.fill)
        return self
