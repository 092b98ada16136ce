"""Each promise of a planner is broken once, and the suite names that promise and no other."""

import itertools
import os
import random
import threading
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import Phase, settings

from labseq.errors import PlanError
from labseq.model import Batch, Occupancy, Plan, TargetPattern
from labseq.testing import BrokenPromise, PlannerContract
from labseq.testing.contracts import planner as contract
from labseq.testing.contracts.planner_cases import Case, loaded
from labseq.testing.fakes import OneByOnePlanner, ScriptedPlanner


class Suite(PlannerContract):
    """The suite with less to do: what fails is known here."""

    def large_cases(self) -> list[Case]:
        inside = np.pad(np.ones((4, 4), np.bool_), 2)
        board = inside & (np.indices(inside.shape).sum(axis=0) % 2 == 0)
        targets = TargetPattern(inside, np.zeros_like(inside)), TargetPattern(board, inside & ~board)
        return [loaded(target) for target in targets]

    def trials(self) -> settings:
        quick = set(Phase) - {Phase.shrink, Phase.explain}
        return settings(super().trials(), max_examples=20, phases=quick)


class ReturnsBatches(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Any:
        return list(super().plan(occupancy, target).batches)


class ReturnsNothingWhenThereIsNothingToDo(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Any:
        plan = super().plan(occupancy, target)
        return plan if plan.n_batches else None


class FailsOnOneRow(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        plan = super().plan(occupancy, target)
        if target.shape[0] == 1:
            raise IndexError("index 1 is out of bounds")
        return plan


class RefusesEmptyTargets(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        if target.n_atoms == 0:
            raise PlanError("a target without atoms")
        return super().plan(occupancy, target)


class CreatesAnAtom(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        plan = super().plan(occupancy, target)
        empty = np.argwhere(~np.asarray(occupancy))
        if not len(empty):
            return plan
        return Plan.from_batches([([empty[0]], [empty[-1]]), *plan.batches])


class MovesTheSameAtomTwiceAtOnce(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        plan = super().plan(occupancy, target)
        twice = [Batch(np.repeat(b.from_sites, 2, 0), np.repeat(b.to_sites, 2, 0)) for b in plan.batches]
        return Plan.from_batches(twice)


class LinksEverything(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        plan = super().plan(occupancy, target)
        return Plan(plan.moves, plan.batch_offsets, np.ones(plan.n_batches, np.bool_))


class CutsCorners(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        cut: list[Batch] = []
        for batch in super().plan(occupancy, target).batches:
            if cut and np.array_equal(cut[-1].to_sites, batch.from_sites):
                batch = Batch(cut.pop().from_sites, batch.to_sites)
            cut.append(batch)
        return Plan.from_batches(cut)


class DoesNothing(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        super().plan(occupancy, target)
        return Plan.from_batches([])


class ForgetsToClear(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        return super().plan(occupancy, TargetPattern(target.fill, np.zeros_like(target.clear)))


class GivesUpWithTooFewAtoms(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        plan = super().plan(occupancy, target)
        if np.count_nonzero(occupancy) >= target.n_atoms:
            return plan
        return super().plan(occupancy, TargetPattern(np.zeros_like(target.fill), target.fill))


class RemembersHowOftenItWasAsked(OneByOnePlanner):
    def __init__(self, settings: None = None, context: Any = None) -> None:
        super().__init__(settings, context)
        self.turns = itertools.cycle((1, -1))

    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        return upside_down(super().plan, occupancy, target, next(self.turns))


class DrawsItsOwnStart(OneByOnePlanner):
    turns = itertools.cycle((1, -1))

    def __init__(self, settings: None = None, context: Any = None) -> None:
        super().__init__(settings, context)
        self.turn = next(DrawsItsOwnStart.turns)

    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        return upside_down(super().plan, occupancy, target, self.turn)


class WritesIntoTheOccupancy(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        plan = super().plan(occupancy, target)
        if occupancy.flags.writeable:
            occupancy[...] = False
        return plan


class WantsToWrite(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        plan = super().plan(occupancy, target)
        occupancy[0, 0] = occupancy[0, 0]
        return plan


class ReadsTheMemoryAsItLies(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        super().plan(occupancy, target)
        as_it_lies = occupancy.ravel(order="K").reshape(occupancy.shape)
        return super().plan(as_it_lies, target)


class ChecksNothing(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        return super().plan(np.resize(occupancy, target.shape) != 0, target)


class FailsSomewhereInside(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        try:
            return super().plan(occupancy, target)
        except ValueError as error:
            raise IndexError("too many indices") from error


class ReadsAFile(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        Path(os.devnull).read_bytes()
        return super().plan(occupancy, target)


class DrawsFromRandom(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        random.random()
        return super().plan(occupancy, target)


class SeedsNumpy(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        np.random.seed(1)  # noqa: NPY002 - the fault
        np.random.random()  # noqa: NPY002 - the fault
        return super().plan(occupancy, target)


def upside_down(plan: Any, occupancy: Occupancy, target: TargetPattern, turn: int) -> Plan:
    """Plan with the rows in reverse order: right, but another plan."""
    turned = plan(np.asarray(occupancy)[::turn], TargetPattern(target.fill[::turn], target.clear[::turn]))
    moves = turned.moves.copy()
    if turn == -1:
        moves[:, [0, 2]] = target.shape[0] - 1 - moves[:, [0, 2]]
    return Plan(moves, turned.batch_offsets)


def test_a_right_planner_keeps_all_promises(keeps_all) -> None:
    keeps_all(PlannerContract(), partial(OneByOnePlanner, None))


@pytest.mark.parametrize(
    ("planner", "test"),
    [
        (ReturnsBatches, "test_returns_a_plan"),
        (ReturnsNothingWhenThereIsNothingToDo, "test_plans_for_extremes"),
        (FailsOnOneRow, "test_plans_for_extremes"),
        (RefusesEmptyTargets, "test_plans_for_extremes"),
        (CreatesAnAtom, "test_creates_no_atom"),
        (MovesTheSameAtomTwiceAtOnce, "test_creates_no_atom"),
        (LinksEverything, "test_plans_are_legal"),
        (CutsCorners, "test_plans_are_legal"),
        (DoesNothing, "test_fills_the_target"),
        (ForgetsToClear, "test_fills_the_target"),
        (GivesUpWithTooFewAtoms, "test_does_what_it_can_with_too_few_atoms"),
        (RemembersHowOftenItWasAsked, "test_same_input_same_plan"),
        (DrawsItsOwnStart, "test_same_input_same_plan"),
        (WritesIntoTheOccupancy, "test_leaves_the_input_untouched"),
        (WantsToWrite, "test_takes_any_memory_layout"),
        (ReadsTheMemoryAsItLies, "test_takes_any_memory_layout"),
        (ChecksNothing, "test_refuses_wrong_input"),
        (FailsSomewhereInside, "test_refuses_wrong_input"),
        (ReadsAFile, "test_is_pure"),
        (DrawsFromRandom, "test_is_pure"),
        (SeedsNumpy, "test_is_pure"),
    ],
)
def test_the_broken_promise_is_named_and_no_other(breaks_only, planner: Any, test: str) -> None:
    breaks_only(Suite(), partial(planner, None), test)


def test_a_slow_planner_breaks_the_time_limit_only(breaks_only, monkeypatch: pytest.MonkeyPatch) -> None:
    watch = itertools.count(0, 3)  # every look at it is three seconds later
    monkeypatch.setattr(contract.time, "perf_counter", lambda: next(watch))
    breaks_only(Suite(), partial(OneByOnePlanner, None), "test_plans_in_time")


def test_a_target_that_is_written_into_is_seen() -> None:
    class WritesIntoTheTarget(OneByOnePlanner):
        def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
            plan = super().plan(occupancy, target)
            target.clear.flags.writeable = True
            target.clear[...] = False
            return plan

    with pytest.raises(BrokenPromise, match="plan\\(\\) changed the target's clear"):
        Suite().test_leaves_the_input_untouched(partial(WritesIntoTheTarget, None))


def test_a_planner_that_hangs_is_given_up() -> None:
    released = threading.Event()

    class Hangs(OneByOnePlanner):
        def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
            released.wait(30)
            return super().plan(occupancy, target)

    class Impatient(Suite):
        time_limit_s: ClassVar[float] = 0.01

    with pytest.raises(BrokenPromise, match=r"plan\(\) has not returned after 0.02 s"):
        Impatient().test_plans_in_time(partial(Hangs, None))
    released.set()


def test_a_message_draws_the_case_that_failed() -> None:
    with pytest.raises(BrokenPromise, match=r"leaves 0 defects and 1 surplus atoms of\n\s*!  \(# "):
        PlannerContract().test_fills_the_target(partial(DoesNothing, None))


def test_the_smallest_case_is_reported() -> None:
    with pytest.raises(BrokenPromise) as raised:
        PlannerContract().test_creates_no_atom(partial(CreatesAnAtom, None))
    assert raised.value.detail == "batch 0 takes an atom from (0, 0); there is none"


def test_what_is_no_plan_is_named() -> None:
    with pytest.raises(BrokenPromise, match="it returned a str"):
        Suite().test_returns_a_plan(lambda context: ScriptedPlanner(["left, then up"]))
