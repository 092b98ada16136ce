from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from hypothesis import given, settings, strategies as st
from labseq_rivals.kernels_board import CROSSED, NO_END, STEP, TURN, UNWANTED, cheapest_path
from labseq_rivals.kernels_hca import distance_in_the_open
from labseq_rivals.kernels_lsap import plan_assignment
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
    path = cheapest_path((atoms, inside, width), starts, end_cost).tolist()
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
    distance = distance_in_the_open((atoms, inside, width), starts)
    assert distance.tolist() == expected.tolist()


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
    moves, _, _ = plan_assignment(atoms, wanted, np.zeros_like(wanted), chosen, goals[:n], True)
    now = atoms.copy()
    for row, col, to_row, to_col in moves.tolist():
        assert now[row, col]
        down, right = np.sign(to_row - row), np.sign(to_col - col)
        for i in range(1, abs(to_row - row) + abs(to_col - col) + 1):
            assert not now[row + i * down, col + i * right]
        now[row, col], now[to_row, to_col] = False, True
    assert now[wanted].all()
