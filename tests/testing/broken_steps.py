"""Steps that break one promise each."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from labseq.errors import DeviceError, StopRequested
from labseq.model import TimelineEntry
from labseq.roles import Shot, Step, StepContext
from labseq.testing import StepContract

from .planted import Planted


class Right(Step):
    """Waits, then takes an image."""

    needs_image = False
    takes_image = True

    def plan_timeline(self, context: StepContext) -> Sequence[Any]:
        return [TimelineEntry("wait", 0.1, 0.1), TimelineEntry("image", 0.045, 0.045, n_images=1)]

    def run(self, shot: Shot) -> None:
        shot.clock.sleep(0.1)
        shot.take_image(0.045)


class RunsWithoutAShot(Right):
    def run(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Its signature is wrong."""


class GivesTuples(Right):
    def plan_timeline(self, context: StepContext) -> Sequence[Any]:
        return [("wait", 0.1)]


class UsuallyTakesLonger(Right):
    def plan_timeline(self, context: StepContext) -> Sequence[Any]:
        return [TimelineEntry("wait", 0.15, 0.2, n_images=1)]


class ReadsAFile(Right):
    def __init__(self) -> None:
        Path(os.devnull).read_bytes()


class KnowsItsImagesLater(Right):
    takes_image: Any = None


class TakesLonger(Right):
    def run(self, shot: Shot) -> None:
        super().run(shot)
        shot.clock.sleep(0.1)


class TakesAnotherImage(Right):
    def run(self, shot: Shot) -> None:
        shot.take_image(0.045)
        shot.take_image(0.045)


class RecordedSetup(Right):
    """Right: may be tried again."""

    repeatable: Any = True


class LowersTheTweezers(RecordedSetup):
    def run(self, shot: Shot) -> None:
        shot.static_tweezers.ramp(0.5, 0.0)
        super().run(shot)


class WorksOnce(RecordedSetup):
    has_run = False

    def run(self, shot: Shot) -> None:
        if self.has_run:
            raise DeviceError("shutter", "is open already")
        super().run(shot)
        self.has_run = True


class HearsNothing(Right):
    def run(self, shot: Shot) -> None:
        try:
            super().run(shot)
        except StopRequested:
            return


PLANTED = Planted(
    StepContract(),
    Right,
    (
        (RunsWithoutAShot, "test_runs"),
        (GivesTuples, "test_lays_out_its_timeline"),
        (UsuallyTakesLonger, "test_lays_out_its_timeline"),
        (ReadsAFile, "test_timeline_is_pure"),
        (KnowsItsImagesLater, "test_declares_its_images"),
        (TakesLonger, "test_keeps_its_timeline"),
        (TakesAnotherImage, "test_keeps_its_timeline"),
        (LowersTheTweezers, "test_runs_again"),
        (WorksOnce, "test_runs_again"),
        (HearsNothing, "test_hears_a_stop_request"),
    ),
)
