"""The camera's series, armed once for consecutive images with the same exposure time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

from labseq.errors import DeviceError
from labseq.guard import DRIVER_MARGIN_S
from labseq.model import Frame, TimedBy, TimelineEntry
from labseq.model.lines import IDLE
from labseq.roles import Camera, StepContext, Trigger
from labseq.sequencer.lab import Lab
from labseq.sequencer.lines import blinding_lines, trigger_line


def take_frame(
    camera: Camera,
    name: str,
    exposure_s: float,
    call: Callable[..., Any],
    max_wait_s: float,
    light: AbstractContextManager[object],
) -> Frame:
    """Take one frame with a camera, armed for this frame only.

    Args:
        exposure_s: Exposure time, in seconds.
        call: Calls a device, as ``call(name, timeout_s, function, *arguments)``.
        max_wait_s: Longest time of a call beyond the exposure, in seconds.
        light: Entered before the exposure, once the camera is ready, and left after the frame has come.

    Raises:
        DeviceError: The camera has an EM gain, only an external trigger, or did not return a frame.
    """
    facts = camera.facts
    if facts.em_gain > 1:
        text = f"with an EM gain of {facts.em_gain:g} light other than the atoms' would age the EM register"
        raise DeviceError(name, f"{text}; set `em_gain` of this camera to 1")
    own: tuple[Trigger, ...] = ("software", "internal")
    trigger = next((one for one in own if one in facts.triggers), None)
    if trigger is None:
        raise DeviceError(name, "it takes frames on an external trigger only; expected a software trigger")
    limit_s = max_wait_s + exposure_s
    arm = partial(call, name, limit_s, camera.arm, 1, exposure_s, trigger)
    if trigger == "software":
        arm()
    with light:
        if trigger == "software":
            call(name, limit_s, camera.trigger)
        else:
            arm()  # only now, because the internal trigger starts the exposure at once
        frame = call(name, limit_s + DRIVER_MARGIN_S, camera.read, limit_s)
    return as_frame(name, frame)


def as_frame(name: str, frame: object) -> Frame:
    """Check the object that a camera's ``read()`` returned.

    Raises:
        DeviceError: It is not a frame.
    """
    if not isinstance(frame, Frame):
        raise DeviceError(name, f"read() returned {type(frame).__name__}; expected a Frame")
    return frame


def with_waits(
    timelines: Sequence[Sequence[TimelineEntry]], context: StepContext
) -> list[list[TimelineEntry]]:
    """The timelines of a shot's steps, with the waits for a camera that starts its exposures by itself."""
    camera, since_s, exposure_s = context.camera, math.inf, math.nan
    found = [[*entries] for entries in timelines]
    if camera.line_trigger != "external_start" or trigger_line(context.lines, "camera") is None:
        return found
    for number, entries in enumerate(timelines):
        found[number] = []
        for entry in entries:
            wait_s = camera.cycle_s - since_s
            if entry.n_images and entry.exposure_s == exposure_s and wait_s > 0:
                by = TimedBy("camera")
                wait = TimelineEntry("wait for the camera", wait_s, wait_s, kind=IDLE, timed_by=by)
                found[number].append(wait)
            if entry.n_images:
                since_s, exposure_s = 0.0, entry.exposure_s
            since_s += entry.duration_s
            found[number].append(entry)
    return found


class CameraSeries:
    """Arms the camera once for consecutive images of a shot with the same exposure time.

    A camera with EM gain is disarmed whenever harmful light may be on, because it clears its sensor through
    the EM register between exposures as well.

    Args:
        call: Calls the camera within the time limit of a call.

    Attributes:
        timelines: The timeline of each step of the shot. Without them, each image is armed for on its own.
        by_line: Whether a line of the timing box triggers the camera.
        cycle_s: Time from one exposure to the next if the camera starts them by itself, in seconds. Else 0.
        fire_s: When the lines must be fired for such an exposure, on the session's clock. nan for none.
        arm_s: Time that arming takes, in seconds.
    """

    def __init__(self, lab: Lab, call: Callable[..., Any]) -> None:
        facts = lab.camera.facts
        self.by_line = trigger_line(lab.line_specs, "camera") is not None
        self._camera, self._specs, self._call = lab.camera, lab.line_specs, call
        self.timelines: Sequence[Sequence[TimelineEntry]] = ()
        self.arm_s = facts.arm_s
        self._has_gain = facts.em_gain > 1.0
        self._is_lit_between = self._has_gain and bool(blinding_lines(lab.line_specs, IDLE))
        self._is_armed, self._n_left, self._exposure_s = False, 0, math.nan
        self._step = self._n_taken = 0
        self._trigger = facts.line_trigger if self.by_line else "software"
        self.cycle_s = facts.cycle_s if self._trigger == "external_start" else 0.0
        self.fire_s = math.nan

    def entries(self, number: int) -> Sequence[TimelineEntry]:
        """The timeline of a step, empty if it is not known."""
        return self.timelines[number] if number < len(self.timelines) else ()

    def begin_step(self, number: int) -> None:
        """Begin a step. Disarm the camera if light of this step may harm it."""
        self._step, self._n_taken = number, 0
        if any(self._may_blind(entry) for entry in self.entries(number)):
            self.end()

    def is_ready(self, exposure_s: float) -> bool:
        """Whether the camera is armed for an image."""
        return self._n_left > 0 and exposure_s == self._exposure_s

    def arm(self, exposure_s: float) -> None:
        """Arm for an image and the images after it that have the same exposure time."""
        n_frames = 1 if self._is_lit_between else max(1, sum(self._alike(exposure_s)))
        self._n_left, self._is_armed, self.fire_s = 0, True, math.nan
        self._call(self._camera.arm, n_frames, exposure_s, self._trigger)
        self._n_left, self._exposure_s = n_frames, exposure_s

    def taken(self, fired_s: float) -> None:
        """Count an image. ``fired_s`` is when the lines were fired for it, on the session's clock."""
        if self.cycle_s:  # counted from the first edge, as the camera does, so that delays do not add up
            self.fire_s = self.cycle_s + (fired_s if math.isnan(self.fire_s) else self.fire_s)
        self._n_left, self._n_taken = self._n_left - 1, self._n_taken + 1
        if self._is_lit_between:
            self.end()

    def end(self) -> None:
        """Disarm the camera, if it is armed."""
        if self._is_armed:
            self._call(self._camera.disarm)
        self.forget()

    def forget(self) -> None:
        """Forget the series, because the camera was made safe and the step begins again."""
        self._is_armed, self._n_left, self._n_taken = False, 0, 0

    def _alike(self, exposure_s: float) -> Iterator[int]:
        """Numbers of the next images, up to another exposure time or light that may harm the camera."""
        n_before = self._n_taken
        for number in range(self._step, len(self.timelines)):
            for entry in self.timelines[number]:
                skipped = min(n_before, entry.n_images)
                n_before -= skipped
                if self._may_blind(entry) or (entry.n_images > skipped and entry.exposure_s != exposure_s):
                    return
                yield entry.n_images - skipped

    def _may_blind(self, entry: TimelineEntry) -> bool:
        if not self._has_gain:
            return False
        # a step without a kind may command a light, or wait for another system that does
        return not entry.kind or bool(blinding_lines(self._specs, entry.kind))
