"""What a shot will do when, as far as it is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TimelineEntry:
    """One bar of a shot's timeline.

    Attributes:
        label: What happens, for example "image" or "cycle 3: move".
        duration_s: How long it takes at most, in seconds.
        least_s: How long it takes at least; 0 if it may be left out.
        n_images: Images that it takes at most.
        exposure_s: Exposure of each image, in seconds.
        kind: Kind of step that the profile's lines know it by, "image"; "" for one that they do not go with.
    """

    label: str
    duration_s: float
    min_duration_s: float
    n_images: int = 0
    exposure_s: float = 0.0
    kind: str = ""
