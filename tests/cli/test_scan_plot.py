"""A running scan as text."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, strategies as st

from labseq.cli.live import ScanTally, draw_scan
from labseq.console.output import ASCII, UNICODE
from labseq.model import ShotRecord


def scan(values: list[Any], *, repeats: int = 1) -> dict[str, Any]:
    return {
        "addresses": ["planner.dop"],
        "points": [[value] for value in values],
        "written": [[str(value)] for value in values],
        "point_of_shot": [i for i in range(len(values)) for _ in range(repeats)],
    }


def tally_of(values: list[Any], shots: list[tuple[int, bool, float]]) -> ScanTally:
    tally = ScanTally(scan(values))
    for index, success, filling in shots:
        tally.add(ShotRecord(index, 0, 1, "", success=success, filling_fraction=filling))
    return tally


def lines(tally: ScanTally, width: int = 40, height: int = 6, glyphs: Any = UNICODE) -> list[str]:
    return [line.plain for line in draw_scan(tally, width, height, glyphs)]


def test_points_stand_in_the_order_of_their_values() -> None:
    tally = tally_of([7, 3, 15], [(0, True, 1.0), (1, False, 0.9), (2, True, 1.0), (2, False, 0.9)])
    assert lines(tally) == [
        "defect-free by planner.dop",
        " 100 %      ████      ",
        "            ████      ",
        "            ████ ████ ",
        "   0 % ▁▁▁▁ ████ ████ ",
        "       3            15",
    ]


def test_without_a_defect_free_shot_the_filling_is_drawn() -> None:
    drawn = lines(tally_of([1, 2, 3], [(0, False, 0.98), (2, False, 0.99)]), glyphs=ASCII)
    assert drawn[0] == "filling by planner.dop"
    assert (drawn[1][:7], drawn[-2][:7]) == ("  99 % ", "  98 % ")
    assert drawn[-2][7:] == "....      #### "


@pytest.mark.parametrize(("width", "height"), [(15, 6), (40, 3)])
def test_where_there_is_no_room_there_is_no_plot(width: int, height: int) -> None:
    assert lines(tally_of([1], [(0, True, 1.0)]), width, height) == []


def test_before_the_first_shot_there_is_no_plot() -> None:
    assert lines(tally_of([1, 2], [(0, False, float("nan")), (99, True, 1.0)])) == []


@given(
    st.lists(st.integers(0, 500), min_size=1, max_size=120, unique=True),
    st.lists(st.tuples(st.integers(0, 120), st.booleans(), st.floats(0, 1)), max_size=60),
    st.integers(16, 60),
    st.integers(4, 12),
    st.sampled_from([UNICODE, ASCII]),
)
def test_a_plot_never_exceeds_its_room(
    values: list[int], shots: list[tuple[int, bool, float]], width: int, height: int, glyphs: Any
) -> None:
    drawn = lines(tally_of(values, shots), width, height, glyphs)
    assert len(drawn) in (0, height)
    assert all(len(line) <= max(width, len("defect-free by planner.dop")) for line in drawn)
