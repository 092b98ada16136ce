"""The built-in steps but the rearrangement: load, image, wait, device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from labseq.lines import margin_s
from labseq.model import TimelineEntry
from labseq.roles import Shot, StepContext
from labseq.units import format_quantity


class _Duration(Protocol):
    @property
    def duration(self) -> float: ...


class _WaitTime(Protocol):
    @property
    def duration(self) -> float | None: ...


class _Exposure(Protocol):
    @property
    def exposure(self) -> float: ...


class _Command(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def do(self) -> str: ...
    @property
    def arguments(self) -> Mapping[str, Any]: ...
    @property
    def timeout(self) -> float: ...


class LoadStep:
    """Lets atoms load for a time, into the static tweezers at the depth that they have."""

    needs_image = False
    takes_image = False

    def __init__(self, settings: _Duration) -> None:
        self.duration_s = settings.duration

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One bar."""
        duration_s = self.duration_s + margin_s(context.lines, "load")
        return [TimelineEntry("load", duration_s, duration_s, kind="load")]

    def run(self, shot: Shot) -> None:
        """Wait while the atom source is on."""
        with shot.lines_on("load", self.duration_s):
            start_s = shot.clock.now()
            shot.clock.sleep(self.duration_s)
            if shot.simulation is not None:
                shot.call("simulation", shot.call_timeout_s, shot.simulation.load, start_s, self.duration_s)


class ImageStep:
    """Takes an image; the last one of a shot decides about its success."""

    needs_image = False
    takes_image = True
    repeatable = True

    def __init__(self, settings: _Exposure) -> None:
        self.exposure_s = settings.exposure

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One bar, read-out included."""
        image_s = self.exposure_s + context.camera.readout_s + margin_s(context.lines, "image")
        return [TimelineEntry("image", image_s, image_s, 1, self.exposure_s, "image")]

    def run(self, shot: Shot) -> None:
        """Take the image and judge the shot on it."""
        shot.take_image(self.exposure_s)
        shot.judge()


class WaitStep:
    """Lets time pass."""

    needs_image = False
    takes_image = False
    repeatable = True

    def __init__(self, settings: _WaitTime) -> None:
        self.duration_s = settings.duration or 0.0

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One bar."""
        text = f"wait {format_quantity(self.duration_s, 'time')}"
        duration_s = self.duration_s + margin_s(context.lines, "wait")
        return [TimelineEntry(text, duration_s, duration_s, kind="wait")]

    def run(self, shot: Shot) -> None:
        """Wait on the session's clock."""
        with shot.lines_on("wait", self.duration_s):
            shot.clock.sleep(self.duration_s)


class DeviceStep:
    """Sends a command to a named device of the profile."""

    needs_image = False
    takes_image = False
    repeatable = True

    def __init__(self, settings: _Command) -> None:
        self.device = settings.name
        self.command = settings.do
        self.arguments = dict(settings.arguments)
        self.timeout_s = settings.timeout

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002 - Protocol
        """One bar without a known length."""
        return [TimelineEntry(f"{self.device}: {self.command}", 0.0, 0.0)]

    def run(self, shot: Shot) -> None:
        """Send the command and wait until the driver returns."""
        device = shot.device(self.device)
        shot.call(self.device, self.timeout_s, device.command, self.command, **self.arguments)
        shot.log("device_command", device=self.device, command=self.command, arguments=self.arguments)
