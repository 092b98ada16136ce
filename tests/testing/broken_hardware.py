"""Cameras that break one promise each of those that all hardware makes."""

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from labseq.errors import DeviceError, DeviceTimeoutError
from labseq.model import Frame
from labseq.roles import Context, Trigger
from labseq.testing import CameraContract
from labseq.testing.fakes import RecordingCamera

from .planted import Planted


class CannotBeTriggered(RecordingCamera):
    def trigger(self) -> None:
        raise OSError("no answer")


class Sleeps(RecordingCamera):
    def read(self, timeout_s: float) -> Frame:
        time.sleep(1e-9)
        return super().read(timeout_s)


class ReadsAFile(RecordingCamera):
    def __init__(self, context: Context) -> None:
        super().__init__(context)
        Path(os.devnull).read_bytes()


class OpensOnce(RecordingCamera):
    def open(self) -> None:
        if self.is_open:
            raise DeviceError(self.name, "it is open already")
        super().open()


class ClosesOnce(RecordingCamera):
    closed = False

    def close(self) -> None:
        if self.closed:
            raise AttributeError("'NoneType' object has no attribute 'close'")
        super().close()
        self.closed = True

    def open(self) -> None:
        super().open()
        self.closed = False


class OpensOnlyOnceEver(RecordingCamera):
    closed = False

    def open(self) -> None:
        if self.closed:
            raise DeviceError(self.name, "the handle was given back")
        super().open()

    def close(self) -> None:
        super().close()
        self.closed = True


class ClosesOnlyWhatIsOpen(RecordingCamera):
    opened = False

    def open(self) -> None:
        super().open()
        self.opened = True

    def close(self) -> None:
        if not self.opened:
            raise DeviceError(self.name, "it was never opened")
        super().close()


class NeedsTheDeviceToBeSafe(RecordingCamera):
    opened = False

    def open(self) -> None:
        super().open()
        self.opened = True

    def safe_state(self) -> None:
        if not self.opened:
            raise DeviceError(self.name, "safe_state() before open()")
        super().safe_state()


class UnsafeAfterClose(RecordingCamera):
    closed = False

    def close(self) -> None:
        super().close()
        self.closed = True

    def safe_state(self) -> None:
        if self.closed:
            raise OSError("bad file descriptor")
        super().safe_state()


class UnsafeWhileArmed(RecordingCamera):
    n_frames = 0

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        super().arm(n_frames, exposure_s, trigger)
        self.n_frames = n_frames

    def safe_state(self) -> None:
        if self.n_frames > 1:
            self.n_frames = 0  # the second call works
            raise DeviceError(self.name, "cannot stop a series")
        super().safe_state()


class SafeOnlyOnce(RecordingCamera):
    is_safe = False

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        self.is_safe = False
        super().arm(n_frames, exposure_s, trigger)

    def safe_state(self) -> None:
        if self.is_safe:
            raise DeviceError(self.name, "it is safe already")
        self.is_safe = True
        super().safe_state()


class ClosesToBeSafe(RecordingCamera):
    def safe_state(self) -> None:
        super().safe_state()
        self.is_open = False


class CannotBeClosedAfterAFailure(RecordingCamera):
    failed = False

    def read(self, timeout_s: float) -> Frame:
        try:
            return super().read(timeout_s)
        except DeviceTimeoutError:
            self.failed = True
            raise

    def close(self) -> None:
        if self.failed:
            raise OSError("resource busy")
        super().close()


class DescribesInNumpy(RecordingCamera):
    def describe(self) -> Mapping[str, Any]:
        return {**super().describe(), "temperature": np.float32(-70.0)}


class DescribesWithNan(RecordingCamera):
    def describe(self) -> Mapping[str, Any]:
        return {**super().describe(), "temperature": float("nan")}


class ArmsWhileClosed(RecordingCamera):
    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        was_open, self.is_open = self.is_open, True
        try:
            super().arm(n_frames, exposure_s, trigger)
        finally:
            self.is_open = was_open


class TakesAnyExposure(RecordingCamera):
    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        super().arm(n_frames, exposure_s if 0 < exposure_s < 10 else 0.01, trigger)


class RefusesAfterAWait(RecordingCamera):
    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        if not exposure_s > 0:
            self.clock.sleep(0.1)
        super().arm(n_frames, exposure_s, trigger)


class RefusesAfterAnExposure(RecordingCamera):
    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        assert self.simulation is not None
        if exposure_s > 10:
            self.simulation.expose(self.clock.now(), exposure_s)
        super().arm(n_frames, exposure_s, trigger)


class IsStuckAfterARefusal(RecordingCamera):
    stuck = False

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        if self.stuck:
            raise DeviceError(self.name, "the last series was not ended")
        self.stuck = n_frames < 1
        super().arm(n_frames, exposure_s, trigger)


class RaisesItsOwnTimeout(RecordingCamera):
    def read(self, timeout_s: float) -> Frame:
        try:
            return super().read(timeout_s)
        except DeviceTimeoutError as error:
            raise TimeoutError("no frame") from error


class WaitsLonger(RecordingCamera):
    def read(self, timeout_s: float) -> Frame:
        return super().read(10 * timeout_s)


class PollsForEver(RecordingCamera):
    def read(self, timeout_s: float) -> Frame:
        while True:
            try:
                return super().read(timeout_s)
            except DeviceTimeoutError:
                pass


class CallsItselfAndor(RecordingCamera):
    def use(self, method: str, *args: Any, **kwargs: Any) -> None:
        try:
            super().use(method, *args, **kwargs)
        except DeviceError as error:
            raise DeviceError("andor", str(error)) from error


class Suite(CameraContract):
    max_wait_s: ClassVar[float] = 0.15


PLANTED = Planted(
    Suite(),
    RecordingCamera,
    (
        (CannotBeTriggered, "test_works"),
        (Sleeps, "test_keeps_timeouts"),
        (ReadsAFile, "test_constructor_does_no_io"),
        (OpensOnce, "test_opens_and_closes_twice"),
        (ClosesOnce, "test_opens_and_closes_twice"),
        (OpensOnlyOnceEver, "test_opens_and_closes_twice"),
        (ClosesOnlyWhatIsOpen, "test_closes_before_open"),
        (NeedsTheDeviceToBeSafe, "test_safe_state_in_every_state"),
        (UnsafeAfterClose, "test_safe_state_in_every_state"),
        (UnsafeWhileArmed, "test_safe_state_in_every_state"),
        (SafeOnlyOnce, "test_safe_state_in_every_state"),
        (ClosesToBeSafe, "test_works_after_safe_state"),
        (CannotBeClosedAfterAFailure, "test_closes_after_failures"),
        (DescribesInNumpy, "test_describes_itself"),
        (DescribesWithNan, "test_describes_itself"),
        (ArmsWhileClosed, "test_refuses_calls_while_closed"),
        (TakesAnyExposure, "test_refuses_what_exceeds_limits"),
        (RefusesAfterAWait, "test_refuses_what_exceeds_limits"),
        (RefusesAfterAnExposure, "test_refuses_what_exceeds_limits"),
        (IsStuckAfterARefusal, "test_refuses_what_exceeds_limits"),
        (RaisesItsOwnTimeout, "test_keeps_timeouts"),
        (WaitsLonger, "test_keeps_timeouts"),
        (PollsForEver, "test_keeps_timeouts"),
        (CallsItselfAndor, "test_errors_name_the_device"),
    ),
)
