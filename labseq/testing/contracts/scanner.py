"""What a scanner promises."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Final, TypeAlias, cast

import pytest

from labseq.model import ScanRange, ScanSpace, VisitedPoint
from labseq.roles import Scanner
from labseq.testing.contracts.process import quietly
from labseq.testing.contracts.promises import doing, in_time, no_factory, promise, promised

ScannerFactory: TypeAlias = Callable[[ScanSpace], Scanner]
Scores: TypeAlias = Callable[[ScanSpace, Mapping[str, float]], float]

GIVES_POINTS: Final = "next_point() soon gives an allowed value for each address, or later None"


class ScannerContract:
    """Promises of a scanner; provide the fixture ``factory``.

    Attributes:
        n_points: Points that it is asked for in each test.
        time_limit_s: Longest time for one point, in seconds.
    """

    n_points: ClassVar[int] = 25
    time_limit_s: ClassVar[float] = 5.0

    @pytest.fixture
    def factory(self) -> ScannerFactory:
        """Constructs the scanner, given a space; provided by the plugin's test."""
        no_factory(self, "space -> scanner")

    def spaces(self) -> dict[str, ScanSpace]:
        """What it chooses from: description -> space."""
        dop = ScanRange("planner.degree_of_parallelism", 2, 15, is_whole=True, start=7)
        ramp = ScanRange("profile.mobile_tweezers.pick_up", 20e-6, 400e-6)
        speed = ScanRange("profile.mobile_tweezers.speed", 0.05, 0.2, n_steps=10, start=0.13)
        two = ScanRange("shot.2.rearrange.cycles", 1, 2, is_whole=True)
        ranges = {"all kinds of range": (dop, ramp, speed), "one quantity": (ramp,), "two values": (two,)}
        return {what: ScanSpace(of, self.n_points, 2, seed=5) for what, of in ranges.items()}

    @promise(GIVES_POINTS)
    def test_points_are_in_their_ranges(self, factory: ScannerFactory) -> None:
        """Whatever comes of the points: better and better, all the same, nothing at all."""
        for what, space in self.spaces().items():
            for kind, scores in _SCORES.items():
                with doing(f"on {what}, {kind}"):
                    self.visited(factory(space), space, scores)

    @promise("the same space and the same results give the same point")
    def test_same_results_same_point(self, factory: ScannerFactory) -> None:
        """Asked again, and from a fresh instance that is shown all at once, as in a run that is resumed."""
        for what, space in self.spaces().items():
            scanner = factory(space)
            visited = self.visited(scanner, space, _hill)
            for n in {0, 1, len(visited) // 2, len(visited)}:
                answers = [_plain(one.next_point(_copies(visited[:n]))) for one in (scanner, factory(space))]
                known = [_plain(visited[n].values)] if n < len(visited) else answers[:1]
                assert answers == known * 2, f"on {what}, point {n + 1} was {known[0]}, and is {answers}"

    @promise("what it is given is left untouched")
    def test_leaves_its_input_untouched(self, factory: ScannerFactory) -> None:
        """The points visited so far are everybody's."""
        space = self.spaces()["all kinds of range"]
        scanner = factory(space)
        visited = self.visited(scanner, space, _hill)
        given = _copies(visited)
        scanner.next_point(given)
        assert given == visited, "it changed the points"

    @promise("it is pure: no I/O, nothing changed that all code shares")
    def test_is_pure(self, factory: ScannerFactory) -> None:
        """What it chose could otherwise depend on something that a resumed run does not have."""
        space = self.spaces()["all kinds of range"]
        visited = self.visited(factory(space), space, _hill)  # may compile
        with quietly():
            factory(space).next_point(visited)

    def visited(self, scanner: Scanner, space: ScanSpace, scores: Scores) -> list[VisitedPoint]:
        """The points that it chooses one after another, ``n_points`` at most, each checked."""
        visited: list[VisitedPoint] = []
        with promised(GIVES_POINTS):
            while len(visited) < self.n_points:
                so_far = tuple(_copies(visited))
                point: Any = in_time(self.time_limit_s, "next_point()", scanner.next_point, so_far)
                if point is None:
                    assert visited, "next_point() gave no point at all"
                    break
                _check_point(point, space)
                visited.append(VisitedPoint(dict(point), scores(space, point)))
        return visited


def _check_point(point: Any, space: ScanSpace) -> None:
    """Refuse what is no point of the space."""
    assert isinstance(point, Mapping), f"next_point() gave a {type(point).__name__}"
    values = cast("Mapping[str, Any]", point)
    wanted = {one.address for one in space.ranges}
    assert {*values} == wanted, f"next_point() gave values for {sorted(values)}; expected {sorted(wanted)}"
    for one in space.ranges:
        value = values[one.address]
        assert one.allowed(value) is not None, f"{value!r} for '{one.address}' is not in its range"


def _copies(visited: Sequence[VisitedPoint]) -> list[VisitedPoint]:
    """Points that a scanner may spoil without another test suffering from it."""
    return [VisitedPoint(dict(point.values), point.score) for point in visited]


def _hill(space: ScanSpace, point: Mapping[str, float]) -> float:
    return -sum((one.fraction(point[one.address]) - 0.3) ** 2 for one in space.ranges)


def _constant_score(score: float) -> Scores:
    def scores(space: ScanSpace, point: Mapping[str, float]) -> float:
        del space, point
        return score

    return scores


_SCORES: dict[str, Scores] = {
    "on a hill": _hill,
    "on a plain": _constant_score(0.0),
    "without a single score": _constant_score(math.nan),
}


def _plain(point: Mapping[str, float] | None) -> dict[str, float] | None:
    return None if point is None else dict(point)
