"""Quantities as text."""

from __future__ import annotations

from labseq.units import UNITS, ZERO_CELSIUS_K, expected, parse_quantity, scaled

__all__ = [
    "UNITS",
    "ZERO_CELSIUS_K",
    "expected",
    "parse_quantity",
    "scaled",
]
