"""Plans damaged at random, each in a way that is wrong by construction: the check refuses every one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from labseq import Occupancy, Plan, TargetPattern, check_plan, make_planner, make_target
from labseq.errors import InvalidPlanError
from labseq.roles import Planner

N_DAMAGED = 10_000
DOP = 5
SHAPE = (12, 12)
Rows = list[list[int]]
"""A batch: [from row, from column, to row, to column] of each atom."""


@dataclass
class Case:
    """A right plan, and the occupancy before each of its batches."""

    plan: Plan
    target: TargetPattern
    before: list[NDArray[np.bool_]]
    rng: np.random.Generator

    def batches(self) -> list[Rows]:
        return [self.plan.moves[a:b].tolist() for a, b in pairwise(self.plan.batch_offsets.tolist())]

    def rebuilt(self, batches: list[Rows], linked: NDArray[np.bool_] | None = None) -> Plan:
        moves = np.array([move for batch in batches for move in batch], np.int16).reshape(-1, 4)
        offsets = np.cumsum([0, *map(len, batches)], dtype=np.int32)
        return Plan(moves, offsets, np.zeros(len(batches), np.bool_) if linked is None else linked)

    def any_batch(self) -> tuple[int, list[Rows], NDArray[np.bool_]]:
        batches = self.batches()
        number = int(self.rng.integers(len(batches)))
        return number, batches, self.before[number]


Damage = Callable[[Case], Plan | None]
"""Damages a plan; None if this plan cannot be damaged in this way."""


def is_row(move: list[int]) -> bool:
    return move[0] == move[2]


def along(move: list[int]) -> tuple[int, int]:
    """Indices of the coordinates that change, in a move: (from, to)."""
    return (1, 3) if is_row(move) else (0, 2)


def line_of(move: list[int], atoms: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return atoms[move[0]] if is_row(move) else atoms[:, move[1]]


def source_moved(case: Case) -> Plan | None:
    """An atom is taken from where there is none."""
    number, batches, atoms = case.any_batch()
    move = batches[number][0]
    start, end = along(move)
    empty = [site for site in np.flatnonzero(~line_of(move, atoms)).tolist() if site != move[end]]
    if not empty:
        return None
    move[start] = int(case.rng.choice(empty))
    return case.rebuilt(batches, case.plan.linked)


def order_swapped(case: Case) -> Plan | None:
    """Two atoms of a line pass each other."""
    number, batches, _ = case.any_batch()
    batch = batches[number]
    if len(batch) < 2:
        return None
    a, b = case.rng.choice(len(batch), 2, replace=False)
    _, end = along(batch[0])
    batch[a][end], batch[b][end] = batch[b][end], batch[a][end]
    return case.rebuilt(batches)


def crossing_hit(case: Case) -> Plan | None:
    """A tone more makes crossings, and one of them lies on an atom that the plan does not name."""
    number, batches, atoms = case.any_batch()
    batch = batches[number]
    start, end = along(batch[0])
    across = 1 - start
    tones = {move[start] for move in batch}
    for line in case.rng.permutation(SHAPE[across]).tolist():
        there = atoms[line] if across == 0 else atoms[:, line]
        others = [site for site in np.flatnonzero(there).tolist() if site not in tones]
        if line != batch[0][across] and there[list(tones)].any() and others:
            extra = [0, 0, 0, 0]
            extra[across] = extra[across + 2] = line
            extra[start] = int(case.rng.choice(others))
            extra[end] = extra[start] + int(case.rng.choice([-1, 1]))
            batch.append(extra)
            return case.rebuilt(batches)
    return None


def chunk_too_large(case: Case) -> Plan | None:
    """More atoms move together than there may be tweezers."""
    batches = case.batches()
    full = [n for n in range(len(batches) - 1) if len(batches[n]) + len(batches[n + 1]) > DOP]
    if not full:
        return None
    number = int(case.rng.choice(full))
    batches[number] += batches.pop(number + 1)
    return case.rebuilt(batches)


def path_over_an_atom(case: Case) -> Plan | None:
    """An atom goes on, over one that stands."""
    number, batches, atoms = case.any_batch()
    batch = batches[number]
    move = batch[int(case.rng.integers(len(batch)))]
    start, end = along(move)
    line = line_of(move, atoms).copy()
    line[[other[start] for other in batch]] = False
    beyond = [
        goal
        for goal in range(len(line))
        if not line[goal] and line[min(goal, move[start]) : max(goal, move[start]) + 1].any()
    ]
    if not beyond:
        return None
    move[end] = int(case.rng.choice(beyond))
    return case.rebuilt(batches)


def gap_closed(case: Case) -> Plan | None:
    """Two atoms end on one site."""
    number, batches, _ = case.any_batch()
    batch = batches[number]
    if len(batch) < 2:
        return None
    a, b = case.rng.choice(len(batch), 2, replace=False)
    batch[a][2:] = batch[b][2:]
    return case.rebuilt(batches)


def goal_taken(case: Case) -> Plan | None:
    """An atom ends on one that stands."""
    number, batches, atoms = case.any_batch()
    batch = batches[number]
    move = batch[int(case.rng.integers(len(batch)))]
    start, end = along(move)
    line = line_of(move, atoms).copy()
    line[[other[start] for other in batch]] = False
    if not line.any():
        return None
    move[end] = int(case.rng.choice(np.flatnonzero(line)))
    return case.rebuilt(batches)


def inner_atom_ejected(case: Case) -> Plan | None:
    """An atom leaves the grid over one further out."""
    number, batches, atoms = case.any_batch()
    row = int(case.rng.integers(SHAPE[0]))
    cols = np.flatnonzero(atoms[row]).tolist()
    if len(cols) < 2:
        return None
    batches.insert(number, [[row, int(case.rng.choice(cols[1:])), row, -1]])
    return case.rebuilt(batches)


def ejected_too_far(case: Case) -> Plan | None:
    """An atom goes further out than the deflector's band reaches."""
    number, batches, atoms = case.any_batch()
    row = int(case.rng.integers(SHAPE[0]))
    cols = np.flatnonzero(atoms[row]).tolist()
    if not cols:
        return None
    batches.insert(number, [[row, cols[0], row, -2]])
    return case.rebuilt(batches)


