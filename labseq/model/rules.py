"""Rules of a run: how long calls may take, reactions to failures, and light that must be off."""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass as settings

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
    """``policy`` of a step, in place of the run's policy."""

    timeout_s: Annotated[
        PositiveDuration | None,
        Field(description="longest duration of an attempt at the step; a longer one has failed"),
    ] = None
    retries: Annotated[
        int,
        Field(
            ge=0,
            le=100,
            description="how often the step is repeated, in the same shot, before it counts as failed; for "
            "steps that do not move atoms",
        ),
    ] = 0
    on_failure: Annotated[
        Then | None, Field(description="reaction to its failure; none: that of the run's policy")
    ] = None
    over_budget: Annotated[
        OverBudget | None,
        Field(
            description="reaction to a stage of it that takes longer than its budget; none: that of the "
            "run's policy"
        ),
    ] = None

    @property
    def limit_s(self) -> float:
        """Longest duration of an attempt, on the session's clock, in seconds; infinite without a timeout."""
        return math.inf if self.timeout_s is None else self.timeout_s
