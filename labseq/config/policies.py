"""What a sequence says of failures, of stages over their budgets, and of values that go astray."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from labseq.config.fields import Text, empty_is, setting_error
from labseq.config.settings import Duration, Settings


class StepPolicySettings(Settings):
    """``policy`` beside a step: what holds for it, in place of what holds for the run."""

    timeout: Annotated[Duration, Field(gt=0)] | None = Field(
        default=None, description="how long a try at the step may take; one that takes longer has failed"
    )
    retries: int = Field(
        default=0,
        ge=0,
        le=100,
        description="how often the step is tried again, in the same shot, before it counts as failed; for "
        "steps that leave the atoms where they are",
    )
    on_failure: Literal["repeat_shot", "skip_point", "stop"] | None = Field(
        default=None,
        description="what follows its failure; none: as the run's policy says",
    )
    over_budget: Literal["record", "warn", "repeat_shot", "skip_point", "stop"] | None = Field(
        default=None,
        description="what follows a stage of it that takes longer than its budget; none: as the run's "
        "policy says",
    )


class CheckSettings(Settings):
    """A value of the last shots that is looked at between two shots."""

    value: Text = Field(
        description="name of the value, as `labseq export` calls it: `filling_fraction`, `n_missing_atoms`, "
        "`stage.plan_s`, `reading.laser.power_w`"
    )
    at_least: float | None = Field(default=None, description="smallest mean that is let pass, SI")
    at_most: float | None = Field(default=None, description="largest mean that is let pass, SI")
    shots: int = Field(default=1, ge=1, le=10_000, description="of how many shots, the latest, the mean is")
    then: Literal["warn", "skip_point", "stop"] = Field(
        default="warn", description="what follows a mean beyond the limits"
    )

    @model_validator(mode="after")
    def _has_limits(self) -> Self:
        if self.at_least is None and self.at_most is None:
            raise setting_error("the check has no limit", "'at_least', 'at_most' or both")
        if self.at_least is not None and self.at_most is not None and self.at_least > self.at_most:
            what = f"at_least is {self.at_least:g}, but at_most is {self.at_most:g}"
            raise setting_error(what, "limits with something between them", at=("at_least",))
        return self


class PolicySettings(Settings):
    """``policy`` of a sequence: what holds for the run, and for every step that says nothing else."""

    on_failure: Literal["repeat_shot", "skip_point", "stop"] | None = Field(
        default=None,
        description="what follows a failure; none: a transient one repeats the shot, any other stops the run",
    )
    when_exhausted: Literal["skip_point", "stop"] = Field(
        default="stop", description="what follows when a shot has failed `attempts` times"
    )
    over_budget: Literal["record", "warn", "repeat_shot", "skip_point", "stop"] = Field(
        default="record", description="what follows a stage that takes longer than its budget"
    )
    checks: Annotated[tuple[CheckSettings, ...], empty_is(())] = Field(
        default=(), description="values that are looked at between the shots"
    )


class BudgetSettings(Settings):
    """What the computer may take for the stages whose length nothing else says."""

    detect: Duration = Field(default=5e-3, description="finding the atoms on a frame")
    plan: Duration = Field(default=5e-3, description="planning a cycle")
    check: Duration = Field(default=2e-3, description="checking a plan")
    tones: Duration = Field(default=2e-3, description="making the tone program of a plan")
    write: Duration = Field(default=50e-3, description="writing a shot to the disk")
