"""Numbers that a device takes in steps."""

from __future__ import annotations


def nearest(value: int, low: int, high: int, step: int) -> int:
    """The number nearest to a value, from low to high in steps.

    Example:
        >>> nearest(37, 0, 100, 4), nearest(39, 2, 100, 4), nearest(200, 0, 99, 4)
        (36, 38, 96)
    """
    n_steps = (min(max(value, low), high) - low + step // 2) // step
    return low + step * min(n_steps, (high - low) // step)
