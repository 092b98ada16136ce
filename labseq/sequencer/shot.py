"""One attempt at a shot, with the interface for steps, the time of each stage, and its record."""

from __future__ import annotations

import gc
import itertools
import math
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar, cast

import numpy as np

from labseq.errors import (
    ConfigError,
    DeviceError,
    InterlockError,
    OverBudgetError,
    StepTimeoutError,
    TransientError,
)
from labseq.guard import DRIVER_MARGIN_S, Guard
from labseq.model import (
    CycleRecord,
    Frame,
    ImageRecord,
    LineProgram,
    Occupancy,
    ShotRecord,
    StageTiming,
    StepTiming,
    TimelineEntry,
)
from labseq.model.lines import NO_PULSES, Pulses
from labseq.model.policies import NO_POLICY, StepPolicy
from labseq.model.records import OVERSHOOT_S, STEP, LineEdge
from labseq.realtime import raise_priority, restore_priority
from labseq.roles import Device, Hardware, ReportsSignals, RunObserver, Step, StepContext, overrides
from labseq.sequencer.images import CameraSeries, as_frame, take_frame
from labseq.sequencer.lab import Emit, Lab, check_blinding
from labseq.sequencer.lines import line_program, margin_s, trigger_line
from labseq.units import format_quantity

if TYPE_CHECKING:
    from labseq.sequencer.leader import LeaderAnswers


class Events:
    """Reports the events of shots, without delaying this thread after a frame.

    From a frame to the start of the moves that follow from it, events are kept and Python collects no
    garbage, because a slow disk or screen, or garbage collection, would take longer than everything else.

    Args:
        guard: Knows which shot was abandoned, so that its events are dropped.
    """

    def __init__(self, observer: RunObserver, guard: Guard) -> None:
        self._observer = observer
        self._guard = guard
        self._kept: list[tuple[str, Mapping[str, Any]]] = []
        self._is_held = self._is_raised = False
        self._collects = gc.isenabled()

    def __call__(self, name: str, values: Mapping[str, Any]) -> None:
        """Report an event, or keep it."""
        if self._is_held and not self._guard.is_abandoned:
            self._kept.append((name, values))
        elif not self._guard.is_abandoned:
            self._observer.event(name, values)

    def expect_frame(self) -> None:
        """Give this thread priority until the events are released, because it waits for a frame."""
        self._is_raised = raise_priority()

    def hold(self) -> None:
        """Keep the events from now on."""
        if not self._is_held and not self._guard.is_abandoned:
            self._is_held, self._collects = True, gc.isenabled()
            gc.disable()

    def release(self) -> None:
        """Report the kept events now, and later events at once."""
        if self._is_raised:
            self._is_raised = False
            restore_priority()
        if not self._is_held or self._guard.is_abandoned:
            return
        if self._collects:
            gc.enable()
        kept, self._kept, self._is_held = self._kept, [], False
        for name, values in kept:
            self._observer.event(name, values)


