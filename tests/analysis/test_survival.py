"""Which atoms are there on the next image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from labseq.analysis.statistics import Survival
from labseq.data.quantities import steps_that_load
from labseq.data.reader import Run
from labseq.errors import RecordingError
from labseq.model import CycleRecord, Plan, PlanReport, follow_atoms
from labseq.model.estimate import Rate

from .records import make_shot

Write = Callable[..., Run]


def cycle(plan: Plan, n_played: int) -> CycleRecord:
    n = plan.n_batches
    report = PlanReport(np.zeros((2, 4), np.bool_), np.zeros(n), np.ones(n, np.int32), 0, 0)
    return CycleRecord(2, 0, plan, report, n_played, 0.06, 0.5, 0.0)


def counted(run: Run) -> Survival:
    found = Survival.empty(run.target.shape)
    for one in run.shots:
        found.add(one, steps_that_load(run))
    return found


def test_atoms_that_go_on_in_later_batches_are_counted_where_they_end() -> None:
    before = np.array([[True, True, True, False], [True, True, False, False]])
    chain = ([(0, 0), (0, 1), (0, 2)], [(0, 1), (0, 2), (0, 3)])
    plan = Plan.from_batches([chain, ([(0, 3)], [(1, 3)]), ([(1, 0)], [(1, -1)]), ([(1, 1)], [(9, 1)])])
    moved, kept = follow_atoms(before, [cycle(plan, 4)])
    assert np.argwhere(moved).tolist() == [[0, 1], [0, 2], [1, 3]]
    assert not kept.any()  # two were ejected


def test_batches_that_were_not_played_move_nothing() -> None:
    before = np.array([[True, False, False, False], [True, False, False, False]])
    plan = Plan.from_batches([([(0, 0)], [(0, 1)]), ([(1, 0)], [(1, 1)])])
    moved, kept = follow_atoms(before, [cycle(plan, 1)])
    assert np.argwhere(moved).tolist() == [[0, 1]]
    assert np.argwhere(kept).tolist() == [[1, 0]]


def test_moved_and_kept_atoms_are_counted_apart(write: Write) -> None:
    found = counted(write([make_shot(i, n_defects=i) for i in range(3)]))
    assert found.n_read == 3
    assert found.moved.rate == Rate(3, 3)
    assert found.moved.fractions[1, 1] == 1.0
    # Five atoms stay in each first cycle; what the second image shows stays until the last one.
    assert found.kept.rate == Rate(15 - 3 + 18 - 3, 15 + 18 - 3)
    assert [(moved.rate.n_trials, kept.rate.n_trials) for moved, kept in found.by_cycle] == [(3, 15)]
    assert np.isnan(found.kept.fractions[3, 0])


@pytest.mark.parametrize(("steps", "n_kept"), [(({"load": {}},), 11), (({"load": {}}, {}, {"load": {}}), 6)])
def test_atoms_are_not_followed_through_a_load(
    write: Write, steps: tuple[dict[str, object], ...], n_kept: int
) -> None:
    run = write([make_shot(0)], resolved={"shot": steps})
    assert counted(run).kept.rate.n_trials == n_kept


def test_a_file_that_is_not_what_the_index_tells_of_is_damaged(write: Write) -> None:
    run = write([make_shot(0), make_shot(1, n_cycles=2)])
    run.shots[0].file.write_bytes(run.shots[1].file.read_bytes())
    with pytest.raises(RecordingError, match="does not have the images that the index lists"):
        counted(run)
