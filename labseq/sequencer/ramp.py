"""The step that ramps the depth of the static tweezers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from labseq.lines import margin_s
from labseq.model import TimelineEntry
from labseq.roles import Shot, StepContext


class _Settings(Protocol):
    @property
    def depth(self) -> float: ...
    @property
    def duration(self) -> float: ...


class RampStep:
    """Ramps the static tweezers to a depth, linearly and without a jump.

    They keep it until the next ramp or the end of the shot: each shot begins at the nominal depth.
    """

    needs_image = False
    takes_image = False

    def __init__(self, settings: _Settings) -> None:
        self.depth = settings.depth
        self.duration_s = settings.duration

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One bar."""
        duration_s = self.duration_s + margin_s(context.lines, "ramp")
        return [TimelineEntry(f"ramp to {self.depth:g}", duration_s, duration_s, kind="ramp")]

    def run(self, shot: Shot) -> None:
        """Ramp, and wait for the end."""
        limit_s = self.duration_s + shot.call_timeout_s
        with shot.lines_on("ramp", self.duration_s):
            shot.call("static_tweezers", limit_s, shot.static_tweezers.ramp, self.depth, self.duration_s)
        shot.log("ramped", device="static_tweezers", depth=self.depth, duration_s=self.duration_s)
