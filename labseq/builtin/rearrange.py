"""The step ``rearrange``: plan, check, move and image, in cycles."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable, Collection, Sequence
from functools import partial
from itertools import combinations
from numbers import Real
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from labseq.model.records import OVERSHOOT_S
from labseq.plugin import (
    COMPUTER,
    CycleRecord,
    DeviceError,
    Duration,
    Plan,
    PlanError,
    PositiveDuration,
    Settings,
    Shot,
    Step,
    StepContext,
    TimedBy,
    TimelineEntry,
    ToneProgram,
    setting_error,
)
from labseq.plugin.motion import tone_program
from labseq.plugin.planning import PlanReport, check_plan, fitting_batches


class RearrangeSettings(Settings):
    """``rearrange``: plan, check, move and image, in cycles."""

    cycles: int = Field(default=1, ge=1, le=100, description="maximum number of cycles of plan, move, image")
    window: Duration | tuple[Duration, ...] = Field(
        default=60e-3,
        description="longest time from the image to the end of a cycle's moves, for planning, upload, start "
        "and moves. A list has one time per cycle",
    )
    exposure: PositiveDuration = Field(
        default=45e-3, description="exposure time of the image that ends a cycle"
    )
    stop_when: Literal["defect_free", "never"] = Field(
        default="defect_free", description="whether to leave out further cycles once the target is met"
    )
    window_mode: Literal["early", "fixed"] = Field(
        default="early",
        description="whether the image is taken after the last batch, or at the end of the window",
    )

    @model_validator(mode="after")
    def _one_window_per_cycle(self) -> Self:
        if isinstance(self.window, tuple) and len(self.window) != self.cycles:
            entries = "1 entry" if len(self.window) == 1 else f"{len(self.window)} entries"
            default = "" if "cycles" in self.model_fields_set else ", its default"
            fault = f"the list has {entries}, but cycles is {self.cycles}{default}"
            raise setting_error(fault, f"{self.cycles}, one per cycle", at=("window",))
        return self

    def window_of(self, cycle: int) -> float:
        """The window of a cycle, in seconds.

        Args:
            cycle: Index of the cycle, from 0.
        """
        return self.window[cycle] if isinstance(self.window, tuple) else self.window


class RearrangeStep(Step):
    """Rearranges atoms in cycles of plan, check, move and image.

    A batch that would end after the cycle's window is not started. Batches are chosen with the preparation
    times of earlier programs, and again if the device takes longer than that. With ``window_mode: early`` the
    image follows the last batch, and with ``fixed`` the step waits for the end of the window.
    """

    needs_target = True
    needs_image = True
    takes_image = True
    notes = ()

    def __init__(self, settings: RearrangeSettings) -> None:
        self.settings = settings
        self.windows_s = tuple(settings.window_of(cycle) for cycle in range(settings.cycles))
        self.judges_shot = settings.stop_when == "never"
        self._measured = deque[tuple[float, float]](maxlen=7)  # times to play and to prepare a program
        self._preparing = 0.0, 0.0

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """Two entries per cycle, with the window as duration of the moves."""
        exposure_s = self.settings.exposure
        image_s = exposure_s + context.camera.readout_s + context.margin_s("image")
        all_made = self.settings.stop_when == "never"
        waited_out = all_made and self.settings.window_mode == "fixed"
        by = COMPUTER if self.settings.window_mode == "fixed" else TimedBy("mobile_tweezers")
        entries: list[TimelineEntry] = []
        for cycle in range(self.settings.cycles):
            window_s = self.settings.window_of(cycle)
            min_duration_s, min_image_s = window_s if waited_out else 0.0, image_s if all_made else 0.0
            moves, image = f"cycle {cycle}: move", f"cycle {cycle}: image"
            entries += [
                TimelineEntry(moves, window_s, min_duration_s, kind="rearrange", timed_by=by),
                TimelineEntry(image, image_s, min_image_s, 1, exposure_s, "image", TimedBy("camera")),
            ]
        return entries

    def run(self, shot: Shot) -> None:
        """Run cycles until the target is met (``stop_when: defect_free``) or all are done."""
        for cycle in range(self.settings.cycles):
            if shot.occupancy is None:
                raise PlanError("rearrange needs an image before it in the shot")
            if self.settings.stop_when == "defect_free" and shot.target.is_met_by(shot.occupancy):
                return
            self._move(shot, cycle)
            shot.take_image(self.settings.exposure, cycle)

    def _move(self, shot: Shot, cycle: int) -> None:
        window_s = self.settings.window_of(cycle)
        start_s = shot.clock.now()
        with shot.stage("move", window_s, cycle):
            plan, report = checked_plan(shot, cycle)
            n_played = self._play(shot, plan, report, cycle, start_s)
            late_s = shot.clock.now() - start_s - window_s
            if self.settings.window_mode == "fixed" and late_s < 0:
                shot.clock.sleep(-late_s)
        late_s = late_s if n_played and late_s > OVERSHOOT_S else 0.0
        if late_s:
            shot.log("window_exceeded", cycle=cycle, window_s=window_s, late_s=late_s)
        moves_s = float(report.batch_end_s[n_played - 1]) if n_played else 0.0
        begun_s = start_s - shot.start_s
        shot.record_cycle(
            CycleRecord(shot.step, cycle, plan, report, n_played, window_s, begun_s, moves_s, late_s)
        )

    def _play(self, shot: Shot, plan: Plan, report: PlanReport, cycle: int, start_s: float) -> int:
        """Play the batches that end within the window, and return their number.

        If their preparation took too long for the window, fewer are prepared. If the mobile tweezers allow
        it, they start with the first batches, and the rest is made while these play.
        """
        end_s = start_s + self.settings.window_of(cycle) - shot.margin_s("rearrange")
        duration_s, n_first, n_batches = 0.0, 0, self._n_fitting(shot, plan, report, start_s, end_s)
        while n_batches:
            n_first = n_beginning(shot, plan, report, n_batches)
            build = partial(tone_program, plan.first(n_first), grid=shot.grid, motion=shot.motion)
            duration_s, took_s = prepare(shot, build, start_s, cycle, is_whole=n_first == n_batches)
            duration_s += float(report.batch_end_s[n_batches - 1] - report.batch_end_s[n_first - 1])
            if duration_s > 0:
                self._measured.append((duration_s, took_s))
            if shot.clock.now() + duration_s <= end_s + OVERSHOOT_S:
                break
            moves_s = float(report.batch_end_s[n_batches - 1]) - shot.motion.overhead_per_cycle_s
            self._preparing = preparing_time(self._measured)
            n_batches = self._n_fitting(shot, plan, report, start_s, end_s - (duration_s - moves_s))
        if n_batches < plan.n_batches:
            values = {"n_batches": plan.n_batches, "n_batches_played": n_batches}
            shot.log("window_too_short", cycle=cycle, **values, before_moves_s=shot.clock.now() - start_s)
        if n_batches:
            play_prepared(shot, duration_s, cycle, rest_of(shot, plan, n_first, n_batches))
        self._preparing = preparing_time(self._measured)  # now, so that the next frame need not wait for it
        return n_batches

    def _n_fitting(self, shot: Shot, plan: Plan, report: PlanReport, start_s: float, end_s: float) -> int:
        """Number of batches that end in time, if preparation takes as long as before or as in the profile."""
        fixed_s, part = self._preparing
        left_s = max(0.0, end_s - shot.clock.now() - fixed_s)
        window_s = shot.motion.overhead_per_cycle_s + left_s / (1 + part)
        if shot.clock.virtual or not self._measured:
            window_s = min(window_s, end_s - start_s)
        return fitting_batches(report, plan, window_s)


def n_beginning(shot: Shot, plan: Plan, report: PlanReport, n_batches: int) -> int:
    """Number of batches to start with, which is all if the mobile tweezers only take whole programs."""
    played_s = report.batch_end_s[:n_batches] - shot.motion.overhead_per_cycle_s
    n_first = int(np.searchsorted(played_s, shot.mobile_tweezers.beginning_s)) + 1
    while n_first < n_batches and plan.linked[n_first]:
        n_first += 1
    return min(n_first, n_batches)


def rest_of(shot: Shot, plan: Plan, start: int, stop: int) -> Callable[[], ToneProgram] | None:
    """Makes the tone program of the batches after the first ones. None if there are none."""
    if start == stop:
        return None
    return partial(tone_program, plan.part(start, stop), grid=shot.grid, motion=shot.motion)


def preparing_time(measured: Collection[tuple[float, float]]) -> tuple[float, float]:
    """Fit the preparation time as a fixed time plus a fraction of the program's playing time.

    The fit is a straight line from the medians of slopes and intercepts (Theil and Sen), so that a program
    with a busy computer does not matter. Programs of about equal length only give a fraction.

    Args:
        measured: Playing time and preparation time of earlier programs, in seconds.

    Returns:
        The fixed time in seconds, and the fraction.

    Example:
        >>> fixed_s, part = preparing_time([(0.01, 0.007), (0.02, 0.012), (0.04, 0.022)])
        >>> round(fixed_s, 6), round(part, 6)
        (0.002, 0.5)
    """
    if not measured:
        return 0.0, 0.0
    pairs = [(a, b) for a, b in combinations(measured, 2) if abs(a[0] - b[0]) > 0.1 * max(a[0], b[0])]
    if not pairs:
        return 0.0, statistics.median(took_s / duration_s for duration_s, took_s in measured)
    part = max(0.0, statistics.median((b[1] - a[1]) / (b[0] - a[0]) for a, b in pairs))
    return max(0.0, statistics.median(took_s - part * duration_s for duration_s, took_s in measured)), part


def checked_plan(shot: Shot, cycle: int) -> tuple[Plan, PlanReport]:
    """Plan for the last image of a shot, and check the plan.

    Raises:
        PlanError: The planner fails, or its plan breaks a rule.
    """
    occupancy = shot.occupancy
    assert occupancy is not None
    with shot.stage("plan", cycle=cycle):
        copy = occupancy.copy()  # in case the planner writes into its input
        try:
            plan = shot.call("planner", shot.plan_timeout_s, shot.planner.plan, copy, shot.target)
        except PlanError as error:
            raise error if error.planner else PlanError(str(error), shot.planner_name) from error
    if not isinstance(plan, Plan):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise PlanError(f"plan() returned {type(plan).__name__}; expected a Plan", shot.planner_name)
    limit = shot.degree_of_parallelism
    with shot.stage("check", cycle=cycle):
        report = check_plan(
            plan,
            occupancy,
            shot.target,
            limit,
            grid=shot.grid,
            motion=shot.motion,
            planner=shot.planner_name,
        )
    return plan, report


def play(shot: Shot, build: Callable[[], ToneProgram], start_s: float, cycle: int = -1) -> None:
    """Prepare a tone program, play it and wait for its end (see :func:`prepare`)."""
    play_prepared(shot, prepare(shot, build, start_s, cycle)[0], cycle)


def prepare(
    shot: Shot, build: Callable[[], ToneProgram], start_s: float, cycle: int, *, is_whole: bool = True
) -> tuple[float, float]:
    """Build a tone program and upload it.

    On a virtual clock it ends at least the modelled overhead of a cycle after ``start_s``.

    Args:
        shot: The running shot.
        build: Makes the program.
        start_s: Start of the cycle and its overhead on the session's clock.
        cycle: Index of the rearrangement cycle. -1 outside of a cycle.
        is_whole: Whether it is a whole program, not only its beginning.

    Returns:
        Its playing time, and the time for making and uploading it, in seconds.

    Raises:
        LimitError: The program breaks a limit.
        DeviceError: The mobile tweezers fail.
    """
    overhead_s = shot.motion.overhead_per_cycle_s
    mobile, limit_s = shot.mobile_tweezers, shot.call_timeout_s
    with shot.stage("prepare", overhead_s, cycle):
        began_s = shot.clock.now()
        with shot.stage("tones", cycle=cycle):
            program = build()
        upload = mobile.prepare if is_whole else mobile.prepare_beginning
        duration_s = _playing_time_s(shot.call("mobile_tweezers", limit_s, upload, program))
        took_s = shot.clock.now() - began_s
        for part, host_s in shot.call("mobile_tweezers", limit_s, mobile.timings).items():
            shot.stage_done(part, 0.0 if shot.clock.virtual else host_s, host_s, cycle=cycle)
        if shot.clock.virtual:
            shot.clock.sleep(max(0.0, overhead_s - (shot.clock.now() - start_s)))
    return duration_s, took_s


def play_prepared(
    shot: Shot, duration_s: float, cycle: int = -1, rest: Callable[[], ToneProgram] | None = None
) -> None:
    """Play the prepared program and wait for its end.

    Args:
        shot: The running shot.
        duration_s: Playing time, including the rest.
        cycle: Index of the rearrangement cycle. -1 outside of a cycle.
        rest: Makes the rest of a program if only its beginning was prepared.

    Raises:
        LimitError: The rest breaks a limit.
        DeviceError: The mobile tweezers fail, or a watched value is past its limit.
    """
    mobile, limit_s = shot.mobile_tweezers, shot.call_timeout_s
    shot.check_interlocks()
    budget_s = duration_s + shot.margin_s("rearrange")

    def start() -> None:
        with shot.stage("start", cycle=cycle):
            shot.call("mobile_tweezers", limit_s, mobile.play)

    with shot.stage("play", budget_s, cycle), shot.lines_on("rearrange", duration_s, start):
        if rest is not None:
            with shot.stage("rest", cycle=cycle):
                shot.call("mobile_tweezers", limit_s, mobile.append, rest())
        shot.call("mobile_tweezers", duration_s + 2 * limit_s, mobile.wait, duration_s + limit_s)


def _playing_time_s(answer: object) -> float:
    """The validated playing time from ``prepare``, which sets all waiting times for the device."""
    if not (isinstance(answer, Real) and 0 <= float(answer) < math.inf):
        text = f"prepare() returned {answer!r}; expected the playing time in seconds, 0 or more"
        raise DeviceError("mobile_tweezers", text)
    return float(answer)
