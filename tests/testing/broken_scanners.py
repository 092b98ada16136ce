"""Scanners that break one promise each."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from labseq.model import ScanSpace, VisitedPoint
from labseq.testing import ScannerContract

from .planted import Planted


class Suite(ScannerContract):
    n_points: ClassVar[int] = 5
    time_limit_s: ClassVar[float] = 0.2


class Draws:
    """Right: any point."""

    def __init__(self, space: ScanSpace) -> None:
        self.space = space
        self.n_calls = 0

    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        self.n_calls += 1
        rng = self.space.random(len(visited))
        return {one.address: one.at(rng.random()) for one in self.space.ranges}


class Stops(Draws):
    """Right: two points are enough for it."""

    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        return super().next_point(visited) if len(visited) < 2 else None


class GivesNothing(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        return None


class GoesTooFar(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        return {one.address: 1.1 * one.high for one in self.space.ranges}


class NeedsScores(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        _ = [round(point.score) for point in visited]
        return super().next_point(visited)


class WaitsForAScore(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        if visited and all(math.isnan(point.score) for point in visited):
            threading.Event().wait(5.0)
        return super().next_point(visited)


class CountsItsCalls(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        rng = self.space.random(self.n_calls)
        self.n_calls += 1
        return {one.address: one.at(rng.random()) for one in self.space.ranges}


class SpoilsTheValues(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        for point in visited:
            values: Mapping[str, float] = point.values
            assert isinstance(values, dict)
            values["profile.mobile_tweezers.speed"] = 0.05
        return super().next_point(visited)


class LooksIntoTheFolder(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        list(Path().iterdir())
        return super().next_point(visited)


PLANTED = Planted(
    Suite(),
    Draws,
    (
        (GivesNothing, "test_points_are_in_their_ranges"),
        (GoesTooFar, "test_points_are_in_their_ranges"),
        (NeedsScores, "test_points_are_in_their_ranges"),
        (WaitsForAScore, "test_points_are_in_their_ranges"),
        (CountsItsCalls, "test_same_results_same_point"),
        (SpoilsTheValues, "test_leaves_its_input_untouched"),
        (LooksIntoTheFolder, "test_is_pure"),
    ),
)
