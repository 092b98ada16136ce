"""Reactions to steps that fail, take too long or exceed a budget."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from labseq.errors import (
    ConfigError,
    DeviceError,
    DeviceHungError,
    InterlockError,
    LabseqError,
    OverBudgetError,
    PluginLoadError,
    RecordingError,
    StopRequested,
    TransientError,
    UnknownPluginError,
)

Then = Literal["repeat_shot", "skip_point", "stop"]
"""Reaction to a failure."""
OverBudget = Literal["record", "warn", "repeat_shot", "skip_point", "stop"]
"""Reaction to a stage that took longer than its budget."""
WhenExhausted = Literal["skip_point", "stop"]
"""Reaction to a shot that has failed in its last attempt."""

_ENDING: Final = (
    StopRequested,
    InterlockError,
    DeviceHungError,
    ConfigError,
    RecordingError,
    PluginLoadError,
    UnknownPluginError,
)
"""Failures that end the run whatever the policy: the operator asks for it, a person must look at the
machine, or a repetition would fail again."""


@dataclass(frozen=True, slots=True)
class StepPolicy:
    """The policy of a step.

    Attributes:
        timeout_s: Maximum time of an attempt, on the session's clock; a longer one fails.
        retries: Number of retries before the step counts as failed.
        on_failure: Reaction to its failure; None: a transient failure repeats the shot, others stop the run.
        over_budget: Reaction to a stage of the step that exceeds its budget.
    """

    timeout_s: float = math.inf
    retries: int = 0
    on_failure: Then | None = None
    over_budget: OverBudget = "record"


@dataclass(frozen=True, slots=True)
class RunPolicy:
    """The policies of a run.

    Attributes:
        attempts: Maximum number of attempts at a shot.
        when_exhausted: Reaction when the last attempt has failed.
        otherwise: The policy between steps, and of steps that are not in ``steps``.
        steps: The policy of each step, in order.
    """

    attempts: int = 3
    when_exhausted: WhenExhausted = "stop"
    otherwise: StepPolicy = StepPolicy()
    steps: Sequence[StepPolicy] = ()

    def of_step(self, number: int | None) -> StepPolicy:
        """The policy of a step; None: outside of all steps."""
        if number is None or number >= len(self.steps):
            return self.otherwise
        return self.steps[number]

    def after(self, error: LabseqError, step: int | None, attempt: int) -> Then:
        """The reaction to a failure.

        Args:
            step: Index of the step that failed; None outside of all steps.
            attempt: Number of the attempt at the shot, from 0.
        """
        if isinstance(error, _ENDING):
            return "stop"
        then = error.then if isinstance(error, OverBudgetError) else self.of_step(step).on_failure
        if then is None:
            then = "repeat_shot" if isinstance(error, TransientError) else "stop"
        return self.when_exhausted if then == "repeat_shot" and attempt + 1 >= self.attempts else then


def may_be_retried(error: LabseqError) -> bool:
    """Whether a step that failed with this error may succeed if it is retried in the same shot."""
    if isinstance(error, (*_ENDING, OverBudgetError)):
        return False
    return isinstance(error, DeviceError | TransientError)
