"""Policies of a run: timeouts of calls, light that must be off, and reactions to failures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from labseq.errors import (
    ConfigError,
    DeviceError,
    DeviceHungError,
    InterlockError,
    LabseqError,
    OverBudgetError,
    PluginLoadError,
    RecordingError,
    ShotAbortedError,
    StopRequested,
    TransientError,
    UnknownPluginError,
)
from labseq.settings import IN_SI, PositiveDuration, Text


@settings(frozen=True, slots=True, config=IN_SI)
class Timeouts:
    """How long calls into plugins may take before they count as hung."""

    call_s: Annotated[
        PositiveDuration, Field(description="longest device call, in addition to the duration of its action")
    ] = 10.0
    safe_state_s: Annotated[
        PositiveDuration, Field(description="longest time for a device to reach its safe state")
    ] = 5.0
    plan_s: Annotated[PositiveDuration, Field(description="longest planning of a cycle")] = 5.0
    load_s: Annotated[
        PositiveDuration,
        Field(description="longest loading of a plugin, and longest call of a constructor"),
    ] = 30.0


@settings(frozen=True, slots=True, config=IN_SI)
class Blinding:
    """When a device's light would damage a camera with EM gain."""

    value: Annotated[
        Text, Field(description="the reading of the device that says whether its light is on")
    ] = "state"
    when: Annotated[
        tuple[bool | int | float | str, ...],
        Field(min_length=1, description="readings while the light is on"),
    ] = ("on",)


Then: TypeAlias = Literal["repeat_shot", "skip_point", "stop"]
"""Reaction to a failure."""
OverBudget: TypeAlias = Literal["record", "warn", "repeat_shot", "skip_point", "stop"]
"""Reaction to a stage that took longer than its budget."""
WhenExhausted: TypeAlias = Literal["skip_point", "stop"]
"""Reaction to a shot that has failed in its last attempt."""


@settings(frozen=True, slots=True, config=IN_SI)
class StepPolicy:
    """``policy`` of a step, which replaces the run's policy."""

    timeout_s: Annotated[
        PositiveDuration | None,
        Field(description="longest duration of an attempt at the step, after which it has failed"),
    ] = None
    retries: Annotated[
        int,
        Field(
            ge=0,
            le=100,
            description="how often the step is repeated, in the same shot, before it counts as failed. Only "
            "for steps that do not move atoms",
        ),
    ] = 0
    on_failure: Annotated[
        Then | None, Field(description="reaction to its failure, by default as in the run's policy")
    ] = None
    over_budget: Annotated[
        OverBudget | None,
        Field(
            description="reaction to a stage of it that takes longer than its budget, by default as in the "
            "run's policy"
        ),
    ] = None

    @property
    def limit_s(self) -> float:
        """Longest duration of an attempt, on the session's clock, in seconds. Infinite without a timeout."""
        return math.inf if self.timeout_s is None else self.timeout_s


NO_POLICY: Final = StepPolicy()
"""The policy of steps without their own. A single object, because validating a new one takes 10 us."""

_ENDING: Final = (
    StopRequested,
    InterlockError,
    DeviceHungError,
    ConfigError,
    RecordingError,
    PluginLoadError,
    UnknownPluginError,
)
"""Failures that end the run whatever the policy, because the operator asks for it, a person must look at the
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
    otherwise: StepPolicy = NO_POLICY
    steps: Sequence[StepPolicy] = ()

    def of_step(self, number: int | None) -> StepPolicy:
        """The policy of a step, or for None the policy outside of all steps."""
        if number is None or number >= len(self.steps):
            return self.otherwise
        return self.steps[number]

    def after(self, error: LabseqError, step: int | None, attempt: int) -> Then:
        """The reaction to a failure.

        Args:
            step: Index of the step that failed. None outside of all steps.
            attempt: Number of the attempt at the shot, from 0.
        """
        if isinstance(error, _ENDING):
            return "stop"
        if isinstance(error, ShotAbortedError):  # the leader decides how often
            return "repeat_shot"
        then = error.then if isinstance(error, OverBudgetError) else self.of_step(step).on_failure
        if then is None:
            then = "repeat_shot" if isinstance(error, TransientError) else "stop"
        return self.when_exhausted if then == "repeat_shot" and attempt + 1 >= self.attempts else then


def may_be_retried(error: LabseqError) -> bool:
    """Whether a step that failed with this error may succeed if it is retried in the same shot."""
    if isinstance(error, (*_ENDING, OverBudgetError, ShotAbortedError)):
        return False
    return isinstance(error, DeviceError | TransientError)
