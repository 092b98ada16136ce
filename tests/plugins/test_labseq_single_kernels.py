from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_single import kernels
from labseq_single.kernels import CROSSED, NO_END, STEP, TURN, UNWANTED
from numpy.typing import NDArray

from labseq.testing.strategies import masks, shapes

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


def padded(sites: Any) -> Bools:
    return np.pad(np.asarray(sites, np.bool_), 1).ravel()


def cost_of(path: Sequence[int], atoms: Bools, end_cost: Ints) -> int:
    """What a path costs, counted by hand; its end comes first."""
    steps = [a - b for a, b in pairwise(path)]
    n_turns = sum(a != b for a, b in pairwise(steps))
    n_crossed = sum(bool(atoms[site]) for site in path[1:-1])
    return CROSSED * n_crossed + STEP * len(steps) + TURN * n_turns + int(end_cost[path[0]])


def all_paths(start: int, inside: Bools, width: int, end_cost: Ints) -> list[list[int]]:
    """Every path that visits no site twice, its end first."""
    found: list[list[int]] = []

    def go_on(path: list[int]) -> None:
        for step in (-width, -1, 1, width):
            site = path[-1] + step
            if site in path:
                continue
            if end_cost[site] != NO_END:
                found.append([*path, site][::-1])
            if inside[site]:
                go_on([*path, site])

    go_on([start])
    return found


@pytest.mark.parametrize("shape", [(1, 1), (2, 3)])
def test_the_margin_is_empty_and_outside(shape: tuple[int, int]) -> None:
    full = np.ones(shape, np.bool_)
    assert kernels.with_margin(full).tolist() == padded(full).tolist()
    atoms, inside, width = kernels.board_of(~full)
    assert not atoms.any()
    assert inside.tolist() == padded(full).tolist()
    assert width == shape[1] + 2
    numbers = kernels.sites_with_margin(np.arange(full.size), shape[1])
    assert numbers.tolist() == np.flatnonzero(padded(full)).tolist()


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_the_cheapest_path_is_found(data: st.DataObject) -> None:
    shape = data.draw(shapes((3, 4)), "shape")
    atoms, starts, ends = (padded(data.draw(masks(shape), name)) for name in ("atoms", "starts", "ends"))
    inside, width = padded(np.ones(shape)), shape[1] + 2
    end_cost = np.where(ends & ~starts, 1, NO_END)
    if data.draw(st.booleans(), "ends outside"):
        end_cost[~inside] = UNWANTED
    paths = [p for start in np.flatnonzero(starts) for p in all_paths(int(start), inside, width, end_cost)]
    path = kernels.cheapest_path((atoms, inside, width), starts, end_cost).tolist()
    if not paths:
        assert path == []
        return
    assert path in paths
    assert cost_of(path, atoms, end_cost) == min(cost_of(p, atoms, end_cost) for p in paths)


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_distances_in_the_open_are_those_of_paths_over_free_sites(data: st.DataObject) -> None:
    shape = data.draw(shapes((4, 4)), "shape")
    atoms = padded(data.draw(masks(shape), "atoms"))
    starts = atoms & padded(data.draw(masks(shape), "starts"))
    inside, width = padded(np.ones(shape)), shape[1] + 2
    expected = np.where(starts, 0, -1)
    for length in range(1, atoms.size):
        for site in np.flatnonzero(inside & ~atoms & (expected < 0)):
            if any(expected[site + step] == length - 1 for step in (-width, -1, 1, width)):
                expected[site] = length
    distance = kernels.distance_in_the_open((atoms, inside, width), starts)
    assert distance.tolist() == expected.tolist()


@pytest.mark.parametrize(
    ("goal", "row_first", "path"),
    [
        (33, True, [33, 23, 13, 12, 11]),
        (33, False, [33, 32, 31, 21, 11]),
        (14, False, [14, 13, 12, 11]),
        (11, True, [11]),
    ],
)
def test_an_l_goes_along_one_axis_and_then_the_other(goal: int, row_first: bool, path: list[int]) -> None:
    assert kernels.l_shaped(11, goal, 10, row_first).tolist() == path
    assert kernels.l_shaped(goal, 11, 10, not row_first).tolist() == path[::-1]


def test_every_atom_on_a_path_goes_on_to_the_next_free_place() -> None:
    width = 7
    atoms, inside = padded([[0, 1, 0, 1, 0], [0, 0, 0, 1, 1]]), padded(np.ones((2, 5)))
    path = np.array([8, 9, 10, 11, 18, 19], np.int64)
    moves, linked, n = kernels.shift(kernels.empty_plan(1), (atoms, inside, width), path)
    assert n == 4
    assert moves[:n].tolist() == [[0, 1, 0, 0], [0, 3, 0, 1], [1, 3, 0, 3], [1, 4, 1, 3]]
    assert not linked[:n].any()
    assert atoms.tolist() == padded([[1, 1, 0, 1, 0], [0, 0, 0, 1, 0]]).tolist()


def test_an_atom_carried_off_the_grid_is_gone_and_its_turns_are_linked() -> None:
    width = 5
    atoms, inside = padded([[0, 0, 0], [0, 1, 0]]), padded(np.ones((2, 3)))
    path = np.array([5, 6, 7, 12], np.int64)
    moves, linked, n = kernels.shift(kernels.empty_plan(4), (atoms, inside, width), path)
    assert moves[:n].tolist() == [[1, 1, 0, 1], [0, 1, 0, -1]]
    assert linked[:n].tolist() == [False, True]
    assert not atoms.any()


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_any_assignment_can_be_carried_out(data: st.DataObject) -> None:
    shape = data.draw(shapes((5, 5)), "shape")
    atoms = data.draw(masks(shape), "atoms")
    fill = data.draw(masks(shape), "fill")
    sources, goals = np.flatnonzero(atoms), np.flatnonzero(fill)
    n = min(len(sources), len(goals))
    chosen = np.array(data.draw(st.permutations(sources.tolist()), "sources")[:n], np.int64)
    wanted = np.zeros(shape, np.bool_)
    wanted.ravel()[goals[:n]] = True
    moves, _, n_moves = kernels.plan_assignment(atoms, wanted, np.zeros_like(wanted), chosen, goals[:n], True)
    now = atoms.copy()
    for row, col, to_row, to_col in moves[:n_moves].tolist():
        assert now[row, col]
        down, right = np.sign(to_row - row), np.sign(to_col - col)
        for i in range(1, abs(to_row - row) + abs(to_col - col) + 1):
            assert not now[row + i * down, col + i * right]
        now[row, col], now[to_row, to_col] = False, True
    assert now[wanted].all()


def test_costs_rank_as_they_should_on_the_largest_grids() -> None:
    longest = 200 * 200
    assert TURN > 3
    assert longest * (STEP + TURN) + 3 < UNWANTED < CROSSED
    assert longest * CROSSED < np.iinfo(np.int64).max
    assert all(a > b for a, b in product((CROSSED, UNWANTED), (STEP, TURN)))
