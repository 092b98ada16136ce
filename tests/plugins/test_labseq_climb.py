"""The scanner that climbs keeps the promises of its role, and gets to the top."""

from __future__ import annotations

from functools import partial

import pytest
from labseq_climb.scanner import Climb, ClimbSettings

from labseq.plugin import ScanRange, ScanSpace, VisitedPoint
from labseq.testing import ScannerContract
from labseq.testing.contracts.deciders import ScannerFactory

DOP = ScanRange("planner.degree_of_parallelism", 2, 15, is_whole=True, start=3)
RAMP = ScanRange("profile.mobile_tweezers.pick_up", 20e-6, 400e-6)


class TestClimb(ScannerContract):
    @pytest.fixture
    def factory(self) -> ScannerFactory:
        return partial(Climb, ClimbSettings())


def climbed(top: dict[str, float], n_points: int = 60, **settings: float) -> list[VisitedPoint]:
    space = ScanSpace((DOP, RAMP), n_points)
    scanner = Climb(ClimbSettings(**settings), space)
    visited: list[VisitedPoint] = []
    while len(visited) < n_points and (point := scanner.next_point(visited)) is not None:
        away = [one.fraction(point[one.address]) - one.fraction(top[one.address]) for one in (DOP, RAMP)]
        visited.append(VisitedPoint(dict(point), -sum(part**2 for part in away)))
    return visited


def test_it_begins_where_the_files_are_and_ends_at_the_top() -> None:
    visited = climbed({DOP.address: 12, RAMP.address: 100e-6})
    assert dict(visited[0].values) == {DOP.address: 3, RAMP.address: 210e-6}
    assert len(visited) < 40  # of 14 x 21 points at the least step
    best = max(visited, key=lambda point: point.score).values
    assert best[DOP.address] == pytest.approx(12, abs=1)
    assert best[RAMP.address] == pytest.approx(100e-6, abs=0.05 * 380e-6)


def test_no_point_is_visited_twice() -> None:
    visited = climbed({DOP.address: 2, RAMP.address: 400e-6}, min_step=0.01)
    assert len({tuple(point.values.items()) for point in visited}) == len(visited)
