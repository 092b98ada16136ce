from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import Phase, find, given, settings
from hypothesis.strategies import SearchStrategy

from labseq.model import Occupancy, Plan, TargetPattern, ToneProgram
from labseq.motion import check_plan
from labseq.testing import strategies

OCCUPANCY = np.array([[1, 0, 1, 0, 1], [0, 1, 1, 1, 0], [1, 0, 0, 0, 0]], np.bool_)
NO_TARGET = TargetPattern(np.zeros((3, 5), np.bool_), np.zeros((3, 5), np.bool_))


def found(strategy: SearchStrategy[Any], condition: Callable[[Any], bool]) -> Any:
    """An example, not the smallest one."""
    return find(strategy, condition, settings=settings(phases=[Phase.generate], max_examples=100))


@given(strategies.occupancies((3, 5)))
def test_occupancies_have_the_wanted_shape(occupancy: Occupancy) -> None:
    assert occupancy.shape == (3, 5)
    assert occupancy.dtype == np.bool_
    assert occupancy.flags.c_contiguous


@settings(max_examples=30)
@given(strategies.cases(max_shape=(3, 4)))
def test_cases_fit_together(case: tuple[TargetPattern, Occupancy]) -> None:
    target, occupancy = case
    assert target.shape == occupancy.shape
    assert occupancy.shape[0] <= 3
    assert occupancy.shape[1] <= 4


def test_extremes_are_among_them() -> None:
    assert found(strategies.occupancies(), lambda o: o.size > 3 and bool(o.all())).all()
    assert not found(strategies.occupancies(), lambda o: o.size > 3 and not o.any()).any()
    assert found(strategies.targets(), lambda t: t.n_atoms == 0 and t.shape[0] == 1).n_atoms == 0
    assert found(strategies.targets(), lambda t: bool(t.clear.all() and t.clear.size > 2)).clear.all()


@settings(max_examples=30)
@given(strategies.plans(OCCUPANCY))
def test_plans_are_legal(plan: Plan) -> None:
    report = check_plan(plan, OCCUPANCY, NO_TARGET, degree_of_parallelism=20)
    assert report.predicted.sum() == OCCUPANCY.sum()


def test_plans_move_several_atoms_along_rows_and_columns() -> None:
    along_row = found(strategies.plans(OCCUPANCY), lambda p: any(len(b) > 1 for b in p.batches))
    assert along_row.n_atom_moves > 1
    along_column = found(strategies.plans(OCCUPANCY), lambda p: bool(np.any(p.moves[:, 0] != p.moves[:, 2])))
    assert along_column.n_batches >= 1


@settings(max_examples=30)
@given(strategies.plans(OCCUPANCY, max_batches=1, max_tweezers=2))
def test_plans_keep_to_the_wanted_size(plan: Plan) -> None:
    assert plan.n_batches <= 1
    assert plan.n_atom_moves <= 2


@settings(max_examples=15)
@given(strategies.tone_programs(max_shape=(4, 4)))
def test_tone_programs_have_as_many_tweezers_as_tones_cross(program: ToneProgram) -> None:
    assert program.total_duration_s >= 0
    assert len(program.row.offsets) == len(program.column.offsets) == program.n_segments + 1
