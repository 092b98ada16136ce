"""The stages of a shot: how long each takes, against its budget, and what follows if that is too long."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any

from labseq.errors import OverBudgetError, StepTimeoutError
from labseq.model import ShotRecord, StageTiming
from labseq.model.records import OVERSHOOT_S
from labseq.sequencer.lab import Lab
from labseq.sequencer.policies import StepPolicy
from labseq.units import format_quantity


class Stages:
    """Times the stages of one attempt at a shot, and holds its steps to their policies.

    Args:
        lab: The clock, and budgets of stages that do not know their own.
        record: Where the timings go.
        emit: Told every event: name and values.

    Attributes:
        start_s: Start of the shot, on the session's clock.
        step: Index of the running step.
        policy: What holds for it.
    """

    def __init__(self, lab: Lab, record: ShotRecord, emit: Callable[[str, Mapping[str, Any]], None]) -> None:
        self.start_s = lab.clock.now()
        self.step = 0
        self.policy = StepPolicy()
        self._clock = lab.clock
        self._budgets = lab.budgets
        self._record = record
        self._emit = emit
        self._name = ""
        self._is_warned = False
        self._try_start_s = self.start_s

    def begin_step(self, number: int, name: str, policy: StepPolicy) -> None:
        """What follows belongs to this step."""
        self.step, self._name, self.policy, self._is_warned = number, name, policy, False

    def begin_attempt(self) -> None:
        """A try at the step begins: its timeout counts from here."""
        self._try_start_s = self._clock.now()

    def check_timeout(self) -> None:
        """See whether the step still has time.

        Raises:
            StepTimeoutError: It has not.
        """
        limit_s = self.policy.timeout_s
        if self._clock.now() - self._try_start_s > limit_s + OVERSHOOT_S:
            text = f"step {self.step} ({self._name}) is not done after its timeout of "
            raise StepTimeoutError(text + format_quantity(limit_s, "time"), limit_s)

    @contextmanager
    def around(self, name: str, budget_s: float, cycle: int) -> Generator[None]:
        """Time a stage against its budget; it is recorded however it ends.

        Raises:
            OverBudgetError: It took longer, and the policy of the step does not let that pass.
        """
        start_s, host_start_s = self._clock.now(), time.perf_counter()
        try:
            yield
        finally:
            host_s = time.perf_counter() - host_start_s
            duration_s = self._clock.now() - start_s
            timing = self._keep(name, start_s, duration_s, host_s, budget_s, cycle)
        self._mind(timing)

    def done(self, name: str, duration_s: float, host_s: float, budget_s: float, cycle: int) -> None:
        """Keep the time of a stage that has just ended.

        Raises:
            OverBudgetError: It took longer, and the policy of the step does not let that pass.
        """
        start_s = self._clock.now() - duration_s
        self._mind(self._keep(name, start_s, duration_s, host_s, budget_s, cycle))

    def _keep(
        self, name: str, start_s: float, duration_s: float, host_s: float, budget_s: float, cycle: int
    ) -> StageTiming:
        if math.isnan(budget_s):
            budget_s = self._budgets.get(name, math.nan)
        timing = StageTiming(name, self.step, cycle, start_s - self.start_s, duration_s, host_s, budget_s)
        self._record.timing.append(timing)
        self._emit("stage", {"timing": timing})
        return timing

    def _mind(self, timing: StageTiming) -> None:
        """Do what the step's policy says of a stage over its budget."""
        then = self.policy.over_budget
        if then == "record" or not timing.over_budget or self._is_warned:
            return
        took, budget = (format_quantity(value, "time") for value in (timing.duration_s, timing.budget_s))
        text = f"'{timing.stage}' took {took}; its budget is {budget}"
        if then != "warn":
            raise OverBudgetError(text, then)
        self._is_warned = True  # the stages around it, the step among them, are over theirs by it as well
        self._emit("warning", {"text": f"shot {self._record.shot_index + 1}: {text}"})
