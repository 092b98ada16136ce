"""Calls into steps: whatever a step raises is named."""

from __future__ import annotations

import math
from collections.abc import Generator
from contextlib import contextmanager

from labseq.errors import LabseqError
from labseq.model import TimelineEntry
from labseq.roles import Shot, Step, StepContext


def lay_out(step: Step, number: int, name: str, context: StepContext) -> list[TimelineEntry]:
    """A step's timeline. For a guarded call."""
    with _named(number, name):
        return list(step.plan_timeline(context))


def budget_s(step: Step, number: int, name: str, context: StepContext, detect_s: float) -> float:
    """What a step may take at most, in seconds. For a guarded call.

    Args:
        step: The step.
        number: Its index.
        name: Its name.
        context: What it lays out its timeline by.
        detect_s: What finding the atoms on an image may take; a timeline leaves that out.

    Returns:
        Nan if it does not say how long it takes.
    """
    with _named(number, name):
        bars = step.plan_timeline(context)
        planned_s = sum(bar.duration_s for bar in bars)
        return planned_s + detect_s * sum(bar.n_images for bar in bars) if planned_s else math.nan


def run_step(step: Step, number: int, name: str, shot: Shot) -> None:
    """Run a step. For a guarded call."""
    with _named(number, name):
        step.run(shot)


@contextmanager
def _named(number: int, name: str) -> Generator[None]:
    """Name the step in whatever it raises; labseq's own errors pass as they are."""
    try:
        yield
    except LabseqError:
        raise
    except BaseException as error:
        text = f"step {number} ({name}) raised {type(error).__name__}: {error}"
        raise LabseqError(text) from error
