"""PNG files, 16 bit gray, by Pillow."""

from __future__ import annotations

import struct
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from labseq_frames.picture import BadFramesError, Picture, check_size, load

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_N_HEAD: Final = 26
_COLOURS: Final = {
    0: "gray",
    2: "colour",
    3: "palette colour",
    4: "gray with transparency",
    6: "colour with transparency",
}
_GRAY_16: Final = (16, 0)


class PngFiles:
    """One frame from each file.

    Args:
        files: In order; at least one.

    Raises:
        BadFramesError: One is no PNG, not 16 bit gray, or of another size.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = files
        wanted = _size_of(files[0])
        for file in files[1:]:
            check_size(file, _size_of(file), files[0], wanted)

    def pictures(self) -> Generator[Picture]:
        """File by file."""
        image = load("PIL.Image", "Pillow", self._files[0])
        for file in self._files:
            try:
                with image.open(file, formats=["PNG"]) as opened:
                    pixels = np.asarray(opened)
            except Exception as error:  # Pillow raises SyntaxError, OSError, ValueError, zlib.error ...
                text = f"is damaged: {error}"
                raise BadFramesError(file, text, hint="take it from a backup") from error
            yield Picture(pixels.astype(np.uint16), str(file))  # int32 in older Pillows

    def describe(self) -> Mapping[str, Any]:
        """How many there are."""
        return {"source": "PNG", "n_files": len(self._files)}


def _size_of(file: Path) -> tuple[int, int]:
    """(height, width), from the head of the file, which alone says how many bits it has."""
    with file.open("rb") as opened:
        head = opened.read(_N_HEAD)
    if len(head) < _N_HEAD or not head.startswith(_SIGNATURE):
        raise BadFramesError(file, "is not a PNG", hint="take it from a backup, or leave it out")
    width, height, depth, colour = struct.unpack(">IIBB", head[16:])
    if (depth, colour) != _GRAY_16:
        text = f"the picture is {depth} bit {_COLOURS.get(colour, 'of no known kind')}"
        hint = "save the camera's own counts, not what a viewer makes of them"
        raise BadFramesError(file, text, "16 bit gray", hint)
    return height, width
