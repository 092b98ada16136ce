"""Planners that move one atom at a time; tests/plugins/test_planners.py has what all planners promise."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from labseq_rivals.planners import travel
from scipy.optimize import linear_sum_assignment

from labseq.plugin import Occupancy, Plan, TargetPattern
from labseq.testing.strategies import cases

from .planning import COMPACT, SINGLE, Bools, in_the_middle, loadings, plan_and_check

Site = tuple[int, int]
LSAP, SQUARED, COMPRESSION, HCA = SINGLE.values()
each = pytest.mark.parametrize("name", SINGLE)


def paths(plan: Plan) -> list[list[Site]]:
    """The corners of each atom's path, from pick-up to drop-off."""
    found: list[list[Site]] = []
    for batch in plan.batches:
        if not batch.linked:
            found.append([tuple(batch.from_sites[0].tolist())])
        found[-1].append(tuple(batch.to_sites[0].tolist()))
    return found


def distance(plan: Plan) -> int:
    return int(np.abs(plan.moves[:, 2:].astype(int) - plan.moves[:, :2]).sum())


def in_a_row(atoms: Sequence[int], fill: Sequence[int]) -> tuple[Bools, TargetPattern]:
    """One row of atoms, and the target that wants some of its sites filled."""
    wanted = np.array([fill], np.bool_)
    return np.array([atoms], np.bool_), TargetPattern(wanted, np.zeros_like(wanted))


@pytest.mark.parametrize(
    ("name", "most_moves"), [("lsap", 170), ("lsap_squared", 188), ("compression", 144.5), ("hca", 85)]
)
def test_mean_number_of_moves_of_the_papers_array(name: str, most_moves: float) -> None:
    n_moves: list[int] = []
    for atoms in loadings(30):
        plan, report = plan_and_check(SINGLE[name], atoms, COMPACT)
        assert report.meets_target
        assert (np.diff(plan.batch_offsets) == 1).all()
        for path in paths(plan):
            along_row = [a[0] == b[0] for a, b in pairwise(path)]
            assert all(a != b for a, b in pairwise(along_row)), "straight pieces are one batch"
        n_moves.append(len(paths(plan)))
        assert n_moves[-1] >= COMPACT.n_defects(atoms)
    assert np.mean(n_moves) <= most_moves


def test_the_cluster_algorithm_needs_hardly_more_moves_than_there_are_defects_at_half_filling() -> None:
    target, arrays = in_the_middle(np.ones((10, 10))), loadings(30, filling=0.5)
    n_moves = sum(len(paths(plan_and_check(HCA, atoms, target)[0])) for atoms in arrays)
    assert n_moves <= 1.07 * sum(target.n_defects(atoms) for atoms in arrays)


@each
def test_a_surplus_atom_goes_to_the_reservoir_rather_than_out(name: str) -> None:
    clear = np.array([[True, True, True, True, False]])
    target = TargetPattern(np.zeros_like(clear), clear)
    plan, report = plan_and_check(SINGLE[name], np.array([[True, False, False, False, False]]), target)
    assert (plan.moves.tolist(), report.n_surplus) == ([[0, 0, 0, 4]], 0)
    plan, report = plan_and_check(SINGLE[name], np.array([[True, False, False, False, True]]), target)
    assert (plan.moves[:, :2].tolist(), report.n_surplus) == ([[0, 0]], 0)


@each
def test_an_inner_atom_is_ejected_after_those_outside_of_it_moved_on(name: str) -> None:
    fill = np.ones((3, 3), np.bool_)
    fill[1, 1] = False
    plan, report = plan_and_check(SINGLE[name], np.ones((3, 3), np.bool_), TargetPattern(fill, ~fill))
    assert report.meets_target
    assert plan.n_batches == 2


@given(cases((6, 6)))
@settings(max_examples=60, deadline=None)
def test_lsap_moves_the_atoms_by_the_least_total_distance(case: tuple[TargetPattern, Occupancy]) -> None:
    target, atoms = case
    target = TargetPattern(target.fill, np.zeros_like(target.fill))
    goals, sources = np.flatnonzero(target.fill), np.flatnonzero(atoms)
    if len(goals) <= len(sources):
        lengths = travel(goals, sources, atoms.shape[1])
        least = lengths[linear_sum_assignment(lengths)].sum()
        assert distance(plan_and_check(LSAP, atoms, target)[0]) == least


def test_the_squares_prefer_two_short_moves_to_a_long_one() -> None:
    atoms, fill = np.zeros((2, 2, 7), np.bool_)
    atoms[0, 0] = atoms[1, 3] = fill[1, 3] = fill[0, 6] = True
    target = TargetPattern(fill, np.zeros_like(fill))
    assert distance(plan_and_check(LSAP, atoms, target)[0]) == 6
    plan, _ = plan_and_check(SQUARED, atoms, target)
    assert [(path[0], path[-1]) for path in paths(plan)] == [((1, 3), (0, 6)), ((0, 0), (1, 3))]


def test_compression_fills_from_the_centre_with_the_nearest_atom_outside() -> None:
    atoms, target = in_a_row([1, 1, 1, 0, 1, 1, 1], [0, 1, 1, 1, 1, 1, 0])
    plan, _ = plan_and_check(COMPRESSION, atoms, target)
    assert plan.moves.tolist() == [[0, 2, 0, 3], [0, 1, 0, 2], [0, 0, 0, 1]]


def test_an_atom_in_the_way_goes_into_the_depth_of_a_closed_region() -> None:
    atoms, target = in_a_row([1, 1, 0, 0, 0, 1, 1, 1, 1], [0, 1, 1, 1, 1, 1, 1, 0, 0])
    plan, report = plan_and_check(HCA, atoms, target)
    assert report.meets_target
    assert plan.moves[:2].tolist() == [[0, 1, 0, 4], [0, 0, 0, 3]]
