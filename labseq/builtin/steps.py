"""The basic steps: load, image, wait, device, ramp, release."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from labseq.messages import format_plugin_error
from labseq.plugin import (
    COMPUTER,
    Device,
    Duration,
    Fraction,
    LabseqError,
    PositiveDuration,
    Problem,
    Settings,
    Shot,
    Step,
    StepContext,
    Text,
    TimedBy,
    TimelineEntry,
    empty_is,
    format_quantity,
    setting_error,
)


class LoadSettings(Settings):
    """``load``: fill the static tweezers with atoms."""

    duration: Duration = Field(default=0.5, description="how long atoms load")


class LoadStep(Step):
    """Lets atoms load for a time, into the static tweezers at their present depth."""

    notes = ()

    def __init__(self, settings: LoadSettings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One entry."""
        duration_s, timed_by = self.settings.duration + context.margin_s("load"), context.timed_by("load")
        return [TimelineEntry("load", duration_s, duration_s, kind="load", timed_by=timed_by)]

    def run(self, shot: Shot) -> None:
        """Wait while the atom source is on."""
        duration_s = self.settings.duration
        with shot.lines_on("load", duration_s):
            start_s = shot.clock.now()
            shot.clock.sleep(duration_s)
            if shot.simulation is not None:
                shot.call("simulation", shot.call_timeout_s, shot.simulation.load, start_s, duration_s)


class ImageSettings(Settings):
    """``image``: take a picture and find the atoms on it."""

    exposure: PositiveDuration = Field(default=45e-3, description="exposure time of the camera")


