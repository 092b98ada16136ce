import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.model import Batch, Plan

SITES = st.lists(st.tuples(st.integers(-1, 20), st.integers(-1, 20)), max_size=5)


@given(st.lists(SITES, max_size=6))
def test_batches_and_flat_arrays_say_the_same(sources):
    pairs = [(from_sites, [(r, c + 1) for r, c in from_sites]) for from_sites in sources]
    plan = Plan.from_batches(pairs)
    assert plan.n_batches == len(sources)
    assert plan.n_atom_moves == sum(len(s) for s in sources)
    for batch, (from_sites, to_sites) in zip(plan.batches, pairs, strict=True):
        assert batch.from_sites.tolist() == [list(s) for s in from_sites]
        assert batch.to_sites.tolist() == [list(s) for s in to_sites]


def test_views_cannot_be_written():
    plan = Plan.from_batches([([(0, 0)], [(0, 1)])])
    for array in (plan.moves, plan.batch_offsets, plan.linked, plan.batches[0].from_sites):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_a_plan_can_be_cut():
    plan = Plan.from_batches(
        [([(0, 0)], [(0, 1)]), Batch(np.array([[0, 1]]), np.array([[1, 1]]), linked=True)]
    )
    cut = plan.first(1)
    assert (cut.n_batches, cut.n_atom_moves, cut.linked.tolist()) == (1, 1, [False])
    assert plan.linked.tolist() == [False, True]
    assert plan.first(0).n_batches == 0


@pytest.mark.parametrize(
    ("moves", "offsets", "message"),
    [
        ([[0, 0, 0]], [0, 1], "moves has shape"),
        ([[0, 0, 0, 1]], [0, 2], "must run from 0"),
        ([[0, 0, 0, 1]], [1, 1], "must run from 0"),
        ([[0, 0, 0, 1], [1, 1, 1, 2]], [0, 2, 1, 2], "must not decrease"),
        ([[0, 0, 0, 1]], [], "must run from 0"),
        ([[0, 0, 0, 40000]], [0, 1], "cannot represent"),
        ([[0, 0, 0, 0.5]], [0, 1], "cannot represent"),
    ],
)
def test_arrays_that_are_no_plan_are_refused(moves, offsets, message):
    with pytest.raises(ValueError, match=message):
        Plan(np.array(moves), np.array(offsets))
