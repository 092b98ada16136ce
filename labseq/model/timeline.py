"""What a shot will do when, as far as it is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TimelineEntry:
    """One bar of a shot's timeline.

    Attributes:
        label: What happens, for example "image" or "cycle 3: move".
        duration_s: How long it takes at most, in seconds.
        typical_s: How long it usually takes; equal to ``duration_s`` if fixed.
        n_images: Images that it takes at most.
    """

    label: str
    duration_s: float
    typical_s: float
    n_images: int = 0
