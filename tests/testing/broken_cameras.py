"""Cameras that break one promise each."""

import random
import time
from dataclasses import replace
from typing import Any

import numpy as np

from labseq.model import CameraFacts, Frame
from labseq.plugin.camera import CameraDriver, ExposureResult, Series
from labseq.roles import Context, Trigger
from labseq.testing import CameraContract
from labseq.testing.fakes import RecordingCamera

from .planted import Planted


class SeedsRandom(RecordingCamera):
    def __init__(self, context: Context) -> None:
        super().__init__(context)
        random.seed(4)


class GivesAnArray(RecordingCamera):
    def read(self, timeout_s: float) -> Any:
        frame = super().read(timeout_s)
        return ArrayWithAttributes(frame)


class ArrayWithAttributes:
    """What looks like a frame, but is none."""

    def __init__(self, frame: Frame) -> None:
        self.image = frame.image
        self.exposure_s = frame.exposure_s
        self.t_start_s = frame.t_start_s


class GivesEmptyImages(RecordingCamera):
    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.frame_shape = (0, 0)


class TellsAnotherExposure(RecordingCamera):
    def read(self, timeout_s: float) -> Frame:
        frame = super().read(timeout_s)
        return replace(frame, exposure_s=frame.exposure_s * 1000)


class ExposesOnceMore(RecordingCamera):
    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        super().arm(n_frames + (n_frames == 3), exposure_s, trigger)


class ChangesItsShape(RecordingCamera):
    def trigger(self) -> None:
        super().trigger()
        self.frame_shape = (self.frame_shape[0] + 1, 16)


class TellsTheWallClock(RecordingCamera):
    def read(self, timeout_s: float) -> Frame:
        frame = super().read(timeout_s)
        return replace(frame, t_start_s=frame.t_start_s + 1.7e9)


class TellsTheTimeOfOpening(RecordingCamera):
    def read(self, timeout_s: float) -> Frame:
        frame = super().read(timeout_s)
        return replace(frame, t_start_s=0.0)


class SharesItsBuffer(RecordingCamera):
    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.buffer = np.zeros((16, 16), np.uint16)

    def read(self, timeout_s: float) -> Frame:
        frame = super().read(timeout_s)
        self.buffer[...] = frame.image
        view = self.buffer[:]
        view.flags.writeable = False
        return replace(frame, image=view)


class TriggersUnarmed(RecordingCamera):
    def open(self) -> None:
        super().open()
        self._n_left = 1


class StaysArmed(RecordingCamera):
    def safe_state(self) -> None:
        n_left = self._n_left
        super().safe_state()
        self._n_left = n_left


class CountsOnFromTheLastSeries(RecordingCamera):
    n_taken = 0

    def read(self, timeout_s: float) -> Frame:
        frame = super().read(timeout_s)
        self.n_taken += 1
        return replace(frame, number=self.n_taken - 1)


class StampsBackwards(RecordingCamera):
    def read(self, timeout_s: float) -> Frame:
        frame = super().read(timeout_s)
        return replace(frame, device_time_s=-frame.t_start_s)


class TakesAnyTrigger(RecordingCamera):
    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        super().arm(n_frames, exposure_s, "software")


class SaysItExposesByItself(RecordingCamera):
    @property
    def facts(self) -> CameraFacts:
        return CameraFacts(triggers=("software", "internal"))

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        super().arm(n_frames, exposure_s, "software" if trigger == "internal" else trigger)


class Driver(CameraDriver):
    """A camera whose frames are ready at once, made as the tutorial makes one."""

    series: Any = None
    n_fired = n_taken = 0

    @property
    def facts(self) -> CameraFacts:
        return CameraFacts(1e-3, max_exposure_s=10.0, triggers=("software",))

    def describe(self) -> dict[str, Any]:
        return {}

    def _connect(self) -> None:
        pass

    def _disconnect(self) -> None:
        pass

    def _start(self, series: Series) -> None:
        self.series, self.n_fired, self.n_taken = series, 0, 0

    def _fire(self) -> None:
        self.n_fired += 1

    def _take(self, timeout_s: float) -> ExposureResult | None:
        is_due = self.n_taken < self.n_fired
        self.wait(self.series.exposure_s if is_due else timeout_s)
        self.n_taken += is_due
        return ExposureResult(self.n_taken - 1, np.zeros((16, 16), np.uint16)) if is_due else None

    def wait(self, duration_s: float) -> None:
        self._clock.sleep(duration_s)

    def _stop(self) -> None:
        pass


class WaitsInRealTime(Driver):
    def wait(self, duration_s: float) -> None:
        time.sleep(min(duration_s, 1e-3))


class WaitsForAClockThatItDoesNotMove(Driver):
    def wait(self, duration_s: float) -> None:
        until_s = self._clock.now() + duration_s
        while self._clock.now() < until_s:
            self._clock.check()


class DriverCountsOnFromTheLastSeries(Driver):
    def _start(self, series: Series) -> None:
        self.series, self.n_fired = series, self.n_taken


class ExposesAtEveryEdge(RecordingCamera):
    """With a line, also after ``safe_state``."""

    @property
    def facts(self) -> CameraFacts:
        return CameraFacts(1e-3, max_exposure_s=10.0, triggers=("software", "external"))

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        super().arm(n_frames, exposure_s, "software" if trigger == "external" else trigger)

    def open(self) -> None:
        super().open()
        assert self.simulation is not None
        self.simulation.wire("camera", self.simulation.expose)


class StopsASeriesThatIsNotThere(Driver):
    def _stop(self) -> None:
        self.n_fired = self.series.n_frames


PLANTED = Planted(
    CameraContract(),
    RecordingCamera,
    (
        (SeedsRandom, "test_constructor_does_no_io"),
        (GivesAnArray, "test_gives_a_frame"),
        (GivesEmptyImages, "test_gives_a_frame"),
        (TellsAnotherExposure, "test_gives_a_frame"),
        (ExposesAtEveryEdge, "test_ignores_edges_after_safe_state"),
        (ExposesOnceMore, "test_gives_as_many_frames_as_armed_for"),
        (ChangesItsShape, "test_gives_as_many_frames_as_armed_for"),
        (TellsTheWallClock, "test_tells_when_it_exposed"),
        (TellsTheTimeOfOpening, "test_tells_when_it_exposed"),
        (CountsOnFromTheLastSeries, "test_numbers_its_frames"),
        (StampsBackwards, "test_numbers_its_frames"),
        (TakesAnyTrigger, "test_refuses_unknown_triggers"),
        (SaysItExposesByItself, "test_exposes_by_itself"),
        (SharesItsBuffer, "test_frames_do_not_change"),
        (TriggersUnarmed, "test_refuses_trigger_without_arm"),
        (StaysArmed, "test_refuses_trigger_without_arm"),
        (WaitsInRealTime, "test_works"),
        (DriverCountsOnFromTheLastSeries, "test_numbers_its_frames"),
        (StopsASeriesThatIsNotThere, "test_safe_state_in_every_state"),
    ),
)
