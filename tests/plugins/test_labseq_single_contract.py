"""The planners with a single tweezer keep the promises of their role."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import pytest
from labseq_single.planner import (
    CompressionPlanner,
    HcaPlanner,
    LsapPlanner,
    LsapSquaredPlanner,
    SingleTweezerPlanner,
)

from labseq import Context
from labseq.testing import PlannerContract

Factory = Callable[[Context], SingleTweezerPlanner]


class TestLsap(PlannerContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(LsapPlanner, None)


class TestLsapSquared(PlannerContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(LsapSquaredPlanner, None)


class TestCompression(PlannerContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(CompressionPlanner, None)


class TestHca(PlannerContract):
    n_examples: ClassVar[int] = 100

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(HcaPlanner, None)
