"""The built-in target patterns, and drawings in text and PNG files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from labseq.messages import install_hint
from labseq.plugin import ConfigError, FilePath, Problem, Settings, SiteGrid, TargetPattern, setting_error
from labseq.plugin.geometry import check_size, pattern
from labseq.plugin.messages import visible
from labseq.text_files import decode, read_bytes

MAX_PIXELS: Final = 1024
"""Longest side of a picture, in pixels, far more than the sites of any grid."""

MAX_BYTES: Final = 1 << 20
"""Largest file with a drawing, in bytes."""

_HALF: Final = 128


class DrawingError(ValueError):
    """An error in a drawing.

    Attributes:
        line: The wrong line of the text, from 1. 0 for an error of the whole drawing.
    """

    def __init__(self, message: str, line: int = 0) -> None:
        self.line = line
        super().__init__(message)


def read_bitmap(drawing: str, fill: str = "#") -> NDArray[np.bool_]:
    """Read a drawing with one line per row. Empty lines before and after it are ignored.

    Args:
        drawing: The drawing.
        fill: Characters that mean an atom. All others mean no atom.

    Returns:
        bool (rows, cols).

    Raises:
        DrawingError: The drawing is empty, has no atom, or its rows differ in length.

    Example:
        >>> read_bitmap("#.#").astype(int).tolist()
        [[1, 0, 1]]
    """
    lines = drawing.splitlines()
    first = next((i for i, line in enumerate(lines) if line), len(lines))
    drawn = "\n".join(lines[first:]).rstrip("\n").splitlines()
    if not drawn:
        raise DrawingError("the drawing is empty; draw rows such as '#.#', with '#' for an atom")
    for row, line in enumerate(drawn, start=1):
        if len(line) != len(drawn[0]):
            raise DrawingError(
                f"row {row} of the drawing has {len(line)} characters, but row 1 has {len(drawn[0])}; "
                "make all rows equally long",
                first + row,
            )
    mask = np.array([[character in fill for character in line] for line in drawn], np.bool_)
    if not mask.any():
        raise DrawingError(f"the drawing has no atom; draw an atom as one of '{fill}', or set `fill`")
    return mask


def read_drawing(path: Path, fill: str = "#") -> NDArray[np.bool_]:
    """Read a pattern that is drawn in a file.

    A file whose name ends in .png is a picture. Any other file is text.

    Args:
        path: The file.
        fill: Characters that mean an atom, in a text.

    Returns:
        bool (rows, cols), True where an atom must be.

    Raises:
        ConfigError: The file cannot be read, or is not a drawing. The error has the wrong line.
    """
    data = read_bytes(path, "a text file or a PNG", (".txt", ".png"), MAX_BYTES)
    name = visible(str(path))
    if path.suffix.lower() == ".png":
        return _picture(data, name)
    try:
        return read_bitmap(decode(data, name), fill)
    except DrawingError as error:
        column = 1 if error.line else 0
        raise ConfigError(Problem(str(error), name, error.line, column)) from None


def _picture(data: bytes, name: str) -> NDArray[np.bool_]:
    """Atoms are dark pixels, or in a picture with transparent pixels the opaque pixels."""
    try:
        from PIL import Image
    except ImportError:
        hint = f"{install_hint('plot')}, or draw it as text"
        raise ConfigError(
            Problem("reading a PNG needs Pillow, which is not installed", name, hint=hint)
        ) from None
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            if max(image.size) > MAX_PIXELS:
                fault = f"the picture has {image.height} x {image.width} pixels"
                raise ConfigError(Problem(fault, name, expected="one pixel per site", hint="scale it down"))
            # Grey levels of 16 bits fit into no other mode, and the upper 8 bits are enough.
            grey = np.asarray(image) // 257 if image.mode.startswith("I") else np.asarray(image.convert("L"))
            opacity = np.asarray(cast("Any", image).convert("RGBA"))[..., 3]
    except ConfigError:
        raise
    except (
        Exception
    ) as error:  # damaged data make Pillow raise SyntaxError, OSError, ValueError, zlib.error ...
        raise ConfigError(Problem(f"this is not a readable PNG: {error}", name)) from error
    mask = opacity >= _HALF if opacity.min() < _HALF else grey < _HALF
    if not mask.any():
        hint = "make the pixels of atoms dark, or all others transparent"
        raise ConfigError(Problem("the picture has no atom", name, hint=hint))
    return mask


Index = Annotated[int, Field(ge=0)]
"""Index of a row or a column, from 0."""


class CompactSettings(Settings):
    """A full block of sites."""

    rows: int = Field(ge=1, description="rows of the block")
    cols: int = Field(ge=1, description="columns of the block")
    origin: tuple[Index, Index] | None = Field(
        default=None, description="[row, column] of its top left site, from 0. By default it is centred"
    )


def compact(settings: CompactSettings, grid: SiteGrid) -> TargetPattern:
    """A full block of sites, for example the paper's 15 x 15 out of 20 x 20.

    Raises:
        LimitError: The block is larger than the grid or sticks out of it.
    """
    check_size((settings.rows, settings.cols), grid.shape)
    mask = np.ones((settings.rows, settings.cols), np.bool_)
    name = f"compact {settings.rows} x {settings.cols}"
    return pattern(mask, grid, origin=settings.origin, name=name)


class BitmapSettings(Settings):
    r"""Sites as they are drawn, in the sequence or in a file.

    Example:
        >>> BitmapSettings(sites="#.#\n.#.").mask.astype(int).tolist()
        [[1, 0, 1], [0, 1, 0]]
    """

    sites: str | None = Field(
        default=None, description="the drawing, with one line of text per row, all of the same length"
    )
    file: FilePath | None = Field(
        default=None,
        description="a file with the drawing, instead of sites, as text or as a PNG with one pixel per site",
    )
    fill: str = Field(
        default="#",
        min_length=1,
        description="characters of a text that mean an atom. All others are empty sites",
    )
    origin: tuple[Index, Index] | None = Field(
        default=None, description="[row, column] of its top left site, from 0. By default it is centred"
    )
    clear: Literal["bounding_box", "none"] = Field(
        default="bounding_box",
        description="bounding_box if all other sites of the drawing must be empty, none if not",
    )
    _mask: NDArray[np.bool_] = PrivateAttr()

    @property
    def mask(self) -> NDArray[np.bool_]:
        """The drawing, bool (rows, cols), True where an atom must be."""
        return self._mask

    @model_validator(mode="after")
    def _read(self) -> Self:
        if self.sites is not None and self.file is not None:
            raise setting_error("'file' and 'sites' are both given", "one of them", at=("file",), key=True)
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


def bitmap(settings: BitmapSettings, grid: SiteGrid) -> TargetPattern:
    """Sites as they are drawn. The bounding box is the whole drawing, margins included.

    Raises:
        LimitError: The drawing is larger than the grid or sticks out of it.
    """
    mask = settings.mask
    name = f"bitmap {mask.shape[0]} x {mask.shape[1]}"
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=name)
