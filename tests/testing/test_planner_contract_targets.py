"""A planner may serve certain targets only; those it must serve."""

from functools import partial
from typing import ClassVar

import numpy as np
import pytest

from labseq.errors import PlanError
from labseq.model import Occupancy, Plan, TargetPattern
from labseq.testing import BrokenPromise, PlannerContract
from labseq.testing.fakes import OneByOnePlanner


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


def test_a_planner_may_serve_certain_targets_only(keeps_all) -> None:
    keeps_all(ServesOnly(), partial(KnowsOneTarget, None))


def test_but_those_it_must_serve() -> None:
    with pytest.raises(BrokenPromise, match="raised PlanError: this target is not served"):
        ServesOnly().test_fills_the_target(partial(KnowsNoTarget, None))
