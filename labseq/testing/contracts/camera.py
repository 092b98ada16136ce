"""Promises of a camera."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from typing import Any, ClassVar, Final, get_args

import numpy as np

from labseq.errors import DeviceError
from labseq.model import Frame
from labseq.roles import Camera, Trigger, overrides
from labseq.testing.contracts.hardware import (
    ALWAYS_SAFE,
    WORKS,
    Action,
    Factory,
    HardwareContract,
    Wait,
    n_calls,
)
from labseq.testing.contracts.promises import promise, refusal

NUMBERED: Final = "frames are numbered from 0 in each series, and later ones have later time stamps"


class CameraContract(HardwareContract[Camera]):
    """Promises of a camera with software triggers, and of its other triggers if it has them.

    Attributes:
        exposure_s: Exposure of the test frames, in seconds.
        exposure_tolerance: Greatest relative deviation of a frame's exposure from the requested one.
        timeout_s: Timeout for a frame beyond its exposure, in seconds.
    """

    bases: ClassVar[tuple[str, ...]] = (WORKS, ALWAYS_SAFE, NUMBERED)
    role: ClassVar[str] = "camera"
    how_it_works: ClassVar[str] = (
        "after arm(n) each trigger() exposes a frame, which read() returns. _take of a CameraDriver returns "
        "ExposureResult(number, image), numbers from 0 in each series and the image uint16 (height, width)"
    )
    exposure_s: ClassVar[float] = 0.01
    exposure_tolerance: ClassVar[float] = 0.01
    timeout_s: ClassVar[float] = 2.0

    def work(self, device: Camera) -> None:
        """Take one image."""
        self.take(device)

    def work_time_s(self) -> float:
        """The exposure."""
        return self.exposure_s * (1 - self.exposure_tolerance)

    def uses(self) -> Mapping[str, Action[Camera]]:
        """Arm, trigger, read."""
        return {
            "arm()": lambda camera: camera.arm(1, self.exposure_s, "software"),
            "trigger()": lambda camera: camera.trigger(),
            "read()": lambda camera: camera.read(0.1),
        }

    def states(self) -> Mapping[str, Action[Camera]]:
        """States of an armed camera, while exposing, and with an unread frame."""

        def expose(camera: Camera) -> None:
            camera.arm(2, self.exposure_s, "software")
            camera.trigger()

        def leave_unread(camera: Camera) -> None:
            self.take(camera, 2)
            expose(camera)

        return {
            "while armed": lambda camera: camera.arm(2, self.exposure_s, "software"),
            "while exposing": expose,
            "with a frame unread": leave_unread,
        }

    def excesses(self) -> Mapping[str, Action[Camera]]:
        """Series and exposures that are impossible for any camera."""

        def arm(n_frames: int, exposure_s: float) -> Action[Camera]:
            return lambda camera: camera.arm(n_frames, exposure_s, "software")

        return {
            "arm() for no frames": arm(0, self.exposure_s),
            "arm() for -1 frames": arm(-1, self.exposure_s),
            "arm() with a negative exposure": arm(1, -self.exposure_s),
            "arm() with an exposure of nan": arm(1, float("nan")),
            "arm() with an exposure of a year": arm(1, 3.2e7),
        }

    def waits(self) -> Mapping[str, Wait[Camera]]:
        """Waits for a frame without a software trigger, and without an external trigger."""

        def arm(trigger: Trigger) -> Action[Camera]:
            def enter(camera: Camera) -> None:
                has_it = trigger in camera.facts.triggers
                camera.arm(1, self.exposure_s, trigger if has_it else "software")

            return enter

        read: Action[Camera] = lambda camera: camera.read(0.1)  # noqa: E731 - as in uses()
        return {
            "read() without a trigger": Wait(0.1, arm("software"), read),
            "read() while no external trigger comes": Wait(0.1, arm("external"), read),
        }

    def take(self, camera: Camera, n_frames: int = 1) -> list[Any]:
        """Arm, then trigger and read each frame."""
        camera.arm(n_frames, self.exposure_s, "software")
        frames: list[Any] = []
        for _ in range(n_frames):
            camera.trigger()
            frames.append(camera.read(self.exposure_s + self.timeout_s))
        return frames

    @promise(
        "arm, trigger, read gives a Frame: uint16 (height, width), with the requested exposure",
        "return labseq.plugin.Frame(image, exposure_s, t_start_s, device, number), times in seconds",
    )
    def test_gives_a_frame(self, factory: Factory[Camera]) -> None:
        """One image, as the ``image`` step takes it."""
        with self.opened(factory) as (camera, _):
            frame = self.take(camera)[0]
            assert isinstance(frame, Frame), f"read() gave a {type(frame).__name__}"
            assert frame.image.dtype == np.uint16, f"the image is {frame.image.dtype}"
            assert frame.image.ndim == 2, f"the image has shape {frame.image.shape}"
            assert frame.image.size > 0, f"the image has shape {frame.image.shape}"
            deviation = abs(frame.exposure_s / self.exposure_s - 1.0)
            text = f"the frame's exposure is {frame.exposure_s:g} s; expected {self.exposure_s:g} s"
            assert deviation <= self.exposure_tolerance, text

    @promise("arm(n) gives n frames, the oldest first, and no more")
    def test_gives_as_many_frames_as_armed_for(self, factory: Factory[Camera]) -> None:
        """Take fewer and more frames than armed for. The next series starts from the beginning."""
        with self.opened(factory) as (camera, _):
            shapes = {np.shape(frame.image) for frame in self.take(camera, 3)}
            assert len(shapes) == 1, f"the frames of a series have the shapes {sorted(shapes)}"
            refusal(DeviceError, "a fourth trigger after arm(3)", camera.trigger)
            camera.arm(3, self.exposure_s, "software")
            camera.trigger()
            camera.read(self.exposure_s + self.timeout_s)
            self.take(camera)
            refusal(DeviceError, "a second trigger after arm(1)", camera.trigger)

    @promise(
        NUMBERED,
        "subtract the library's number of the first frame of the series",
    )
    def test_numbers_its_frames(self, factory: Factory[Camera]) -> None:
        """A gap shows that a frame was lost. Time stamps are the camera's own, and optional."""
        with self.opened(factory) as (camera, _):
            for _ in range(2):
                frames = [frame for frame in self.take(camera, 3) if isinstance(frame, Frame)]
                if len(frames) < 3:  # the type of a frame has its own test
                    return
                numbers = [frame.number for frame in frames]
                assert numbers == [0, 1, 2], f"the frames of a series of 3 have the numbers {numbers}"
                stamps = [frame.device_time_s for frame in frames]
                rising = all(b > a for a, b in pairwise(stamps) if not np.isnan([a, b]).any())
                assert rising, f"the time stamps are {stamps}"

    @promise("arm() refuses a trigger that the camera's facts do not list")
    def test_refuses_unknown_triggers(self, factory: Factory[Camera]) -> None:
        """Otherwise the run would wait for an edge that never comes."""
        with self.opened(factory) as (camera, _):
            for trigger in get_args(Trigger):
                if trigger not in camera.facts.triggers:
                    arm = partial(camera.arm, 1, self.exposure_s, trigger)
                    refusal(DeviceError, f"arm() for the {trigger} trigger", arm)
            self.take(camera)

    @promise("with the internal trigger the frames of a series come without trigger()")
    def test_exposes_by_itself(self, factory: Factory[Camera]) -> None:
        """Take a series with the internal trigger, if the camera has it."""
        with self.opened(factory) as (camera, _):
            if "internal" not in camera.facts.triggers:
                return
            camera.arm(3, self.exposure_s, "internal")
            refusal(DeviceError, "trigger() in a series with the internal trigger", camera.trigger)
            starts = [camera.read(self.exposure_s + self.timeout_s).t_start_s for _ in range(3)]
            apart = min(b - a for a, b in pairwise(starts))
            assert apart >= self.exposure_s * (1 - self.exposure_tolerance), f"they start at {starts} s"
            self.take(camera)

    @promise(
        "t_start_s is the start of the exposure on the session's clock",
        "take context.clock.now() at the trigger, not time.time() or time.monotonic()",
    )
    def test_tells_when_it_exposed(self, factory: Factory[Camera]) -> None:
        """Later frames start later, each between its trigger and its read()."""
        with self.opened(factory) as (camera, context):
            camera.arm(3, self.exposure_s, "software")
            last_s = -np.inf
            for _ in range(3):
                context.clock.sleep(1e-3)
                before_s = context.clock.now()
                camera.trigger()
                t_start_s = camera.read(self.exposure_s + self.timeout_s).t_start_s
                after_s = context.clock.now()
                text = (
                    f"a frame triggered at {before_s} s and read at {after_s} s has t_start_s {t_start_s} s"
                )
                assert before_s - 1e-9 <= t_start_s <= after_s + 1e-9, text
                assert t_start_s > last_s, f"t_start_s {t_start_s} s comes after {last_s} s"
                last_s = t_start_s

    @promise("a frame does not change after it was read", "return a copy of the library's buffer")
    def test_frames_do_not_change(self, factory: Factory[Camera]) -> None:
        """Otherwise the next image overwrites the last one in the driver's buffer."""
        with self.opened(factory) as (camera, _):
            frame = self.take(camera)[0]
            before = np.array(frame.image)
            self.take(camera, 3)
            assert np.array_equal(before, frame.image), "the next exposures overwrote it"

    @promise("trigger() without arm() raises DeviceError")
    def test_refuses_trigger_without_arm(self, factory: Factory[Camera]) -> None:
        """Trigger after open(), safe_state() and, if the driver has its own, disarm()."""
        with self.opened(factory) as (camera, _):
            refusal(DeviceError, "trigger() after open()", camera.trigger)
            for name in [*(["disarm"] if overrides(camera, Camera.disarm) else []), "safe_state"]:
                camera.arm(2, self.exposure_s, "software")
                getattr(camera, name)()
                getattr(camera, name)()
                refusal(DeviceError, f"trigger() after {name}()", camera.trigger)

    @promise(
        "after safe_state() no edge of its trigger line starts an exposure",
        "let safe_state() end the acquisition",
    )
    def test_ignores_edges_after_safe_state(self, factory: Factory[Camera]) -> None:
        """Send edges to a camera with the external trigger."""
        with self.wired(factory, "image") as (camera, context, pulse):
            if camera is None or "external" not in camera.facts.triggers:
                return
            camera.arm(1, self.exposure_s, "external")
            camera.safe_state()
            before = n_calls(context)
            pulse(self.exposure_s)
            context.clock.sleep(self.exposure_s)
            assert n_calls(context) == before, "an edge after safe_state() started an exposure"