class Stages:
    """Times the stages of one attempt at a shot, and enforces the policies of its steps.

    Args:
        lab: The clock, and budgets of stages that do not have their own.

    Attributes:
        start_s: Start of the shot, on the session's clock.
        step: Index of the running step.
        policy: Its policy.
    """

    def __init__(self, lab: Lab, record: ShotRecord, emit: Emit) -> None:
        self.start_s = lab.clock.now()
        self.step = 0
        self.policy = NO_POLICY
        self._clock = lab.clock
        self._budgets = lab.budgets
        self._record = record
        self._emit = emit
        self._name = ""
        self._is_warned = False
        self._attempt_start_s = self.start_s

    def begin_step(self, number: int, name: str, policy: StepPolicy) -> None:
        """Begin a step, to which the following stages belong."""
        self.step, self._name, self.policy, self._is_warned = number, name, policy, False

    def begin_attempt(self) -> None:
        """Start an attempt at the step. Its timeout counts from here."""
        self._attempt_start_s = self._clock.now()

    def check_timeout(self) -> None:
        """Check the timeout of the step.

        Raises:
            StepTimeoutError: The timeout has passed.
        """
        limit_s = self.policy.limit_s
        if self._clock.now() - self._attempt_start_s > limit_s + OVERSHOOT_S:
            text = f"step {self.step} ({self._name}) has not finished within its timeout of "
            raise StepTimeoutError(text + format_quantity(limit_s, "time"), limit_s)

    @contextmanager
    def around(self, name: str, budget_s: float, cycle: int) -> Generator[None]:
        """Time a stage against its budget. It is recorded even if it fails.

        Raises:
            OverBudgetError: It took longer, and the policy of the step does not allow that.
        """
        start_s, host_start_s = self._clock.now(), time.perf_counter()
        try:
            yield
        finally:
            host_s = time.perf_counter() - host_start_s
            duration_s = self._clock.now() - start_s
            timing = self._keep(name, start_s, duration_s, host_s, budget_s, cycle)
        self._check_budget(timing)

    def done(self, name: str, duration_s: float, host_s: float, budget_s: float, cycle: int) -> None:
        """Record a stage that has just ended.

        Raises:
            OverBudgetError: It took longer, and the policy of the step does not allow that.
        """
        start_s = self._clock.now() - duration_s
        self._check_budget(self._keep(name, start_s, duration_s, host_s, budget_s, cycle))

    def _keep(
        self, name: str, start_s: float, duration_s: float, host_s: float, budget_s: float, cycle: int
    ) -> StageTiming:
        if math.isnan(budget_s):
            budget_s = self._budgets.get(name, math.nan)
        timing = StageTiming(name, self.step, cycle, start_s - self.start_s, duration_s, host_s, budget_s)
        self._record.timing.append(timing)
        self._emit("stage", {"timing": timing})
        return timing

    def _check_budget(self, timing: StageTiming) -> None:
        """Apply the step's policy to a stage over its budget."""
        then = self.policy.over_budget
        if then in (None, "record") or not timing.over_budget or self._is_warned:
            return
        took, budget = (format_quantity(value, "time") for value in (timing.duration_s, timing.budget_s))
        text = f"'{timing.stage}' took {took}; its budget is {budget}"
        if then != "warn":
            raise OverBudgetError(text, then)
        # the stages around it, and the step, are over their budgets for the same reason
        self._is_warned = True
        self._emit("warning", {"text": f"shot {self._record.shot_index}: {text}"})


P = ParamSpec("P")
T = TypeVar("T")
EARLY = 0.05
"""Fraction of its exposure by which a frame may come early, because cameras round exposure times."""
PLAYED_EARLY_S = 10e-6
"""How early a program may end, in addition to the device's delay, which may be shorter than stated."""


class ShotSettings(NamedTuple):
    """The settings of a shot, which may differ from earlier shots.

    Attributes:
        lab: The devices, with planner and target.
        steps: Its steps, with their names.
        timelines: The timeline of each step.
        parameters: The settings that differ from the files, address -> value.
    """

    lab: Lab
    steps: Sequence[tuple[str, Step]]
    timelines: Sequence[Sequence[TimelineEntry]]
    parameters: Mapping[str, Any]


