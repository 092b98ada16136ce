"""PSCA keeps the promises of a planner, in each variant and with few tones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import ClassVar

import pytest
from labseq_psca.planner import PscaPlanner, PscaSettings

from labseq import (
    Context,
)
from labseq.testing import PlannerContract


class TestPscaContract(PlannerContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings())


class TestPaperVariantContract(PlannerContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings(variant="paper"))


class TestRepairContract(PlannerContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings(repair_below=1))


class TestPscaOneAtATime(PlannerContract):
    n_examples: ClassVar[int] = 20

    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings(degree_of_parallelism=1))


class TestPscaWithFewTones(PlannerContract):
    n_examples: ClassVar[int] = 20

    def context(self, shape: tuple[int, int]) -> Context:
        context = super().context(shape)
        return replace(context, motion=replace(context.motion, max_row_tones=2, max_column_tones=3))

    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings(degree_of_parallelism=15))
