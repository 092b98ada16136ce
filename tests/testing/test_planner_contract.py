"""What the planners' suite says, and a planner that serves certain targets only."""

import threading
from functools import partial
from typing import ClassVar

import numpy as np
import pytest

from labseq.errors import PlanError
from labseq.model import Occupancy, Plan, TargetPattern
from labseq.testing import ContractViolation, PlannerContract
from labseq.testing.contracts.planner import RETURNS_A_PLAN
from labseq.testing.fakes import OneByOnePlanner, ScriptedPlanner

from .broken_planners import CreatesAnAtom, DoesNothing, Suite
from .planted import failed_tests


class ServesOnly(PlannerContract):
    """A planner for one target, 2 x 2 in the corner of 3 x 3."""

    fills_any_target: ClassVar[bool] = False
    targets = (TargetPattern(np.pad(np.ones((2, 2), np.bool_), (0, 1)), np.zeros((3, 3), np.bool_)),)
    n_examples: ClassVar[int] = 15


class KnowsOneTarget(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        if not any(np.array_equal(target.fill, known.fill) for known in ServesOnly.targets):
            raise PlanError("this target is not served")
        return super().plan(occupancy, target)


class KnowsNoTarget(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        super().plan(occupancy, target)
        raise PlanError("this target is not served")


def test_a_planner_may_serve_certain_targets_only() -> None:
    assert failed_tests(ServesOnly(), partial(KnowsOneTarget, None)) == {}


def test_but_those_it_must_serve() -> None:
    failed = failed_tests(ServesOnly(), partial(KnowsNoTarget, None))
    assert failed["test_plans_for_extremes"].promise == RETURNS_A_PLAN
    assert "raised PlanError: this target is not served" in str(failed["test_plans_for_extremes"])


def test_a_test_that_cannot_go_on_is_skipped_where_another_tells_why() -> None:
    with pytest.raises(pytest.skip.Exception, match="cannot go on: promise: no atom is created"):
        Suite().test_fills_the_target(partial(CreatesAnAtom, None))


def test_but_fails_where_no_other_does() -> None:
    class Blind(Suite):
        test_creates_no_atom = Suite.test_is_pure

    with pytest.raises(ContractViolation, match="no atom is created"):
        Blind().test_fills_the_target(partial(CreatesAnAtom, None))


def test_a_planner_that_hangs_is_given_up() -> None:
    released = threading.Event()

    class Hangs(OneByOnePlanner):
        def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
            released.wait(30)
            return super().plan(occupancy, target)

    class Impatient(Suite):
        time_limit_s: ClassVar[float] = 0.01

    with pytest.raises(ContractViolation, match=r"plan\(\) has not returned after 0.02 s"):
        Impatient().test_plans_in_time(partial(Hangs, None))
    released.set()


def test_a_message_draws_the_case_that_failed() -> None:
    with pytest.raises(ContractViolation, match=r"leaves 0 defects and 1 surplus atoms of\n\s*!  \(# "):
        PlannerContract().test_fills_the_target(partial(DoesNothing, None))


def test_the_smallest_case_is_reported() -> None:
    with pytest.raises(ContractViolation) as raised:
        PlannerContract().test_creates_no_atom(partial(CreatesAnAtom, None))
    assert raised.value.detail == "batch 1 takes an atom from (0, 0); there is none"


def test_what_is_no_plan_is_named() -> None:
    with pytest.raises(ContractViolation, match="it returned a str"):
        Suite().test_returns_a_plan(lambda context: ScriptedPlanner(["left, then up"]))