class RunningShot:
    """Implements ``labseq.roles.Shot`` for the steps and fills the shot's record.

    Args:
        record: Filled while the shot runs, so that nothing is lost if it fails.

    Attributes:
        leaders: Talks to other control systems. None without a device for it.
    """

    leaders: LeaderAnswers | None = None

    def __init__(self, settings: ShotSettings, guard: Guard, record: ShotRecord, events: Events) -> None:
        lab = settings.lab
        self.record = record
        self.index = record.shot_index
        self.occupancy: Occupancy | None = None
        self.frame: Frame | None = None
        self.grid = lab.grid
        self.motion = lab.motion
        self.clock = lab.clock
        self.simulation = lab.simulation
        self.static_tweezers = lab.static_tweezers
        self.mobile_tweezers = lab.mobile_tweezers
        self.detector = lab.detector
        self.calibrations = lab.calibrations
        self.call_timeout_s = lab.timeouts.call_s
        self.plan_timeout_s = lab.timeouts.plan_s
        self.in_step = False
        self._image_name = "image"
        self._kept: tuple[float, float] | None = None
        self.stages = Stages(lab, record, events)
        self.start_s = self.stages.start_s
        self.series = CameraSeries(lab, partial(guard.call, "camera", lab.timeouts.call_s))
        self._fired_s = self._started_s = 0.0
        self._frame_s: tuple[float, float] | None = None
        self._guard = guard
        self._events = events
        self.use(settings)

    def use(self, settings: ShotSettings) -> None:
        """Do the rest of the shot with these settings."""
        self.lab, self.steps = settings.lab, settings.steps
        self.target = self.lab.target
        self.planner = self.lab.planner
        self.planner_name = self.lab.planner_name
        self.degree_of_parallelism = self.lab.degree_of_parallelism
        self.series.timelines = settings.timelines
        self.record.parameters = settings.parameters
        self.record.target = self.target

    @property
    def step(self) -> int:
        """Index of the running step."""
        return self.stages.step

    @property
    def elapsed_s(self) -> float:
        """Time since the start of the shot, on the session's clock."""
        return self.clock.now() - self.start_s

    @contextmanager
    def of_step(
        self,
        number: int,
        name: str,
        policy: StepPolicy,
        images: str = "",
        *,
        needs_image: bool = False,
    ) -> Generator[None]:
        """Context manager around a step, to which the stages, images and failures within belong.

        The length of its timeline, if it has one, is its budget.

        Args:
            images: Beginning of the names of its images. Default is the name of the step.
            needs_image: Whether it follows from the image before it.

        Raises:
            OverBudgetError: It took longer than its budget, and its policy does not allow that.
        """
        if not needs_image:  # else its moves follow from the frame, and events wait until they have begun
            self._events.release()
        self.in_step, self._image_name, self._kept = True, images or name, None
        self.stages.begin_step(number, name, policy)
        self.series.begin_step(number)
        start_s, host_start_s = self.elapsed_s, time.perf_counter()
        entries = self.series.entries(number)
        planned_s = sum(entry.duration_s for entry in entries)
        arms = any(entry.n_images and not self.series.is_ready(entry.exposure_s) for entry in entries)
        # a timeline leaves out the arming and the detection
        more_s = self.lab.budgets.get("detect", 0.0) * sum(entry.n_images for entry in entries)
        more_s += self.series.arm_s if arms else 0.0
        with self.stage(f"{STEP}{number}_{name}", planned_s + more_s if planned_s else math.nan):
            yield
            durations = self._kept or (planned_s, self.elapsed_s - start_s)
            timed_by = ", ".join(dict.fromkeys(entry.timed_by.name for entry in entries))
            host_s = time.perf_counter() - host_start_s
            self.record.steps.append(StepTiming(number, name, timed_by, start_s, *durations, host_s))
        # not after a failure, because the sequencer asks for the policy of the step that failed
        self.stages.policy, self.in_step = NO_POLICY, False

    def record_duration(self, planned_s: float, achieved_s: float) -> None:
        """Record the duration that hardware kept. See ``labseq.plugin.Shot``."""
        self._kept = planned_s, achieved_s

    def device(self, name: str) -> Device:
        """A named device of the profile."""
        try:
            return self.lab.devices[name]
        except KeyError:
            known = ", ".join(self.lab.devices) or "none"
            raise ConfigError(f"the profile has no device '{name}'; it has {known}") from None

    def take_frame(
        self, camera: str, exposure_s: float, light: AbstractContextManager[object] | None = None
    ) -> Frame:
        """Take a frame of anything but atoms. See ``labseq.plugin.Shot``."""
        if camera == "camera":
            self.series.end()
        chosen: Any = self.lab.camera if camera == "camera" else self.device(camera)
        return take_frame(chosen, camera, exposure_s, self.call, self.call_timeout_s, light or nullcontext())

    def call(
        self, owner: str, timeout_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Call a device or plugin. See ``labseq.roles.Shot``.

        Raises:
            StepTimeoutError: The step has used up the time that its policy gives it.
        """
        self.stages.check_timeout()
        return self._guard.call(owner, timeout_s, function, *args, **kwargs)

    def poll(self) -> None:
        """Record values of devices, and the detector's thresholds, at the start of a shot."""
        for name, device in self.lab.hardware():
            if overrides(device, Hardware.poll):
                values = self.call(name, self.call_timeout_s, device.poll)
                self.record.readings.update({f"{name}.{value}": read for value, read in values.items()})
        self.call("detector", self.call_timeout_s, self._record_thresholds)

    def _record_thresholds(self) -> None:
        """Record sites, thresholds and their unit, if the detector reports them."""
        detector, record, shape = self.lab.detector, self.record, self.grid.shape
        if isinstance(detector, ReportsSignals):
            record.thresholds = np.array(detector.thresholds, np.float64).reshape(shape)
            record.sites_px = np.array(detector.sites_px, np.float64).reshape(*shape, 2)
            record.signal_unit = str(detector.signal_unit)

    def check_interlocks(self) -> None:
        """Check the interlocks of every device. See ``labseq.plugin.Shot``."""
        for name, device in self.lab.hardware():
            if overrides(device, Hardware.check_interlocks):
                try:
                    self.call(name, self.call_timeout_s, device.check_interlocks)
                except DeviceError as error:
                    raise InterlockError(error.device, error.message) from error

    def follow(self, signal: str, timeout_s: float, device: str = "") -> None:
        """Wait for the start signal of another control system. See ``labseq.plugin.Shot``."""
        self._leaders.follow(signal, timeout_s, device)

    def leave_to_leader(self, step: str, timeout_s: float, device: str = "") -> None:
        """Let another control system do a step of its own. See ``labseq.plugin.Shot``."""
        self._leaders.take_turn(step, timeout_s, device)

    @property
    def _leaders(self) -> LeaderAnswers:
        if self.leaders is None:
            raise ConfigError("the profile has no device that receives signals of another control system")
        return self.leaders

    @property
    def step_context(self) -> StepContext:
        """The context from which the steps laid out their timelines."""
        return self.lab.step_context

    def margin_s(self, kind: str) -> float:
        """Extra time that a kind of step takes for its lines, in seconds."""
        return margin_s(self.lab.line_specs, kind)

    @contextmanager
    def lines_on(
        self,
        kind: str,
        duration_s: float,
        start: Callable[[], object] | None = None,
        pulses: Pulses = NO_PULSES,
    ) -> Generator[None]:
        """Fire the lines of a kind of step around it. See ``labseq.roles.Shot``."""
        timeout_s, specs = self.call_timeout_s, self.lab.line_specs
        # lines that only pulses turn on need no program in other steps
        lines = self.lab.lines if pulses or any(spec.on for spec in specs) else None
        is_triggered = start is not None and trigger_line(specs, "mobile_tweezers") is not None
        if start is not None and (lines is None or is_triggered):
            start()
        if lines is None:
            self._begin_moves(start)
            yield
            return
        program = line_program(specs, kind, duration_s, pulses)
        self.call("lines", timeout_s, lines.compile, program)
        self.call("lines", timeout_s, lines.arm)
        self._fired_s = self.clock.now()
        self.call("lines", timeout_s, lines.fire)
        fired_s = self.clock.now()  # after the call, which takes a moment
        self._started_s = fired_s
        self.clock.sleep(max(0.0, program.begin_s - (self.clock.now() - fired_s)))
        if start is not None and not is_triggered:
            start()
        self._begin_moves(start)
        self._record_edges(program, fired_s, lines.lines_facts.resolution_s)
        yield
        if is_triggered:
            self._check_end(program.begin_s + duration_s)
        left_s = max(0.0, program.duration_s - (self.clock.now() - fired_s)) + timeout_s
        self.call("lines", left_s + DRIVER_MARGIN_S, lines.wait, left_s)

    def _record_edges(self, program: LineProgram, fired_s: float, tick_s: float) -> None:
        """Record the edges of a program, at the times that the box rounds them to."""
        start_s = fired_s - self.start_s
        self.record.edges += [
            LineEdge(self.step, line, is_on, round(t_s / tick_s) * tick_s if tick_s else t_s, start_s)
            for line, is_on, t_s in program.changes()
        ]

    def _begin_moves(self, start: Callable[[], object] | None) -> None:
        """Record how long after the frame the mobile tweezers' light came, and report the kept events."""
        if start is not None and self._frame_s is not None:
            mobile, (frame_s, host_s) = self.mobile_tweezers, self._frame_s
            cycle = self.record.images[-1].cycle + 1 if self.record.images else -1
            host_taken_s = time.perf_counter() - host_s
            taken_s = self.clock.now() - frame_s + mobile.start_delay_s
            self._frame_s = None
            self.stage_done("light", taken_s, host_taken_s, cycle=cycle)
        self._events.release()

    def _check_end(self, least_s: float) -> None:
        """Raise if a program ended too early, because an extra trigger pulse started it."""
        early_s = self._fired_s + least_s - self.clock.now()
        if early_s > PLAYED_EARLY_S + self.mobile_tweezers.start_delay_s:
            text = f"a program ended {format_quantity(early_s, 'time')} too early, so an earlier pulse than"
            text += " the line's started it; look for a second edge at the trigger input"
            raise DeviceError("mobile_tweezers", text)

    def release(self, duration_s: float) -> float:
        """Turn the static tweezers off for a time that hardware keeps. See ``labseq.plugin.Shot``.

        One command to the device turns them off and on again.

        Raises:
            ConfigError: Neither a line nor the driver of the static tweezers can do it.
        """
        by, achieved_s = self.step_context.release_by, duration_s
        if by is None:
            raise ConfigError("neither a line nor the driver can turn off this profile's static tweezers")
        with self.lines_on("release", duration_s):
            if by.name == "static_tweezers":
                limit_s = duration_s + self.call_timeout_s
                achieved_s = self.call(by.name, limit_s, self.static_tweezers.release, duration_s)
            elif by.accuracy_s:
                achieved_s = round(duration_s / by.accuracy_s) * by.accuracy_s
        return achieved_s

    def stage(self, name: str, budget_s: float = math.nan, cycle: int = -1) -> AbstractContextManager[None]:
        """Time a stage against its budget. See ``labseq.plugin.Shot``."""
        return self.stages.around(name, budget_s, cycle)

    def stage_done(
        self, name: str, duration_s: float, host_s: float, budget_s: float = math.nan, cycle: int = -1
    ) -> None:
        """Record a stage that has just ended. See ``labseq.plugin.Shot``."""
        self.stages.done(name, duration_s, host_s, budget_s, cycle)

    def take_image(self, exposure_s: float, cycle: int = -1) -> Occupancy:
        """Expose, read, detect and record an image.

        Raises:
            DeviceError: Camera or detector returned an object of the wrong type, or a light is on that
                would damage the camera.
        """
        self._events.release()
        check_blinding(self.lab, self._guard)
        if self.series.is_ready(exposure_s):
            self._await_exposure()
        timeout_s, start_s = self.call_timeout_s, self.elapsed_s
        answer = self._expose(exposure_s, cycle)
        self._catch_up()
        self._frame_s = self.clock.now(), time.perf_counter()
        self._events.hold()
        frame = as_frame("camera", answer)
        with self.stage("detect", cycle=cycle):
            detected = self.call("detector", timeout_s, self.lab.detector.detect, frame)
        occupancy, confidence, signal = self._detected(detected)
        self.occupancy, self.frame = occupancy, frame
        name = self._name_of_image(cycle)
        image = ImageRecord(frame, occupancy, confidence, self.step, cycle, start_s, exposure_s, name, signal)
        self.record.images.append(image)
        if self.leaders is not None:
            self.leaders.image(image)
        if cycle >= 0 and self.record.seen_defect_free_cycle < 0 and self.target.is_met_by(occupancy):
            self.record.seen_defect_free_cycle = cycle
        filling = math.nan if self.target.is_none else self.target.filling_fraction(occupancy)
        self._events("image", {"image": image, "filling_fraction": filling})
        return occupancy

    def _catch_up(self) -> None:
        """Let a simulated device catch up with virtual time while nothing depends on it."""
        if self.clock.virtual:
            self.call("mobile_tweezers", self.call_timeout_s, self.lab.mobile_tweezers.settle)

    def _name_of_image(self, cycle: int) -> str:
        """A unique name for an image of the shot, from the step's name with the cycle or a number."""
        name = f"{self._image_name}_cycle_{cycle}" if cycle >= 0 else self._image_name
        taken = {image.name for image in self.record.images}
        return next(one for n in itertools.count() if (one := f"{name}_{n}" if n else name) not in taken)

    def _expose(self, exposure_s: float, cycle: int) -> object:
        """Take a frame. The stage "read_out" begins at the end of the exposure."""
        camera, specs, timeout_s = self.lab.camera, self.lab.line_specs, self.call_timeout_s
        limit_s, readout_s = timeout_s + exposure_s, self.lab.camera.facts.readout_s
        if not self.series.is_ready(exposure_s):
            with self.stage("arm", self.series.arm_s, cycle):
                self.series.arm(exposure_s)
        with self.stage("expose", exposure_s + readout_s + margin_s(specs, "image"), cycle):
            light = nullcontext() if self.leaders is None else self.leaders.light(exposure_s)
            with light, self.lines_on("image", exposure_s):
                if not self.series.by_line:
                    self.call("camera", limit_s, camera.trigger)
                end_s, host_start_s = self.elapsed_s + exposure_s, time.perf_counter()
                if not self.clock.virtual:
                    self._events.expect_frame()
                frame = self.call("camera", limit_s + DRIVER_MARGIN_S, camera.read, limit_s)
                host_s = time.perf_counter() - host_start_s
                late_s = max(0.0, self.elapsed_s - end_s)
                waited_s = 0.0 if self.clock.virtual else exposure_s
                self.stage_done("read_out", late_s, max(0.0, host_s - waited_s), readout_s, cycle)
                self._check_order(exposure_s)
            self.series.taken(self._started_s)
        return frame

    def _await_exposure(self) -> None:
        """If the camera starts the next exposure by itself, wait until the lines must be fired for it.

        Raises:
            TransientError: It is too late for that.
        """
        left_s = self.series.fire_s - self.clock.now()
        if math.isnan(left_s):
            return
        if left_s < 0:
            late = format_quantity(-left_s, "time")
            text = (
                f"with `line_trigger: external_start` the camera exposes by itself, and the step came {late}"
            )
            raise TransientError(f"{text} too late for it; set a longer `cycle_time`", "camera")
        self.clock.sleep(left_s)

    def _check_order(self, exposure_s: float) -> None:
        """Raise if a frame came before its exposure was over, because an extra trigger pulse started it."""
        early_s = self._fired_s + exposure_s - self.clock.now()
        if self.series.by_line and early_s > EARLY * exposure_s:
            text = f"a frame came {format_quantity(early_s, 'time')} before its exposure was over, so an"
            text += " earlier pulse at the camera's trigger input started it;"
            text += " look for a second edge on that line"
            raise DeviceError("camera", text)

    def judge(self) -> None:
        """Judge the shot on the image just taken. Only called by the ``image`` step."""
        if self.occupancy is None or self.target.is_none:
            return
        self.record.success = self.target.is_met_by(self.occupancy)
        self.record.filling_fraction = self.target.filling_fraction(self.occupancy)

    def record_cycle(self, cycle: CycleRecord) -> None:
        """Add a rearrangement cycle, made on the image that was taken last, to the shot's record."""
        if not self.record.cycles and self.occupancy is not None:
            n_missing = self.target.n_atoms - int(np.count_nonzero(self.occupancy))
            self.record.n_missing_atoms = max(0, n_missing)
            if n_missing > 0:
                self.log("too_few_atoms", n_missing_atoms=n_missing)
        self.record.success, self.record.filling_fraction = False, float("nan")  # judged before the moves
        self.record.cycles.append(cycle)
        self._events("cycle", {"cycle": cycle})

    def note(self, name: str, value: float | Sequence[Any]) -> None:
        """Record a value among the shot's readings."""
        self.record.readings[name] = value

    def log(self, event: str, **values: Any) -> None:
        """Add a line to the run's event log."""
        self._events(event, {"shot": self.index, **values})

    def record_truth(self) -> None:
        """Record the simulation's true occupancy, losses and events of the atoms."""
        simulation, readings, timeout_s = self.simulation, self.record.readings, self.call_timeout_s
        if simulation is None or not self.lab.camera_is_simulated:
            return
        truth = self.call("simulation", timeout_s, simulation.truth)
        if truth is not None:
            readings["simulation.n_atoms_true"] = int(np.count_nonzero(truth))
            if not self.target.is_none:
                readings["simulation.n_defects_true"] = self.target.n_defects(truth)
        losses = self.call("simulation", timeout_s, simulation.losses)
        readings.update({f"simulation.lost.{cause}": n for cause, n in losses.items()})
        events = self.call("simulation", timeout_s, simulation.atom_events, self.start_s)
        self.record.atom_events.update(events)

    def _detected(self, answer: Any) -> tuple[Occupancy, Any, Any]:
        """The checked answer of the detector, which is occupancy, confidence and perhaps signals."""
        shape = self.grid.shape
        if not (isinstance(answer, tuple) and len(cast("tuple[Any, ...]", answer)) in (2, 3)):
            raise DeviceError(
                "detector", f"detect() returned {type(answer).__name__}; expected 2 or 3 arrays"
            )
        parts = cast("tuple[Any, ...]", answer)
        for name, array, kind in zip(("occupancy", "confidence", "signals"), parts, "bff", strict=False):
            if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype.kind != kind:
                came = f"{getattr(array, 'dtype', type(array).__name__)} {getattr(array, 'shape', '')}"
                wanted = "bool" if kind == "b" else "float32" if name == "confidence" else "float64"
                raise DeviceError("detector", f"the {name} is {came}; expected {wanted} {shape}")
        occupancy, confidence, *signals = parts
        signal = np.ascontiguousarray(signals[0], np.float64) if signals else None
        return np.ascontiguousarray(occupancy), np.ascontiguousarray(confidence, np.float32), signal
