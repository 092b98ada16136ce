from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from rich.text import Text

from labseq.console.arrays import ASCII, UNICODE, ArrayPair, Glyphs
from labseq.model import Occupancy, TargetPattern
from labseq.testing.strategies import cases

OCCUPANCY = np.array([[1, 0, 1], [1, 0, 1]], np.bool_)
TARGET = TargetPattern(np.array([[1, 1, 0], [0, 0, 0]], np.bool_), np.array([[0, 0, 0], [1, 0, 0]], np.bool_))


def plain(lines: list[Text]) -> list[str]:
    return [line.plain.rstrip() for line in lines]


def canvas(width: int = 100, shear: int = 0, glyphs: Glyphs = ASCII) -> ArrayPair:
    return ArrayPair(TARGET, shear, width, glyphs)


def test_two_arrays_side_by_side() -> None:
    lines = canvas().lines(("before", "after"), (OCCUPANCY, ~OCCUPANCY))
    assert plain(lines) == [
        "before      after",
        "  0           0",
        "0 @ o .     0 o @",
        "1 x   .     1   .",
    ]


@pytest.mark.parametrize(
    ("width", "expected"),
    [
        (20, ["before      after", "  0           0", "0 @ o .     0 o @", "1 x   .     1   ."]),
        (19, ["before    after", "  0         0", "0 @o.     0 o@", "1 x .     1  ."]),
        (13, ["before", "  0", "0 @ o .", "1 x   .", "", "after", "  0", "0 o @", "1   ."]),
        (4, ["(2 x 3 sites do not fit into 4 characters)"]),
    ],
)
def test_arrays_shrink_then_stand_below_one_another_then_go(width: int, expected: list[str]) -> None:
    assert plain(canvas(width).lines(("before", "after"), (OCCUPANCY, ~OCCUPANCY))) == expected


def test_rows_are_sheared_as_on_the_lattice() -> None:
    assert plain(canvas(shear=1).lines(("a", "b"), (OCCUPANCY, OCCUPANCY)))[2:] == [
        "0 @ o .      0 @ o .",
        "1  x   .     1  x   .",
    ]
    assert plain(canvas(shear=-1).lines(("a", "b"), (OCCUPANCY, OCCUPANCY)))[2:] == [
        "0  @ o .     0  @ o .",
        "1 x   .      1 x   .",
    ]


@settings(deadline=None)
@example(
    (TargetPattern(np.ones((1, 11), np.bool_), np.zeros((1, 11), np.bool_)), np.ones((1, 11), np.bool_)),
    30,
    0,
    ASCII,
)
@given(
    cases(max_shape=(12, 25)),
    st.integers(1, 150),
    st.sampled_from([-1, 0, 1]),
    st.sampled_from([ASCII, UNICODE]),
)
def test_no_line_is_wider_than_the_screen(
    case: tuple[TargetPattern, Occupancy], width: int, shear: int, glyphs: Glyphs
) -> None:
    target, occupancy = case
    every_site = np.argwhere(np.ones(target.shape)).astype(np.int16)
    lines = ArrayPair(target, shear, width, glyphs).lines(
        ("before", "after"), (occupancy, occupancy), (every_site, every_site)
    )
    assert max(len(line) for line in plain(lines)) <= width or len(lines) == 1


@pytest.mark.parametrize(("width", "shear"), [(100, 1), (100, -1), (22, 0), (8, 0)])
def test_marked_sites_are_inverted(width: int, shear: int) -> None:
    marked = np.array([[1, 2], [0, 0]], np.int16), np.array([[1, 1]], np.int16)
    lines = canvas(width, shear).lines(("before", "after"), (OCCUPANCY, OCCUPANCY), marked)
    found = [
        line.plain[span.start : span.end] for line in lines for span in line.spans if span.style == "reverse"
    ]
    assert sorted(found) == [" ", ".", "@"]


def test_columns_are_numbered_where_they_stand() -> None:
    target = TargetPattern(np.ones((1, 12), np.bool_), np.zeros((1, 12), np.bool_))
    head, row = plain(ArrayPair(target, 0, 200, ASCII).lines(("a", "b"), (target.fill, target.fill)))[1:3]
    assert [row[head.index(number)] for number in ("0", "5", "10")] == ["@", "@", "@"]
    assert row[: head.index("10")].count("@") == 10


def test_the_key_explains_what_occurs() -> None:
    assert [entry[0] for entry in canvas().key(OCCUPANCY).plain.split("   ")] == ["@", "o", "x", "."]
    assert [entry[0] for entry in canvas().key(TARGET.fill).plain.split("   ")] == ["@"]
    nothing = np.zeros_like(OCCUPANCY)
    assert ArrayPair(TargetPattern(nothing, nothing), 0, 80, ASCII).key(nothing).plain == ""
    assert canvas(4).key(OCCUPANCY).plain == ""
