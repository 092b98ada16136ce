"""The interfaces for steps, which are the clock, the shot, and the step itself."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, ParamSpec, Protocol, TypeVar

from labseq.model import (
    COMPUTER,
    CalibrationEntry,
    CameraFacts,
    CycleRecord,
    Frame,
    LinesFacts,
    LineSpec,
    MotionSpec,
    Occupancy,
    RandomStream,
    SiteGrid,
    TargetPattern,
    TimedBy,
    TimelineEntry,
    TweezersFacts,
)
from labseq.model.lines import IDLE, NO_PULSES, Pulses, lines_of, margin_s

if TYPE_CHECKING:
    from labseq.errors import Problem
    from labseq.roles.deciding import Detector, Planner
    from labseq.roles.hardware import Device, MobileTweezers, StaticTweezers
    from labseq.roles.simulation import Simulation


class Clock(Protocol):
    """The session's time, which is real, or virtual if no device needs real time."""

    @property
    def virtual(self) -> bool:
        """Whether waiting costs no real time."""
        ...

    def now(self) -> float:
        """Monotonic time in seconds, from an arbitrary zero."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Wait. Checks for a stop request at least every 50 ms.

        Raises:
            StopRequested: The operator asked the run to stop.
        """
        ...

    def check(self) -> None:
        """Raise ``StopRequested`` if the operator asked the run to stop. Otherwise returns at once."""
        ...


