from __future__ import annotations

from collections import defaultdict
from itertools import combinations

import numpy as np
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.pictures.plans import HEIGHT, heights, hops, lanes

LINES = st.lists(
    st.tuples(st.booleans(), st.integers(0, 2), st.integers(-1, 8), st.integers(-1, 8)), max_size=30
)


def as_moves(ways: list[tuple[bool, int, int, int]]) -> NDArray[np.int16]:
    """Moves along rows and columns from (along a column, line, start, end)."""
    rows = [
        (start, line, end, line) if along_column else (line, start, line, end)
        for along_column, line, start, end in ways
        if start != end
    ]
    return np.array(rows, np.int16).reshape(-1, 4)


@settings(deadline=None)
@given(LINES.map(as_moves))
def test_ways_that_share_a_stretch_lie_in_different_lanes(moves: NDArray[np.int16]) -> None:
    found = lanes(moves)
    assert found.shape == (len(moves),)
    by_place = defaultdict[object, list[tuple[int, int]]](list)
    for (r0, c0, r1, c1), lane in zip(moves.tolist(), found.tolist(), strict=True):
        along_column = r0 != r1
        line, start, end = (c0, r0, r1) if along_column else (r0, c0, c1)
        by_place[along_column, line, start < end, lane].append((min(start, end), max(start, end)))
    for taken in by_place.values():
        assert all(a[1] <= b[0] or b[1] <= a[0] for a, b in combinations(taken, 2))


@settings(deadline=None)
@given(LINES.map(as_moves))
def test_no_lane_is_left_out(moves: NDArray[np.int16]) -> None:
    found = set(lanes(moves).tolist())
    assert found == set(range(len(found)))


def test_short_ways_lie_below_long_ones() -> None:
    moves = np.array([[0, 0, 0, 9], [0, 4, 0, 5], [0, 3, 0, 7]], np.int16)
    assert lanes(moves).tolist() == [2, 0, 1]


@settings(deadline=None)
@given(st.integers(1, 50))
def test_all_lanes_have_room(n_lanes: int) -> None:
    height = heights(np.arange(n_lanes))
    assert (np.diff(height) > 0).all()
    assert HEIGHT[0] == height.min() <= height.max() <= HEIGHT[1] + 1e-12


def test_arrows_start_and_end_beside_their_sites_and_bulge_to_one_side() -> None:
    start, end = np.array([[0.0, 0.0], [5.0, 0.0]]), np.array([[5.0, 0.0], [0.0, 0.0]])
    shafts, heads = hops(start, end, np.array([0.3, 0.3]))
    assert np.allclose(shafts[:, 0], [[0.16, 0.0], [4.84, 0.0]])
    assert np.allclose(heads[:, 0], [[4.84, 0.0], [0.16, 0.0]])
    assert (shafts[0, 1:-1, 1] < 0).all()
    assert (shafts[1, 1:-1, 1] > 0).all()


@settings(deadline=None)
@given(st.integers(1, 20), st.floats(0.1, 1.0))
def test_an_arrow_is_as_high_as_it_was_told(length: int, height: float) -> None:
    shafts, _ = hops(np.zeros((1, 2)), np.array([[float(length), 0.0]]), np.array([height]))
    assert np.abs(shafts).max() < max(length, 1.2 * height)
    assert np.abs(shafts[0, :, 1]).max() <= 1.1 * height + 0.1
    assert np.isfinite(shafts).all()
