"""Which shots are opened where all would take too long."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypeVar

from labseq.recording import Run

T = TypeVar("T")

A_GLANCE: Final = 60
"""Shots whose files are opened for a picture of everything: about half a second."""
A_LOOK: Final = 500
"""Shots whose files are opened for a picture or a table of their own."""


def spread(shots: Sequence[T], most: int) -> list[T]:
    """At most so many of the shots, evenly spread over the run.

    Example:
        >>> spread(range(10), 4)
        [1, 3, 6, 8]
    """
    n = len(shots)
    return list(shots) if n <= most else [shots[(2 * i + 1) * n // (2 * most)] for i in range(most)]


def part_of(n_read: int, run: Run) -> str:
    """Says that not all shots were opened; nothing if all were.

    Args:
        n_read: How many were.
        run: The run.
    """
    n = len(run.shots)
    return "" if n_read == n else f", {n_read} of {n} shots"
