"""Analyses that break one promise each."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from labseq.errors import RecordingError
from labseq.roles import Context, RecordedShot
from labseq.testing import AnalysisContract

from .planted import Planted


class Loading:
    """Right: what is loaded, and how bright."""

    def __init__(self, context: Context) -> None:
        self.grid_shape = context.grid.shape

    def shot(self, shot: RecordedShot) -> Any:
        if not shot.images:
            raise RecordingError("a shot", "has no image")
        first = shot.images[0].occupancy
        return {"filling": float(first.mean()), "sites": first.astype(np.int64), "bright": self.bright(shot)}

    def bright(self, shot: RecordedShot) -> float | None:
        return float(shot.frames.max()) if shot.frames.size else None


class CountsUnderShot(Loading):
    def shot(self, shot: RecordedShot) -> Any:
        return super().shot(shot) | {"shot": shot.index}


class FailsOnCycles(Loading):
    def shot(self, shot: RecordedShot) -> Any:
        return super().shot(shot) | {"window_s": [shot.cycles[3].window_s for _ in shot.cycles]}


class AddsUp(Loading):
    total = 0.0

    def shot(self, shot: RecordedShot) -> Any:
        result = super().shot(shot)
        self.total += result["filling"]
        return result | {"filling": self.total}


class SubtractsInPlace(Loading):
    def bright(self, shot: RecordedShot) -> float | None:
        value = super().bright(shot)
        shot.frames[...] = np.maximum(shot.frames, 100)
        return value


class NeedsFrames(Loading):
    def bright(self, shot: RecordedShot) -> float | None:
        return float(shot.frames.max())


class SilencesWarnings(Loading):
    def shot(self, shot: RecordedShot) -> Any:
        warnings.filterwarnings("ignore", message=f"shot {len(warnings.filters)}")
        return super().shot(shot)


PLANTED = Planted(
    AnalysisContract(),
    Loading,
    (
        (CountsUnderShot, "test_gives_results"),
        (FailsOnCycles, "test_gives_results"),
        (AddsUp, "test_same_shot_same_result"),
        (SubtractsInPlace, "test_leaves_the_shot_untouched"),
        (NeedsFrames, "test_takes_odd_shots"),
        (SilencesWarnings, "test_is_pure"),
    ),
)
