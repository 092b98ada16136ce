"""Each promise of a scanner is broken once, and the suite names it and no other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import pytest

from labseq.model import ScanSpace, VisitedPoint
from labseq.testing import ScannerContract


class Suite(ScannerContract):
    n_points: ClassVar[int] = 5
    time_limit_s: ClassVar[float] = 1.0


class Draws:
    """Right: any point."""

    def __init__(self, space: ScanSpace) -> None:
        self.space = space
        self.n_calls = 0

    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        self.n_calls += 1
        rng = self.space.random(len(visited))
        return {one.address: one.at(rng.random()) for one in self.space.ranges}


class GivesNothing(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        return None


class GivesPairs(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        return list(super().next_point(visited).items())


class LeavesOneOut(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        return dict([*super().next_point(visited).items()][1:])


class GoesTooFar(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        return {one.address: 1.1 * one.high for one in self.space.ranges}


class CountsItsCalls(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        rng = self.space.random(self.n_calls)
        self.n_calls += 1
        return {one.address: one.at(rng.random()) for one in self.space.ranges}


class SpoilsTheScores(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        for point in visited:
            values: Mapping[str, float] = point.values
            assert isinstance(values, dict)
            values["profile.mobile_tweezers.speed"] = 0.05
        return super().next_point(visited)


class AsksTheSystem(Draws):
    def next_point(self, visited: Sequence[VisitedPoint]) -> Any:
        list(Path().iterdir())
        return super().next_point(visited)


def test_a_good_scanner_keeps_all(keeps_all: Callable[..., None]) -> None:
    keeps_all(Suite(), Draws)


@pytest.mark.parametrize("bad", [GivesPairs, LeavesOneOut, GoesTooFar, GivesNothing])
def test_points_that_are_none(bad: type[Draws]) -> None:
    with pytest.raises(AssertionError, match=r"^promise: next_point\(\) gives an allowed value"):
        Suite().test_points_are_in_their_ranges(bad)


@pytest.mark.parametrize(
    ("bad", "test"),
    [
        (CountsItsCalls, "test_same_results_same_point"),
        (AsksTheSystem, "test_does_no_io"),
    ],
)
def test_other_broken_promises(bad: type[Draws], test: str, breaks_only: Callable[..., None]) -> None:
    breaks_only(Suite(), bad, test)


def test_a_spoilt_input_is_noticed() -> None:
    with pytest.raises(AssertionError, match=r"^promise: what it is given is left untouched"):
        Suite().test_leaves_its_input_untouched(SpoilsTheScores)
