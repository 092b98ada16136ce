"""The built-in steps: load, image, rearrange, ramp, wait, device."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import Annotated, Any, Literal, Protocol, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.errors import DeviceError, PlanError
from labseq.model import CycleRecord, Plan, PlanReport, TimelineEntry, ToneProgram
from labseq.motion import check_plan, fitting_batches, tone_program
from labseq.roles import Shot, StepContext, offers
from labseq.sequencer.lines import margin_s
from labseq.settings import Duration, Fraction, Length, Settings, Text, empty_is, setting_error
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


class FollowStep:
    """Waits until another control system says to go on."""

    needs_image = False
    takes_image = False

    def __init__(self, signal: str, timeout_s: float, device: str = "") -> None:
        self.signal = signal
        self.timeout_s = timeout_s
        self.device = device

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002 - Protocol
        """One bar, at most the timeout; lines are idle, because nobody knows how long it takes."""
        return [TimelineEntry(f"wait for {self.signal}", self.timeout_s, 0.0)]

    def run(self, shot: Shot) -> None:
        """Wait for the signal."""
        shot.follow(self.signal, self.timeout_s, self.device)


def wait_step(settings: WaitSettings) -> WaitStep | FollowStep:
    """The step ``wait``: for a time, or for a signal."""
    if settings.signal is None or settings.timeout is None:
        return WaitStep(settings)
    return FollowStep(settings.signal, settings.timeout, settings.device or "")


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


def play(shot: Shot, build: Callable[[], ToneProgram], start_s: float, cycle: int = 0) -> None:
    """Build a tone program, play it and wait for its end.

    What real hardware spends on the overhead of a cycle, the model spends too.

    Args:
        shot: The running shot.
        build: Makes the program.
        start_s: Start of the cycle on the session's clock; its overhead counts from there.
        cycle: Rearrangement cycle, counted from 1; 0 outside of one.

    Raises:
        LimitError: The program breaks a limit.
        DeviceError: The mobile tweezers fail, or a watched value is past its limit.
    """
    overhead_s = shot.motion.overhead_per_cycle_s
    mobile, limit_s = shot.mobile_tweezers, shot.call_timeout_s
    with shot.stage("prepare", overhead_s, cycle):
        with shot.stage("tones", cycle=cycle):
            program = build()
        duration_s = _duration(shot.call("mobile_tweezers", limit_s, mobile.prepare, program))
        if offers(mobile, "timings"):
            for part, host_s in shot.call("mobile_tweezers", limit_s, mobile.timings).items():
                shot.stage_done(part, 0.0 if shot.clock.virtual else host_s, host_s, cycle=cycle)
        if shot.clock.virtual:
            shot.clock.sleep(max(0.0, overhead_s - (shot.clock.now() - start_s)))
    shot.check_interlocks()
    budget_s = duration_s + shot.margin_s("rearrange")
    with shot.stage("play", budget_s, cycle), shot.lines_on("rearrange", duration_s):
        shot.call("mobile_tweezers", limit_s, mobile.play)
        shot.call("mobile_tweezers", duration_s + 2 * limit_s, mobile.wait, duration_s + limit_s)


def _duration(answer: object) -> float:
    """The playing time that ``prepare`` returned; every wait for the device is reckoned from it."""
    if not (isinstance(answer, Real) and 0 <= float(answer) < math.inf):
        text = f"prepare() returned {answer!r}; expected the playing time in seconds, 0 or more"
        raise DeviceError("mobile_tweezers", text)
    return float(answer)


class _rearrange_Settings(Protocol):
    @property
    def cycles(self) -> int: ...
    @property
    def exposure(self) -> float: ...
    @property
    def stop_when(self) -> str: ...
    @property
    def window_mode(self) -> str: ...
    def window_of(self, cycle: int) -> float: ...


class RearrangeStep:
    """Rearranges in cycles; cycle k is plan, check, move, image.

    A batch that would end after the cycle's window is not started. With
    ``window_mode: early`` the image follows the last batch; with ``fixed`` the
    rest of the window is waited out.
    """

    needs_image = True
    takes_image = True

    def __init__(self, settings: _rearrange_Settings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """Two bars per cycle, the moves at their window."""
        exposure_s = self.settings.exposure
        image_s = exposure_s + context.camera.readout_s + margin_s(context.lines, "image")
        all_made = self.settings.stop_when == "never"
        waited_out = all_made and self.settings.window_mode == "fixed"
        bars: list[TimelineEntry] = []
        for cycle in range(1, self.settings.cycles + 1):
            window_s = self.settings.window_of(cycle)
            min_duration_s, min_image_s = window_s if waited_out else 0.0, image_s if all_made else 0.0
            moves = TimelineEntry(f"cycle {cycle}: move", window_s, min_duration_s, kind="rearrange")
            image = TimelineEntry(f"cycle {cycle}: image", image_s, min_image_s, 1, exposure_s, "image")
            bars += [moves, image]
        return bars

    def run(self, shot: Shot) -> None:
        """Run cycles until the target is met (``stop_when: defect_free``) or all are done."""
        for cycle in range(1, self.settings.cycles + 1):
            occupancy = shot.occupancy
            if occupancy is None:
                raise PlanError("rearrange needs an image before it in the shot")
            if self.settings.stop_when == "defect_free" and shot.target.is_met_by(occupancy):
                return
            self._move(shot, cycle)
            shot.take_image(self.settings.exposure, cycle)

    def _move(self, shot: Shot, cycle: int) -> None:
        window_s = self.settings.window_of(cycle)
        start_s = shot.clock.now()
        with shot.stage("move", window_s, cycle):
            plan, report = self._plan(shot, cycle)
            n_played = self._play(shot, plan, report, cycle, start_s, window_s)
            left_s = window_s - (shot.clock.now() - start_s)
            if self.settings.window_mode == "fixed" and left_s > 0:
                shot.clock.sleep(left_s)
        moves_s = float(report.batch_end_s[n_played - 1]) if n_played else 0.0
        shot.record_cycle(
            CycleRecord(shot.step, cycle, plan, report, n_played, window_s, start_s - shot.start_s, moves_s)
        )

    def _plan(self, shot: Shot, cycle: int) -> tuple[Plan, PlanReport]:
        occupancy = shot.occupancy
        assert occupancy is not None
        with shot.stage("plan", cycle=cycle):
            seen = occupancy.copy()  # a planner that writes into its input harms only itself
            try:
                plan = shot.call("planner", shot.plan_timeout_s, shot.planner.plan, seen, shot.target)
            except PlanError as error:
                raise error if error.planner else PlanError(str(error), shot.planner_name) from error
        if not isinstance(plan, Plan):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise PlanError(f"plan() returned {type(plan).__name__}; expected a Plan", shot.planner_name)
        with shot.stage("check", cycle=cycle):
            report = check_plan(
                plan,
                occupancy,
                shot.target,
                shot.degree_of_parallelism,
                grid=shot.grid,
                motion=shot.motion,
                planner=shot.planner_name,
            )
        return plan, report

    def _play(
        self, shot: Shot, plan: Plan, report: PlanReport, cycle: int, start_s: float, window_s: float
    ) -> int:
        """Play what fits into the window.

        The modelled overhead of the cycle (planning, rendering, upload) counts in
        full; only what really took longer is taken off the window beyond it.
        """
        if plan.n_batches == 0:
            return 0
        overhead_s = shot.motion.overhead_per_cycle_s
        late_s = max(0.0, shot.clock.now() - start_s - overhead_s) + shot.margin_s("rearrange")
        n_played = fitting_batches(report, plan, window_s - late_s)
        if n_played < plan.n_batches:
            shot.log("window_too_short", cycle=cycle, n_batches=plan.n_batches, n_batches_played=n_played)
        if n_played == 0:
            return 0
        play(
            shot,
            lambda: tone_program(plan, grid=shot.grid, motion=shot.motion, n_batches=n_played),
            start_s,
            cycle,
        )
        return n_played


Exposure: TypeAlias = Annotated[Duration, Field(gt=0)]
"""Seconds, more than 0; "45 ms"."""


PositiveLength: TypeAlias = Annotated[Length, Field(gt=0)]
"""Metres, more than 0; "0.9 um"."""


class LoadSettings(Settings):
    """``load``: fill the static tweezers with atoms."""

    duration: Duration = Field(default=0.5, description="how long atoms load")


class ImageSettings(Settings):
    """``image``: take a picture and find the atoms on it."""

    exposure: Exposure = Field(default=45e-3, description="exposure time of the camera")


class RearrangeSettings(Settings):
    """``rearrange``: plan, check, move and image, again and again."""

    cycles: int = Field(default=1, ge=1, le=100, description="most cycles of plan, move and image")
    window: Duration | tuple[Duration, ...] = Field(
        default=60e-3,
        description="most time for the moves of one cycle, overheads included; a list gives one per cycle",
    )
    exposure: Exposure = Field(default=45e-3, description="exposure time of the image that ends a cycle")
    stop_when: Literal["defect_free", "never"] = Field(
        default="defect_free", description="whether to leave out further cycles once the target is met"
    )
    window_mode: Literal["early", "fixed"] = Field(
        default="early", description="whether the image follows the last batch, or the end of the window"
    )

    @model_validator(mode="after")
    def _one_window_per_cycle(self) -> Self:
        if isinstance(self.window, tuple) and len(self.window) != self.cycles:
            entries = "1 entry" if len(self.window) == 1 else f"{len(self.window)} entries"
            default = "" if "cycles" in self.model_fields_set else ", its default"
            what = f"the list has {entries}, but cycles is {self.cycles}{default}"
            raise setting_error(what, f"{self.cycles}, one per cycle", at=("window",))
        return self

    def window_of(self, cycle: int) -> float:
        """The window of a cycle, in seconds.

        Args:
            cycle: Counted from 1.
        """
        return self.window[cycle - 1] if isinstance(self.window, tuple) else self.window


class ProbeSettings(Settings):
    """``probe``: pick atoms up, hold them and set them down, beside their sites."""

    offset: tuple[Length, Length] = Field(
        default=(0.0, 0.0),
        description="[along a row, from row to row]: how far beside their sites the tweezers shall stand",
    )
    hold: Duration = Field(default=0.2e-3, description="time between pick-up and drop-off")
    drop_off: Duration = Field(
        default=5e-6, description="duration of the drop-off; a slow one leads atoms back to their sites"
    )
    pattern: Literal["same", "cross"] = Field(
        default="same",
        description="the offset of each site: the same for all, or in four groups of sites forwards and "
        "backwards along a row, forwards and backwards from row to row",
    )
    sites: Literal["seen", "all"] = Field(
        default="seen", description="which sites are probed: where the last image saw an atom, or all"
    )


class CheckSitesSettings(Settings):
    """``check_sites``: see on the last image whether the sites have moved on the camera."""

    every: int = Field(default=1, ge=1, description="check every so many shots, from the first")
    limit_px: float = Field(default=0.5, gt=0, description="largest shift that is let pass, in pixels")
    spot_px: float = Field(
        default=1.2, gt=0, description="width (1 sigma of a Gaussian) of an atom's image, in pixels"
    )
    exceeded: Literal["warn", "stop"] = Field(
        default="warn", description="whether a larger shift is a warning or stops the run"
    )


class CheckOverlaySettings(Settings):
    """``check_overlay``: see by a probe whether the mobile tweezers still stand on the sites."""

    every: int = Field(default=20, ge=1, description="check every so many shots, from the first")
    offset: PositiveLength = Field(
        default=0.9e-6, description="offset of the probe in each of four directions: on the bump's edge"
    )
    hold: Duration = Field(default=0.2e-3, description="time between pick-up and drop-off")
    drop_off: Duration = Field(
        default=5e-6, description="duration of the drop-off; a slow one leads atoms back to their sites"
    )
    exposure: Exposure = Field(default=45e-3, description="exposure time of the image after it")
    limit: PositiveLength = Field(default=100e-9, description="largest offset that is let pass, on each axis")
    exceeded: Literal["warn", "stop"] = Field(
        default="warn", description="whether a larger offset is a warning or stops the run"
    )
    half_width: PositiveLength = Field(
        default=0.93e-6,
        description="distance at which half of the probed atoms survive, where no calibration tells it",
    )
    edge: PositiveLength = Field(
        default=0.23e-6, description="width (1 sigma) of the bump's edge, where no calibration tells it"
    )


class EqualiseSettings(Settings):
    """``equalise``: make the static tweezers even, in a closed loop."""

    device: Text = Field(
        default="trap_camera", description="device of the profile that measures the power of each tweezer"
    )
    value: Text = Field(
        default="spot_powers", description="its value with the powers, an array of rows and columns"
    )
    spread: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.005, description="rms of the part that rows and columns can even out, that is aimed at"
    )
    gain: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.8, description="how much of it a round takes out"
    )
    max_sum: Annotated[float, Field(gt=0)] = Field(
        default=1.0, description="most that the amplitudes of an axis may add up to, of full scale"
    )
    max_averages: int = Field(default=100, ge=2, description="most measurements that a round averages")
    max_rounds: int = Field(default=25, ge=1, description="most rounds")


class RampSettings(Settings):
    """``ramp``: make the static tweezers shallower or deeper, without a jump."""

    device: Literal["static_tweezers"] = Field(
        default="static_tweezers", description="what is ramped: so far the static tweezers alone"
    )
    depth: Fraction = Field(description="depth at the end, as a fraction of the nominal one")
    duration: Exposure = Field(default=5e-3, description="how long the ramp takes; it is linear")


class WaitSettings(Settings):
    """``wait``: let time pass, or wait until another control system says to go on."""

    duration: Duration | None = Field(default=None, description="how long to wait")
    signal: Literal["go"] | None = Field(
        default=None, alias="for", description="what to wait for, in the place of `duration`"
    )
    timeout: Exposure | None = Field(
        default=None, description="how long that may take; if it does not come, the run ends"
    )
    device: Text | None = Field(
        default=None,
        description="device of the profile that it comes through; needed if several could be meant",
    )

    @model_validator(mode="after")
    def _is_for_one_thing(self) -> Self:
        if self.signal is None:
            if extra := next((key for key in ("timeout", "device") if key in self.model_fields_set), None):
                raise setting_error(
                    f"'{extra}' stands here without 'for'", "'for: go' beside it", at=(extra,), key=True
                )
            if self.duration is None:
                raise setting_error(
                    "a wait says neither how long nor for what", "'duration', or 'for' and 'timeout'"
                )
        elif self.duration is not None:
            raise setting_error(
                "'duration' and 'for' stand together", "one of them", at=("duration",), key=True
            )
        elif self.timeout is None:
            raise setting_error(
                "a wait for 'go' has no 'timeout'", "how long it may take", at=("for",), key=True
            )
        return self


class DeviceSettings(Settings):
    """``device``: have a named device of the profile carry out a command."""

    name: Text = Field(description="name of the device in the profile")
    do: Text = Field(description="command of the device")
    arguments: Annotated[dict[str, str | int | float | bool | None], empty_is({})] = Field(
        default={}, description="arguments of the command"
    )
    timeout: Exposure = Field(default=10.0, description="how long the command may take")