class NeverStopped:
    """A real clock without stop requests, for plugins used outside of a run."""

    virtual = False

    def now(self) -> float:
        """Monotonic time in seconds."""
        import time

        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Wait."""
        import threading

        threading.Event().wait(max(0.0, duration_s))

    def check(self) -> None:
        """No effect."""


P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Context:
    """The grid, clock, random numbers and more, which a plugin's factory gets next to its settings.

    Attributes:
        name: Role or device name in the profile, such as "camera", "planner" or "shutter".
        grid: The grid of sites.
        motion: How the mobile tweezers move.
        clock: The session's time. Drivers wait with ``clock.sleep``.
        random: The plugin's own random number generator.
        calibrations: Calibrations in use, kind -> entry.
        simulation: The simulation. None if the profile has none.
        lines: The lines of the timing box.
    """

    name: str = ""
    grid: SiteGrid = field(default_factory=SiteGrid)
    motion: MotionSpec = field(default_factory=MotionSpec)
    clock: Clock = field(default_factory=NeverStopped)
    random: RandomStream = field(default_factory=lambda: RandomStream(0))
    calibrations: Mapping[str, CalibrationEntry] = field(default_factory=dict[str, CalibrationEntry])
    simulation: Simulation | None = None
    lines: tuple[LineSpec, ...] = ()


class Shot(Protocol):
    """The devices and the state of the shot, for steps."""

    @property
    def index(self) -> int:
        """Index of the shot in the run."""
        ...

    @property
    def grid(self) -> SiteGrid:
        """The grid of sites."""
        ...

    @property
    def motion(self) -> MotionSpec:
        """How the mobile tweezers move."""
        ...

    @property
    def target(self) -> TargetPattern:
        """The target pattern."""
        ...

    @property
    def clock(self) -> Clock:
        """The session's time."""
        ...

    @property
    def simulation(self) -> Simulation | None:
        """The simulation, if there is one."""
        ...

    @property
    def static_tweezers(self) -> StaticTweezers:
        """The static tweezers."""
        ...

    @property
    def mobile_tweezers(self) -> MobileTweezers:
        """The mobile tweezers."""
        ...

    @property
    def planner(self) -> Planner:
        """The planner."""
        ...

    @property
    def detector(self) -> Detector:
        """The detector."""
        ...

    @property
    def calibrations(self) -> Mapping[str, CalibrationEntry]:
        """Calibrations in use, kind -> entry."""
        ...

    @property
    def frame(self) -> Frame | None:
        """Frame of the last image of this shot. None before the first."""
        ...

    @property
    def occupancy(self) -> Occupancy | None:
        """Occupancy on the last image of this shot. None before the first."""
        ...

    @property
    def planner_name(self) -> str:
        """Name of the planner, for messages."""
        ...

    @property
    def degree_of_parallelism(self) -> int:
        """Maximum number of mobile tweezers in a batch of this run."""
        ...

    @property
    def step(self) -> int:
        """Index of the running step."""
        ...

    @property
    def start_s(self) -> float:
        """Start of the shot on the session's clock."""
        ...

    @property
    def call_timeout_s(self) -> float:
        """Maximum time of a device call beyond its own duration, in seconds, from the profile."""
        ...

    @property
    def plan_timeout_s(self) -> float:
        """Maximum time of one plan, in seconds, from the profile."""
        ...

    def device(self, name: str) -> Device:
        """A named device of the profile."""
        ...

    def judge(self) -> None:
        """Decide from the image just taken whether the shot succeeded."""
        ...

    def call(
        self, owner: str, timeout_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Call a device or plugin with a time limit. Obeys stop requests during the call.

        Args:
            owner: Role or device name, for the error message.
            timeout_s: Maximum time of the call in seconds. After it, the device counts as hung.
            function: For example ``shot.mobile_tweezers.play``.
            *args: Passed on to it.
            **kwargs: Passed on to it.

        Raises:
            DeviceTimeoutError: The call did not return in time.
            StopRequested: The operator asked the run to stop.
            DeviceError: The call raised anything that is not a ``LabseqError``.
        """
        ...

    def check_interlocks(self) -> None:
        """Check the interlocks of every device before atoms are picked up.

        Raises:
            DeviceError: A value exceeds its limit.
        """
        ...

    def follow(self, signal: str, timeout_s: float, device: str = "") -> None:
        """Wait for the start signal of another control system, which will receive the outcome of this shot.

        At a second wait in a shot, labseq first answers `ready` to the earlier signal.

        Args:
            signal: "go".
            timeout_s: How long to wait, in seconds.
            device: Name of the device that receives the signal. "" for the only one.

        Raises:
            ConfigError: There is no such device.
            DeviceTimeoutError: The signal did not come in time.
            StopRequested: The operator asked the run to stop.
        """
        ...

    def leave_to_leader(self, step: str, timeout_s: float, device: str = "") -> None:
        """Let another control system do a step of its own.

        Args:
            step: Name of the step.
            timeout_s: Longest time until it reports the end, in seconds.
            device: Name of the device that it speaks through. "" for the only one.

        Raises:
            ConfigError: There is no such device.
            TransientError: It is not connected, leaves, or is not done in time.
        """
        ...

    def margin_s(self, kind: str) -> float:
        """Extra time that a kind of step takes for the leads and lags of its lines, in seconds."""
        ...

    @property
    def step_context(self) -> StepContext:
        """The context from which the step laid out its timeline."""
        ...

    def lines_on(
        self,
        kind: str,
        duration_s: float,
        start: Callable[[], object] | None = None,
        pulses: Pulses = NO_PULSES,
    ) -> AbstractContextManager[None]:
        """Context manager for the work of a step, which switches the step's lines on before and off after.

        Args:
            kind: Kind of the step, as the profile's lines name it, for example "image".
            duration_s: Duration of the step, in seconds.
            start: Starts the step's device when the step begins, or arms it before the lines are fired if a
                line triggers it.
            pulses: Pulses that the step itself makes, line -> (start, end) in seconds from its beginning.
        """
        ...

    def release(self, duration_s: float) -> float:
        """Turn the static tweezers off for a time kept by the timing box or the tweezers' own driver.

        Returns:
            The time without light, in seconds. Returns when it is over.
        """
        ...

    def record_duration(self, planned_s: float, achieved_s: float) -> None:
        """Record the duration kept by hardware, instead of the duration of the whole step."""
        ...

    def stage(self, name: str, budget_s: float = ..., cycle: int = -1) -> AbstractContextManager[None]:
        """Context manager that times a stage against its budget."""
        ...

    def stage_done(
        self, name: str, duration_s: float, host_s: float, budget_s: float = ..., cycle: int = -1
    ) -> None:
        """Record a stage that has just ended, where :meth:`stage` cannot be used.

        Args:
            name: Name of the stage.
            duration_s: Its duration on the session's clock, in seconds.
            host_s: Its duration on this computer's clock, in seconds.
            budget_s: Its budget. Default is the profile's ``budgets``.
            cycle: Index of the rearrangement cycle. -1 outside of a cycle.
        """
        ...

    def take_image(self, exposure_s: float, cycle: int = -1) -> Occupancy:
        """Expose, read, detect and record an image."""
        ...

    def take_frame(
        self, camera: str, exposure_s: float, light: AbstractContextManager[object] | None = None
    ) -> Frame:
        """Take a frame of anything but atoms, without switching lines, detecting or recording.

        Args:
            camera: "camera" for the camera of the atoms, or a device of the profile with ``role: camera``.
            exposure_s: Exposure time, in seconds.
            light: Entered when the camera is ready, before the exposure, and left after the frame has come.

        Raises:
            ConfigError: There is no such camera.
            DeviceError: It has an EM gain, or only an external trigger.
        """
        ...

    def record_cycle(self, cycle: CycleRecord) -> None:
        """Add a rearrangement cycle to the shot's record."""
        ...

    def note(self, name: str, value: float | Sequence[Any]) -> None:
        """Record a value, or lists of values, among the shot's readings, for example as "overlay.error_m"."""
        ...

    def log(self, event: str, **values: Any) -> None:
        """Add a line to the run's event log."""
        ...


@dataclass(frozen=True, slots=True)
class StepContext:
    """The grid, motion, target and camera facts from which a step lays out its timeline before devices open.

    Attributes:
        grid: The grid of sites.
        motion: How the mobile tweezers move.
        target: The target pattern.
        camera: The camera's facts, which are known before it is opened.
        lines: The lines of the timing box.
        lines_facts: The facts of the timing box.
        static_tweezers: The facts of the static tweezers.
    """

    grid: SiteGrid
    motion: MotionSpec
    target: TargetPattern
    camera: CameraFacts = field(default_factory=CameraFacts)
    lines: tuple[LineSpec, ...] = ()
    lines_facts: LinesFacts = field(default_factory=lambda: LinesFacts(()))
    static_tweezers: TweezersFacts = field(default_factory=TweezersFacts)

    def margin_s(self, kind: str) -> float:
        """Extra time that a kind of step takes for the leads and lags of its lines, in seconds."""
        return margin_s(self.lines, kind)

    def timed_by(self, kind: str) -> TimedBy:
        """Device that times such a step, the timing box if it switches a line on in it, else the computer."""
        if any(IDLE not in spec.on and not spec.pulse_s for spec in lines_of(self.lines, kind)):
            return TimedBy("lines", self.lines_facts.resolution_s)
        return COMPUTER

    @property
    def release_by(self) -> TimedBy | None:
        """Device that times a release, either the timing box or the tweezers' driver. None if neither can."""
        if any(spec.turns_off == "static_tweezers" for spec in self.lines):
            return TimedBy("lines", self.lines_facts.resolution_s)
        if self.static_tweezers.shortest_release_s < math.inf:
            return TimedBy("static_tweezers", self.static_tweezers.resolution_s)
        return None


class Step(ABC):
    """One step of a shot.

    Attributes:
        needs_target: Whether the sequence must have a target, because the step moves atoms towards it.
        needs_image: Whether an image must have been taken before it in the shot.
        takes_image: Whether it leaves an image to the steps after it.
        repeatable: Whether it may be retried in the same shot when it fails, because it leaves the atoms
            where they are. Other steps are only repeated with the whole shot.
        takes_time: Whether a line can be on during it.
        device_setting: Name of its setting that names a device of the profile. "" if it has none.
        device_may_be_camera: Whether that may be a camera, which is a device with ``role: camera`` or
            "camera".
        signal: Start signal of another control system that it waits for ("go"). "" if it waits for none.
        device: Name of the device that receives the signal. "" for the only one.
        windows_s: Longest time for the moves of each of its rearrangement cycles, in seconds. `labseq check`
            compares the planner's moves with them.
        judges_shot: True if a shot that ends with this rearrangement needs no further image.
        notes: Names of the readings that it records by :meth:`Shot.note`, or their beginnings up to a dot.
            None if they are not known before the run. A sequence may measure these readings.
    """

    needs_image: bool = False
    takes_image: bool = False
    needs_target = False
    repeatable = False
    takes_time = True
    device_setting = ""
    device_may_be_camera = False
    signal = ""
    device = ""
    windows_s = tuple[float, ...]()
    judges_shot = False
    notes: Collection[str] | None = None

    @abstractmethod
    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """The parts of the step with their maximum durations, for ``labseq check`` and budgets."""

    @abstractmethod
    def run(self, shot: Shot) -> None:
        """Carry out the step."""

    def check_devices(
        self,
        devices: Mapping[str, object],  # noqa: ARG002 - overridden
        context: StepContext,  # noqa: ARG002
    ) -> Mapping[str, str | Problem]:
        """Check the settings against the devices, before any of them is opened.

        Args:
            devices: All hardware of the profile by its name, constructed.
            context: The facts of the devices, the grid and the target.

        Returns:
            Setting -> the problem, as text, or as a ``Problem`` without a place if it has an expected value
            and a hint. A setting within others has dots, as "parts.dark.duration".
        """
        return {}


EVENTS: Final = {
    "run_starting": "the run has its folder, and its devices are opened next",
    "compiling": "kernels are compiled, which happens once on each computer",
    "compiled": "the kernels are compiled, with the time it took",
    "settling": "labseq waits for a device to settle, such as a camera that cools down",
    "planner_chosen": "the planner's choice for the target, and the reason",
    "run_started": "all devices are open",
    "state": "the state of the run has changed: opening, idle, shot, writing, recovering, ...",
    "shot_started": "an attempt at a shot begins",
    "stage": "a stage of a step has ended, with its duration and its budget",
    "image": "an image was taken, with the occupancy found on it",
    "cycle": "a cycle of a rearrangement has ended",
    "over_budget": "a stage took longer than its budget",
    "too_few_atoms": "there are fewer atoms than the target needs",
    "window_too_short": "not all batches of a plan fitted into the window",
    "window_exceeded": "the moves ended after the window, with the delay",
    "ramped": "the static tweezers were ramped to another depth",
    "released": "the static tweezers were off for a moment, and are on again",
    "device_command": "a device carried out a command",
    "step_repeated": "a step failed and is repeated, by its policy",
    "leader_awaited": "labseq waits for a signal of the external control system",
    "leader_signal": "the signal has arrived",
    "leader_answered": "labseq has answered the signal",
    "leader_turn": "the external control system does a step of its own",
    "leader_event": "another message of the link to the external control system",
    "shot_repeated": "an attempt failed, and the shot is taken again",
    "shot_finished": "a shot is on disk, complete or not",
    "clock_jumped": "the computer slept or its clock was set since the last shot (also a reading)",
    "shots_skipped": "a policy skipped shots, with the reason",
    "scan_point": "a shot of an adaptive scan is on disk, with the point so far and the best point",
    "scan_ended": "the scanner chose no further point",
    "scan_result": "an adaptive scan is over, with the best point, its value and error, and suggested values",
    "ended_early": "the fits are as precise as `stop_when` asks, and the run ends, with the parameters and "
    "the number of shots left",
    "warning": "a warning for the user, after which the run continues",
    "left_on": "the static tweezers stay on after the run",
    "safe_state": "a device was brought to its safe state, or that failed",
    "closed": "a device was closed, or that failed",
    "run_finished": "the run has ended for any reason, and all devices are in their safe state",
}
"""Event of a run -> its meaning."""


class RunObserver(Protocol):
    """Receives the events of a run, as the live view or a log does. Its failures never stop the run."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Receive an event, one of :data:`EVENTS`."""
        ...