def batch_too_early(case: Case) -> Plan | None:
    """A batch comes before the one that brings an atom of it."""
    batches = case.batches()
    late = [n for n, batch in enumerate(batches) if any(not case.before[0][m[0], m[1]] for m in batch)]
    if not late:
        return None
    batches.insert(0, batches.pop(int(case.rng.choice(late))))
    return case.rebuilt(batches)


def batch_twice(case: Case) -> Plan | None:
    """A batch is played twice, so that some of its atoms are gone."""
    number, batches, _ = case.any_batch()
    batch = batches[number]
    goals = {(move[2], move[3]) for move in batch}
    if all((move[0], move[1]) in goals for move in batch):
        return None
    batches.insert(number, batch)
    return case.rebuilt(batches)


def linked_elsewhere(case: Case) -> Plan | None:
    """Tweezers stay on from a batch to one that starts elsewhere."""
    number, batches, _ = case.any_batch()
    held = {(move[2], move[3]) for move in batches[number - 1]} if number else set[tuple[int, int]]()
    if held == {(move[0], move[1]) for move in batches[number]}:
        return None
    linked = case.plan.linked.copy()
    linked[number] = True
    return case.rebuilt(batches, linked)


def diagonal(case: Case) -> Plan | None:
    """An atom changes its row and its column."""
    number, batches, _ = case.any_batch()
    move = batches[number][0]
    free = 2 if is_row(move) else 3
    move[free] += 1 if move[free] == 0 else -1
    return case.rebuilt(batches)


DAMAGES: tuple[Damage, ...] = (
    source_moved,
    order_swapped,
    crossing_hit,
    chunk_too_large,
    path_over_an_atom,
    gap_closed,
    goal_taken,
    inner_atom_ejected,
    ejected_too_far,
    batch_too_early,
    batch_twice,
    linked_elsewhere,
    diagonal,
)


def planners() -> list[Planner]:
    parallel = [make_planner(name, grid=SHAPE, degree_of_parallelism=DOP) for name in ("psca", "tetris")]
    return [*parallel, make_planner("hca", grid=SHAPE)]


def cases(rng: np.random.Generator) -> Iterator[Case]:
    """Right plans without end; each is checked first."""
    targets = [make_target(name, rows=9, cols=9, grid=SHAPE) for name in ("compact", "sierpinski", "kagome")]
    made = planners()
    while True:
        atoms: Occupancy = rng.random(SHAPE) < rng.uniform(0.6, 0.9)
        target = targets[int(rng.integers(len(targets)))]
        plan = made[int(rng.integers(len(made)))].plan(atoms, target)
        if plan.n_batches == 0:
            continue
        before = [atoms]
        for a, b in pairwise(plan.batch_offsets.tolist()):
            after = before[-1].copy()
            moves = plan.moves[a:b]
            after[moves[:, 0], moves[:, 1]] = False
            inside = moves[((moves[:, 2:] >= 0) & (moves[:, 2:] < SHAPE)).all(axis=1)]
            after[inside[:, 2], inside[:, 3]] = True
            before.append(after)
        report = check_plan(plan, atoms, target, DOP)
        assert np.array_equal(report.predicted, before[-1])
        yield Case(plan, target, before, rng)


def is_refused(plan: Plan, case: Case) -> bool:
    try:
        check_plan(plan, case.before[0], case.target, DOP)
    except InvalidPlanError as error:
        return bool(error.rule)
    return False


def test_all_damaged_plans_are_refused_and_all_others_accepted() -> None:
    rng = np.random.default_rng(4)
    refused: Counter[str] = Counter()
    for case in cases(rng):
        for damage in DAMAGES:
            plan = damage(case)
            if plan is None:
                continue
            assert is_refused(plan, case), f"{damage.__doc__} It was accepted: {plan.moves.tolist()}"
            refused[damage.__name__] += 1
        if refused.total() >= N_DAMAGED:
            break
    assert set(refused) == {damage.__name__ for damage in DAMAGES}
    assert min(refused.values()) > N_DAMAGED // 100
