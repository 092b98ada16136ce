"""Target patterns: from a few settings to the sites that must hold an atom."""

from labseq.geometry.centre import from_the_centre, nearest_to_centre
from labseq.geometry.drawing import DrawingError, read_bitmap
from labseq.geometry.patterns import (
    BitmapLike,
    Clear,
    CompactLike,
    Origin,
    bitmap,
    compact,
    pattern,
)
from labseq.geometry.placing import block, check_size, place

__all__ = [
    "BitmapLike",
    "Clear",
    "CompactLike",
    "DrawingError",
    "Origin",
    "bitmap",
    "block",
    "check_size",
    "compact",
    "from_the_centre",
    "nearest_to_centre",
    "pattern",
    "place",
    "read_bitmap",
]
