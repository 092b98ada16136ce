"""The role of a step, what it knows beforehand, and who watches a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from labseq.model import CameraFacts, LineSpec, MotionSpec, SiteGrid, TargetPattern, TimelineEntry
from labseq.roles.shot import Shot


@dataclass(frozen=True, slots=True)
class StepContext:
    """What a step needs to know to lay out its timeline before anything is opened.

    Attributes:
        grid: The grid of sites.
        motion: How the mobile tweezers move.
        target: What the array shall look like.
        camera: What the camera says of itself before it is opened.
        lines: What is wired to the timing box.
    """

    grid: SiteGrid
    motion: MotionSpec
    target: TargetPattern
    camera: CameraFacts = field(default_factory=CameraFacts)
    lines: tuple[LineSpec, ...] = ()


class Step(Protocol):
    """One step of a shot.

    Attributes:
        needs_image: Whether an image must have been taken before it in the shot.
        takes_image: Whether later steps find an image of it.
    """

    needs_image: bool
    takes_image: bool

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """What the step will do, at most, for ``labseq check``."""
        ...

    def run(self, shot: Shot) -> None:
        """Do it."""
        ...


@runtime_checkable
class Repeatable(Protocol):
    """A step that may be tried again in the same shot when it fails: it leaves the atoms where they are.

    Attributes:
        repeatable: Whether it may; others can only be repeated with the whole shot.
    """

    repeatable: bool


class RunObserver(Protocol):
    """Somebody who watches a run: the live view, a log. Failures never stop the run."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Something happened: "run_started", "shot_started", "stage", "image", ..."""
        ...
