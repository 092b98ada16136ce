"""Settings of the patterns."""

from __future__ import annotations

from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.plugin import Settings

Index: TypeAlias = Annotated[int, Field(ge=0)]
"""Index of a row or a column, from 0."""
Origin: TypeAlias = Annotated[
    tuple[Index, Index] | None,
    Field(description="[row, column] of the block's top left site, from 0; centred if left out"),
]
Clear: TypeAlias = Annotated[
    Literal["bounding_box", "none"],
    Field(description="bounding_box: all other sites of the block must be empty; none: they are reservoir"),
]


class BlockSettings(Settings):
    """A pattern that goes on and on, cut to a block."""

    rows: int = Field(ge=1, description="rows of the block")
    cols: int = Field(ge=1, description="columns of the block")
    origin: Origin = None
    clear: Clear = "bounding_box"


class SierpinskiSettings(Settings):
    """A Sierpinski triangle, of a whole order or cut to a block.

    Example:
        >>> SierpinskiSettings(order=4).size
        (16, 16)
        >>> SierpinskiSettings(rows=15, cols=15).size
        (15, 15)
    """

    order: Annotated[int, Field(ge=0, le=12)] | None = Field(
        default=None, description="how often the triangle is divided; order n takes 2^n rows and columns"
    )
    rows: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="rows of the block, counted from the tip; instead of the order"
    )
    cols: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="columns of the block, counted from the tip; instead of the order"
    )
    origin: Origin = None
    clear: Clear = "bounding_box"

    @property
    def size(self) -> tuple[int, int]:
        """(rows, cols) of the block."""
        if self.order is not None:
            return 2**self.order, 2**self.order
        assert self.rows is not None  # see _has_one_size
        assert self.cols is not None
        return self.rows, self.cols

    @model_validator(mode="after")
    def _has_one_size(self) -> Self:
        check_one_size("order", self.order, self.rows, self.cols)
        return self


class RingSettings(Settings):
    """A ring, of a radius or as large as fits into a block.

    Example:
        >>> RingSettings(radius=6).width
        2.0
    """

    radius: Annotated[float, Field(ge=0, le=10_000)] | None = Field(
        default=None, description="outer radius, in units of the spacing of the sites"
    )
    rows: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="rows of the block that the ring fits into; instead of the radius"
    )
    cols: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="columns of the block that the ring fits into; instead of the radius"
    )
    width: float = Field(
        default=2.0,
        ge=1,
        description="how thick the ring is, in units of the spacing; beyond the radius it is a full disc",
    )
    origin: Origin = None
    clear: Clear = "bounding_box"

    @model_validator(mode="after")
    def _has_one_size(self) -> Self:
        check_one_size("radius", self.radius, self.rows, self.cols)
        return self


def check_one_size(name: str, value: float | None, rows: int | None, cols: int | None) -> None:
    """Refuse a pattern with no size, half a size or two sizes.

    Args:
        name: Name of the setting that stands for rows and columns.
        value: Its value.
        rows: Rows of the block.
        cols: Columns of the block.

    Raises:
        ValueError: With what was expected.
    """
    n_given = (rows is not None) + (cols is not None)
    if n_given == (2 if value is None else 0):
        return
    came = "two sizes are given" if n_given and value is not None else "the size is missing, or half of it"
    raise ValueError(f"{came}; expected either '{name}', or 'rows' and 'cols'")
