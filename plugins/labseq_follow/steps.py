"""The step ``leader``, which the other control system carries out in the middle of a shot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pydantic import Field

from labseq.plugin import (
    PositiveDuration,
    Settings,
    Shot,
    Step,
    StepContext,
    Text,
    TimedBy,
    TimelineEntry,
)
from labseq.plugin.leader import LEADER, speaking_leader


class LeaderStepSettings(Settings):
    """``leader`` lets the external control system do a step of its own, such as the science."""

    step: Text = Field(description="name of the step, which the control system receives")
    timeout: PositiveDuration = Field(description="longest time until it is done, after which the shot fails")
    device: Text | None = Field(
        default=None, description="device of the control system, needed if the profile has several"
    )


class LeaderStep(Step):
    """Gives the control system its turn, and waits until it reports the end."""

    notes = ()

    def __init__(self, settings: LeaderStepSettings) -> None:
        self.settings = settings

    def check_devices(
        self,
        devices: Mapping[str, object],
        context: StepContext,  # noqa: ARG002 - of the role
    ) -> Mapping[str, str]:
        """Find the device that connects the control system."""
        fault = speaking_leader(devices, self.settings.device or "")
        return {"device" if self.settings.device else "step": fault} if fault else {}

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002 - of the role
        """One entry, at most the timeout. It has no kind, because the control system may switch any light."""
        settings = self.settings
        return [TimelineEntry(f"leader: {settings.step}", settings.timeout, 0.0, timed_by=TimedBy(LEADER))]

    def run(self, shot: Shot) -> None:
        """Wait until the control system's step is done."""
        shot.leave_to_leader(self.settings.step, self.settings.timeout, self.settings.device or "")
