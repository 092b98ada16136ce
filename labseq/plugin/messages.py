"""Wording of error messages."""

from __future__ import annotations

from labseq.errors import one_of
from labseq.messages import clean, closest, install_hint, missing_package, visible
from labseq.roles import unknown_name

__all__ = [
    "clean",
    "closest",
    "install_hint",
    "missing_package",
    "one_of",
    "unknown_name",
    "visible",
]
