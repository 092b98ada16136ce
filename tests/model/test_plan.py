import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.model import Batch, Plan, TonePaths

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


def grid_batch(n_knots: int = 3) -> Batch:
    """Two rows of two tweezers; the first row is dropped off one knot before the second."""
    steps = np.arange(n_knots)[:, None] * 0.5
    row_off = np.array([n_knots - 2, n_knots - 1])
    paths = TonePaths(np.add(steps, [0.0, 2.0]), np.subtract([1.0, 4.0], steps), row_off)
    return Batch(np.array([(0, 1), (2, 4)]), np.array([(0, 1), (3, 3)]), tones=paths)


def test_paths_come_back_from_the_flat_arrays():
    first = Batch(np.array([[0, 0]]), np.array([[0, 3]]))
    given = [
        first,
        grid_batch(),
        Batch(np.array([[5, 5]]), np.array([[6, 5]])),
        grid_batch(5),
    ]
    plan = Plan.from_batches(given)
    assert [batch.tones is None for batch in plan.batches] == [True, False, True, False]
    cut = plan.first(2)
    assert len(cut.path_positions) == 3 * 4
    for made, wanted in ((plan.paths(1), given[1]), (plan.paths(3), given[3]), (cut.paths(1), given[1])):
        assert made
        assert wanted.tones
        for name in ("row", "column", "row_off", "column_off"):
            np.testing.assert_array_equal(getattr(made, name), getattr(wanted.tones, name))
    assert not plan.first(1).has_paths
    assert (paths := plan.paths(3))
    assert paths.tones_of([(2, 4), (2, 2)]).tolist() == [[1, 1], [1, -1]]
    assert paths.path_of(0, 1).tolist() == [[0, 4], [0.5, 3.5], [1, 3], [1.5, 2.5]]


@pytest.mark.parametrize(
    ("paths", "message"),
    [
        (([[0.0]], [[0.0]]), "two knots"),
        (([[0.0], [1.0]], np.empty((2, 0))), "one tone of each axis"),
        (([[0.0], [1.0]], [[0.0]]), "column has shape"),
        (([[0.0], [np.nan]], [[0.0], [0.0]]), "not finite"),
        (([[0.0], [1.0]], [[0.0], [0.0]], [0]), "row_off must have knots from 1"),
        (([[0.0, 1.0]] * 3, [[0.0]] * 3, [1, 1]), "row_off must have knots from 1"),
        (([[0.0, 1.0]] * 3, [[0.0]] * 3, [1, 2], [3]), "column_off"),
    ],
)
def test_what_is_no_path_is_refused(paths, message):
    with pytest.raises(ValueError, match=message):
        TonePaths(*paths)


def test_only_line_batches_are_linked():
    sites = np.array([[0, 0]])
    with pytest.raises(ValueError, match="only line batches can be linked"):
        Batch(sites, sites + 1, linked=True, tones=TonePaths(np.zeros((2, 1)), np.array([[0.0], [1.0]])))


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ([[2, 1, 1]] * 2, "has 2 rows"),
        ([[2, 1, 2]], "requires 6 positions and 3 knots, but 4 and 2 are given"),
        ([[-2, 1, 1]], "requires -4"),
        ([], "requires 0"),
    ],
)
def test_flat_arrays_of_paths_belong_together(shapes, message):
    with pytest.raises(ValueError, match=message):
        Plan(
            np.array([[0, 0, 0, 1]]),
            np.array([0, 1]),
            path_shapes=np.array(shapes),
            path_positions=np.array([0.0, 0.0, 0.0, 1.0]),
            path_off=np.array([1, 1]),
        )
