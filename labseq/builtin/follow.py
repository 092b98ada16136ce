"""The step ``wait: {for: go}``, loaded only if another control system leads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from labseq.plugin import ConfigError, Problem, Shot, Step, StepContext, TimelineEntry
from labseq.plugin.lines import find_leader


class FollowStep(Step):
    """Waits for the start signal of another control system."""

    notes = ()

    def __init__(self, signal: str, timeout_s: float, device: str = "") -> None:
        self.signal = signal
        self.timeout_s = timeout_s
        self.device = device

    def check_devices(
        self,
        devices: Mapping[str, object],
        context: StepContext,  # noqa: ARG002 - of the role
    ) -> Mapping[str, str | Problem]:
        """Find the device that receives the signal."""
        try:
            find_leader(devices, self.device)
        except ConfigError as error:
            return {"device" if self.device else "for": str(error)}
        return {}

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002 - of the role
        """One entry, at most the timeout. The lines are idle, because the length of the wait is unknown."""
        return [TimelineEntry(f"wait for {self.signal}", self.timeout_s, 0.0)]

    def run(self, shot: Shot) -> None:
        """Wait for the signal."""
        shot.follow(self.signal, self.timeout_s, self.device)
