"""Reactions to steps that fail, take too long or exceed a budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

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
from labseq.model.rules import StepPolicy, Then, WhenExhausted

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
    otherwise: StepPolicy = field(default_factory=StepPolicy)
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
