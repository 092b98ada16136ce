"""What each planner with a single tweezer does in its own way."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from labseq_single.planner import (
    CompressionPlanner,
    HcaPlanner,
    LsapPlanner,
    LsapSquaredPlanner,
    layers,
    travel,
)
from scipy.optimize import linear_sum_assignment

from labseq import (
    Occupancy,
    TargetPattern,
)
from labseq.testing.strategies import cases

from .labseq_single_cases import distance, in_a_row, journeys, plan_and_check


@given(cases((6, 6)))
@settings(max_examples=200, deadline=None)
def test_lsap_moves_the_atoms_by_the_least_total_distance(case: tuple[TargetPattern, Occupancy]) -> None:
    target, atoms = case
    target = TargetPattern(target.fill, np.zeros_like(target.fill))
    goals, sources = np.flatnonzero(target.fill), np.flatnonzero(atoms)
    if len(goals) <= len(sources):
        lengths = travel(goals, sources, atoms.shape[1])
        least = lengths[linear_sum_assignment(lengths)].sum()
        assert distance(plan_and_check(LsapPlanner, atoms, target)[0]) == least


def test_the_squares_prefer_two_short_moves_to_a_long_one() -> None:
    atoms, fill = np.zeros((2, 7), np.bool_), np.zeros((2, 7), np.bool_)
    atoms[0, 0] = atoms[1, 3] = fill[1, 3] = fill[0, 6] = True
    target = TargetPattern(fill, np.zeros_like(fill))
    assert distance(plan_and_check(LsapPlanner, atoms, target)[0]) == 6
    plan, _ = plan_and_check(LsapSquaredPlanner, atoms, target)
    assert [(way[0], way[-1]) for way in journeys(plan)] == [((1, 3), (0, 6)), ((0, 0), (1, 3))]


def test_a_queue_of_atoms_moves_from_its_front() -> None:
    atoms, target = in_a_row([1, 1, 1, 0, 0], [0, 0, 1, 1, 1])
    for planner in (LsapPlanner, LsapSquaredPlanner):
        plan, report = plan_and_check(planner, atoms, target)
        assert report.meets_target
        assert distance(plan) == 6
    assert [move[1] for move in plan_and_check(LsapSquaredPlanner, atoms, target)[0].moves.tolist()] == [
        2,
        1,
        0,
    ]


def test_compression_fills_from_the_centre_with_the_nearest_atom_outside() -> None:
    atoms, target = in_a_row([1, 1, 1, 0, 1, 1, 1], [0, 1, 1, 1, 1, 1, 0])
    plan, _ = plan_and_check(CompressionPlanner, atoms, target)
    assert plan.moves.tolist() == [[0, 2, 0, 3], [0, 1, 0, 2], [0, 0, 0, 1]]


def test_an_atom_in_the_way_goes_into_the_depth_of_a_closed_region() -> None:
    atoms, target = in_a_row([1, 1, 0, 0, 0, 1, 1, 1, 1], [0, 1, 1, 1, 1, 1, 1, 0, 0])
    plan, report = plan_and_check(HcaPlanner, atoms, target)
    assert report.meets_target
    assert plan.moves[:2].tolist() == [[0, 1, 0, 4], [0, 0, 0, 3]]


def test_layers_are_squares_around_the_centre() -> None:
    order = layers(np.ones((4, 4), np.bool_))
    assert order[:4].tolist() == [5, 6, 9, 10]
    assert order[4:8].tolist() == [0, 3, 12, 15]
