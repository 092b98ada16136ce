"""Kernels that grow plans; those of the planners are tested with them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.plugin import kernel
from labseq.plugin.plan_kernels import (
    FINISHED_PLAN,
    FinishedPlan,
    add_line,
    add_move,
    as_plan,
    empty_plan,
    end_batch,
    finished,
    move_alone,
    take_turns,
)


def ints(values: Sequence[int]) -> NDArray[np.int64]:
    return np.array(values, np.int64)


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_the_way_is_free_and_no_batch_is_wasted(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 8), "sites")
    source = sorted(data.draw(st.sets(st.integers(0, n - 1), min_size=1), "atoms"))
    reach = st.sets(st.integers(-2, n + 1), min_size=len(source), max_size=len(source))
    goal = sorted(data.draw(reach, "goals"))
    limit, slots = data.draw(st.integers(1, 4), "limit"), data.draw(st.integers(1, 2), "slots")
    turns = take_turns(ints(source), ints(goal), n, limit, slots)
    assert [turn > 0 for turn in turns] == [a != b for a, b in zip(source, goal, strict=True)]
    place = dict(enumerate(source))
    for turn in range(1, max(turns) + 1):
        going = [i for i in place if turns[i] == turn]
        assert 0 < len(going) <= limit
        assert sum(goal[i] < 0 for i in going) <= slots
        assert sum(goal[i] >= n for i in going) <= slots
        for i, other in product(going, place):
            if other not in going:  # it stands
                assert not min(place[i], goal[i]) <= place[other] <= max(place[i], goal[i])
        for i in going:
            place[i] = goal[i]
            if not 0 <= goal[i] < n:
                del place[i]
    n_ejected = max(sum(site < 0 for site in goal), sum(site >= n for site in goal))
    n_moved = sum(a != b for a, b in zip(source, goal, strict=True))
    if n_ejected == 0:
        assert max(turns) == -(-n_moved // limit)


@kernel(f"{FINISHED_PLAN}(int64)")
def grow(n_moves: int) -> FinishedPlan:
    """A plan of all that can be added; an empty batch in between is none."""
    plan = empty_plan(n_moves)
    plan = end_batch(add_move(add_move(plan, 0, 0, 1, 0), 0, 2, 1, 2), False)
    plan = end_batch(plan, True)
    plan = move_alone(plan, np.ones((4, 4), np.bool_), 1, 0, 1, 3, True)
    plan = add_line(plan, (False, 2, 4), np.array([0, 2, 3]), np.array([-1, 0, 1]), 2, 1)
    return finished(add_move(plan, 3, 3, 3, 4))


def test_a_plan_grows_beyond_the_length_that_was_expected() -> None:
    for n_moves in (0, 1, 20):
        plan = as_plan(grow(n_moves))
        assert plan.batch_offsets.tolist() == [0, 2, 3, 5, 6]
        assert plan.linked.tolist() == [False, True, False, False]
        assert plan.moves[:3].tolist() == [[0, 0, 1, 0], [0, 2, 1, 2], [1, 0, 1, 3]]
        assert plan.moves[3:].tolist() == [[0, 2, -1, 2], [2, 2, 0, 2], [3, 2, 1, 2]]
