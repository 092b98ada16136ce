"""Sites of a grid: blocks of them, patterns, their order from the centre."""

from __future__ import annotations

from labseq.geometry import block, check_size, from_the_centre, nearest_to_centre, pattern

__all__ = [
    "block",
    "check_size",
    "from_the_centre",
    "nearest_to_centre",
    "pattern",
]
