"""Planners that break one promise each."""

import itertools
import os
import threading
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from labseq.errors import PlanError
from labseq.model import Batch, Occupancy, Plan, TargetPattern
from labseq.testing import PlannerContract
from labseq.testing.contracts.planner import Case, loaded
from labseq.testing.fakes import OneByOnePlanner

from .planted import Planted


class Suite(PlannerContract):
    """The suite with less to do: what fails is known here."""

    n_examples: ClassVar[int] = 10
    now_s: ClassVar[float] = 0.0

    def stopwatch(self) -> float:
        return self.now_s

    def large_cases(self) -> list[Case]:
        inside = np.pad(np.ones((4, 4), np.bool_), 2)
        board = inside & (np.indices(inside.shape).sum(axis=0) % 2 == 0)
        targets = TargetPattern(inside, np.zeros_like(inside)), TargetPattern(board, inside & ~board)
        return [loaded(target) for target in targets]


class ReturnsBatches(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Any:
        return list(super().plan(occupancy, target).batches)


class TakesTheOccupancyAlone(OneByOnePlanner):
    def plan(self, occupancy: Occupancy) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Its signature is wrong."""


class Hangs(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        threading.Event().wait()
        return super().plan(occupancy, target)


class Raises(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        raise IndexError(len(target.fill) + len(occupancy))


class Prints(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        print("planning")
        return super().plan(occupancy, target)


class CountsFromOne(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        plan = super().plan(occupancy, target)
        return Plan(plan.moves + 1, plan.batch_offsets)


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


class WritesIntoTheTarget(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        plan = super().plan(occupancy, target)
        target.clear.flags.writeable = True
        target.clear[...] = False
        return plan


class ReadsTheMemoryAsItLies(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        super().plan(occupancy, target)
        as_it_lies = occupancy.ravel(order="K").reshape(occupancy.shape)
        return super().plan(as_it_lies, target)


class ChecksNothing(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        return super().plan(np.resize(occupancy, target.shape) != 0, target)


class ReadsAFile(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        Path(os.devnull).read_bytes()
        return super().plan(occupancy, target)


class SeedsNumpy(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        np.random.seed(1)  # noqa: NPY002 - the fault
        np.random.random()  # noqa: NPY002 - the fault
        return super().plan(occupancy, target)


class TakesThreeSeconds(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        Suite.now_s += 3.0
        return super().plan(occupancy, target)


def upside_down(plan: Any, occupancy: Occupancy, target: TargetPattern, turn: int) -> Plan:
    """Plan with the rows in reverse order: right, but another plan."""
    turned = plan(np.asarray(occupancy)[::turn], TargetPattern(target.fill[::turn], target.clear[::turn]))
    moves = turned.moves.copy()
    if turn == -1:
        moves[:, [0, 2]] = target.shape[0] - 1 - moves[:, [0, 2]]
    return Plan(moves, turned.batch_offsets)


PLANTED = Planted(
    Suite(),
    partial(OneByOnePlanner, None),
    (
        (partial(ReturnsBatches, None), "test_returns_a_plan"),
        (partial(TakesTheOccupancyAlone, None), "test_returns_a_plan"),
        (partial(Prints, None), "test_is_pure"),
        (partial(CountsFromOne, None), "test_creates_no_atom"),
        (partial(RefusesEmptyTargets, None), "test_returns_a_plan"),
        (partial(CreatesAnAtom, None), "test_creates_no_atom"),
        (partial(CutsCorners, None), "test_plans_are_legal"),
        (partial(DoesNothing, None), "test_fills_the_target"),
        (partial(GivesUpWithTooFewAtoms, None), "test_does_what_it_can_with_too_few_atoms"),
        (partial(RemembersHowOftenItWasAsked, None), "test_same_input_same_plan"),
        (partial(DrawsItsOwnStart, None), "test_same_input_same_plan"),
        (partial(WritesIntoTheOccupancy, None), "test_leaves_the_input_untouched"),
        (partial(WritesIntoTheTarget, None), "test_leaves_the_input_untouched"),
        (partial(ReadsTheMemoryAsItLies, None), "test_takes_any_memory_layout"),
        (partial(ChecksNothing, None), "test_refuses_wrong_input"),
        (partial(ReadsAFile, None), "test_is_pure"),
        (partial(SeedsNumpy, None), "test_is_pure"),
        (partial(TakesThreeSeconds, None), "test_plans_in_time"),
    ),
)
