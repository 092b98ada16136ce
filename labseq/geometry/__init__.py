"""Target patterns: from a few settings to the sites that must hold an atom."""

from labseq.geometry.patterns import (
    BitmapLike,
    Clear,
    CompactLike,
    Origin,
    bitmap,
    compact,
    pattern,
    read_bitmap,
)
from labseq.geometry.placing import place

__all__ = [
    "BitmapLike",
    "Clear",
    "CompactLike",
    "Origin",
    "bitmap",
    "compact",
    "pattern",
    "place",
    "read_bitmap",
]