class ImageStep(Step):
    """Takes an image. The last image of a shot decides whether the shot succeeded."""

    takes_image = True
    repeatable = True
    notes = ()

    def __init__(self, settings: ImageSettings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One entry, read-out included."""
        exposure_s = self.settings.exposure
        image_s = exposure_s + context.camera.readout_s + context.margin_s("image")
        return [TimelineEntry("image", image_s, image_s, 1, exposure_s, "image", TimedBy("camera"))]

    def run(self, shot: Shot) -> None:
        """Take the image and judge the shot on it."""
        shot.take_image(self.settings.exposure)
        shot.judge()


class RampSettings(Settings):
    """``ramp``: make the static tweezers shallower or deeper, without a jump."""

    device: Literal["static_tweezers"] = Field(
        default="static_tweezers", description="device to ramp, so far only the static tweezers"
    )
    depth: Fraction = Field(description="depth at the end, as a fraction of the nominal depth")
    duration: PositiveDuration = Field(default=5e-3, description="how long the linear ramp takes")


class RampStep(Step):
    """Ramps the static tweezers to a depth, linearly and without a jump.

    They keep it until the next ramp or the end of the shot. Each shot begins at the nominal depth.
    """

    notes = ()

    def __init__(self, settings: RampSettings) -> None:
        self.settings = settings

    def check_devices(self, devices: Mapping[str, object], context: StepContext) -> Mapping[str, str]:
        """Refuse the step if the static tweezers have only one depth."""
        del devices
        fault = "these static tweezers cannot be ramped; switch their light with a line or a device"
        return {} if context.static_tweezers.ramps else {"": fault}

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One entry."""
        duration_s, facts = self.settings.duration + context.margin_s("ramp"), context.static_tweezers
        label = f"ramp to {self.settings.depth:g}"
        by = TimedBy("static_tweezers", facts.resolution_s)
        return [TimelineEntry(label, duration_s, duration_s, 0, 0.0, "ramp", by, facts.latency_s)]

    def run(self, shot: Shot) -> None:
        """Ramp, and wait for the end."""
        depth, duration_s = self.settings.depth, self.settings.duration
        limit_s = duration_s + shot.call_timeout_s
        with shot.lines_on("ramp", duration_s):
            shot.call("static_tweezers", limit_s, shot.static_tweezers.ramp, depth, duration_s)
        shot.record_duration(duration_s, duration_s)
        shot.log("ramped", device="static_tweezers", depth=depth, duration_s=duration_s)


class ReleaseSettings(Settings):
    """``release``: turn the static tweezers off for a short time, and recapture the atoms."""

    duration: PositiveDuration = Field(description="how long the atoms are free")


class ReleaseStep(Step):
    """Turns the static tweezers off for a hardware-timed duration, then on again at the same depth.

    A line of the timing box turns them off, or their driver. If neither can, the step is refused.
    """

    notes = ()

    def __init__(self, settings: ReleaseSettings) -> None:
        self.settings = settings

    def check_devices(
        self, devices: Mapping[str, object], context: StepContext
    ) -> Mapping[str, str | Problem]:
        """Check that the profile can release the atoms, and fast enough."""
        del devices
        by = context.release_by
        if by is None:
            fault = "no device of this profile can turn the static tweezers off with hardware timing"
            hint = "wire their switch to the timing box, as a line with `on: [release]` and"
            hint += " `turns_off: static_tweezers` (see docs/how-to/release.md)"
            return {
                "": Problem(fault, expected="a timing box, or tweezers whose driver can release", hint=hint)
            }
        shortest = {
            "lines": context.lines_facts.shortest_s,
            "static_tweezers": context.static_tweezers.shortest_release_s,
        }
        if self.settings.duration < shortest[by.name]:
            duration, shortest_text = (
                format_quantity(t, "time") for t in (self.settings.duration, shortest[by.name])
            )
            return {
                "duration": Problem(
                    f"'{by.name}' cannot release for {duration}", expected=f"at least {shortest_text}"
                )
            }
        return {}

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One entry."""
        text = f"release for {format_quantity(self.settings.duration, 'time')}"
        duration_s, by = self.settings.duration + context.margin_s("release"), context.release_by
        return [TimelineEntry(text, duration_s, duration_s, kind="release", timed_by=by or COMPUTER)]

    def run(self, shot: Shot) -> None:
        """Release the atoms, and wait until they are recaptured."""
        released_s = shot.release(self.settings.duration)
        shot.record_duration(self.settings.duration, released_s)
        shot.log("released", duration_s=released_s)


class DeviceSettings(Settings):
    """``device``: have a named device of the profile carry out a command."""

    name: Text = Field(description="name of the device in the profile")
    do: Text = Field(description="command of the device")
    arguments: Annotated[dict[str, str | int | float | bool | None], empty_is({})] = Field(
        default={}, description="arguments of the command"
    )
    timeout: PositiveDuration = Field(default=10.0, description="how long the command may take")


class DeviceStep(Step):
    """Sends a command to a named device of the profile."""

    repeatable = True
    takes_time = False
    device_setting = "name"
    notes = ()

    def __init__(self, settings: DeviceSettings) -> None:
        self.settings = settings

    def check_devices(
        self,
        devices: Mapping[str, object],
        context: StepContext,  # noqa: ARG002 - of the role
    ) -> Mapping[str, str | Problem]:
        """Have the device check the command."""
        device = devices.get(self.settings.name)
        if isinstance(device, Device):  # None in a dry run of a profile without it
            try:
                device.check_command(self.settings.do, **self.settings.arguments)
            except LabseqError as error:
                return {"do": str(error)}
            except Exception as error:  # noqa: BLE001 - of the driver, for example an unknown argument
                fault = f"check_command() raised {format_plugin_error(error)}"
                return {"do": f"{self.settings.name}: {fault}"}
        return {}

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002 - of the role
        """One entry without a known length."""
        return [TimelineEntry(f"{self.settings.name}: {self.settings.do}", 0.0, 0.0)]

    def run(self, shot: Shot) -> None:
        """Send the command and wait until the driver returns."""
        name, do, arguments = self.settings.name, self.settings.do, dict(self.settings.arguments)
        shot.call(name, self.settings.timeout, shot.device(name).command, do, **arguments)
        shot.log("device_command", device=name, command=do, arguments=arguments)


class WaitSettings(Settings):
    """``wait``: let time pass, or wait for the start signal of another control system."""

    duration: Duration | None = Field(default=None, description="how long to wait")
    signal: Literal["go"] | None = Field(
        default=None, alias="for", description="signal to wait for, instead of `duration`"
    )
    timeout: PositiveDuration | None = Field(
        default=None, description="longest wait for the signal, after which the run ends"
    )
    device: Text | None = Field(
        default=None,
        description="device of the profile that receives the signal, needed if several could",
    )

    @model_validator(mode="after")
    def _waits_for_one_thing(self) -> Self:
        if self.signal is None:
            if extra := next((key for key in ("timeout", "device") if key in self.model_fields_set), None):
                raise setting_error(f"'{extra}' needs 'for'", "'for: go' next to it", at=(extra,), key=True)
            if self.duration is None:
                raise setting_error("a wait needs a time or a signal", "'duration', or 'for' and 'timeout'")
        elif self.duration is not None:
            raise setting_error("'duration' is given with 'for'", "one of them", at=("duration",), key=True)
        elif self.timeout is None:
            raise setting_error("a wait for 'go' has no 'timeout'", "the longest wait", at=("for",), key=True)
        return self


class WaitStep(Step):
    """Lets time pass."""

    repeatable = True
    notes = ()

    def __init__(self, settings: WaitSettings) -> None:
        self.duration_s = settings.duration or 0.0

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One entry."""
        text = f"wait {format_quantity(self.duration_s, 'time')}"
        duration_s, timed_by = self.duration_s + context.margin_s("wait"), context.timed_by("wait")
        return [TimelineEntry(text, duration_s, duration_s, kind="wait", timed_by=timed_by)]

    def run(self, shot: Shot) -> None:
        """Wait on the session's clock."""
        with shot.lines_on("wait", self.duration_s):
            shot.clock.sleep(self.duration_s)
        if shot.step_context.timed_by("wait").name == "lines":
            shot.record_duration(self.duration_s, self.duration_s)


def wait_step(settings: WaitSettings) -> Step:
    """Waits for a time, or for the signal of another control system."""
    if settings.signal is None or settings.timeout is None:
        return WaitStep(settings)
    from labseq.builtin.follow import FollowStep  # most runs follow no other system

    return FollowStep(settings.signal, settings.timeout, settings.device or "")
