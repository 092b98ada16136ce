"""The roles that plugins play, as Protocols, and what they are given to play them.

Roles are synchronous. A constructor does no I/O; ``open()`` does. Hardware roles
share ``open``, ``close``, ``safe_state`` (legal in any state, also before
``open``, and any number of times) and ``describe``. Optional capabilities are
small extra Protocols that the core looks for with ``isinstance``.

Failures: a device raises ``DeviceError`` (or ``DeviceTimeoutError``),
``LimitError`` before anything moves when it is asked for too much, and
``TransientError`` when a repetition of the shot may help.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Literal, ParamSpec, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from labseq.model import (
    CameraFacts,
    CycleRecord,
    DepthRamp,
    Frame,
    MotionSpec,
    Occupancy,
    Plan,
    RandomStream,
    RfSpan,
    SiteGrid,
    TargetPattern,
    TimelineEntry,
    ToneProgram,
)

P = ParamSpec("P")
T = TypeVar("T")

Trigger = Literal["software", "internal", "external"]


class Clock(Protocol):
    """The session's time: real, or virtual where no device needs real time."""

    @property
    def virtual(self) -> bool:
        """Whether waiting costs no real time."""
        ...

    def now(self) -> float:
        """Monotonic time in seconds; its zero is arbitrary."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Wait. Looks for a stop request at least every 50 ms.

        Raises:
            StopRequested: The operator asked the run to stop.
        """
        ...

    def check(self) -> None:
        """Raise ``StopRequested`` if the operator asked the run to stop; else return at once."""
        ...


class Hardware(Protocol):
    """What all hardware roles share."""

    def open(self) -> None:
        """Connect and initialise; the first call that may do I/O."""
        ...

    def close(self) -> None:
        """Disconnect; legal in any state."""
        ...

    def safe_state(self) -> None:
        """Make all outputs harmless; idempotent and legal in any state."""
        ...

    def describe(self) -> Mapping[str, Any]:
        """Model, serial number, firmware, settings in force: JSON-ready values."""
        ...


class Camera(Hardware, Protocol):
    """Takes frames."""

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """Get ready for a series of ``n_frames`` exposures."""
        ...

    def trigger(self) -> None:
        """Start the next exposure of the series (software trigger)."""
        ...

    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame not yet read.

        Raises:
            DeviceTimeoutError: No frame came within ``timeout_s``.
        """
        ...


@runtime_checkable
class KnownCamera(Protocol):
    """A camera that tells its limits before it is opened, for ``labseq check`` and budgets."""

    @property
    def facts(self) -> CameraFacts:
        """Read-out time, longest exposure, shape of its frames."""
        ...


class StaticTweezers(Hardware, Protocol):
    """The static array."""

    def load(self, amplitudes: tuple[NDArray[np.float64], NDArray[np.float64]] | None) -> None:
        """Set the tone amplitudes of the rows (n_rows,) and columns (n_cols,).

        Fractions of full scale; None stands for the calibrated ones.
        """
        ...

    def start(self) -> None:
        """Turn the array on at its nominal depth; no effect if it is on."""
        ...

    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth linearly, to a fraction of the nominal depth."""
        ...


class MobileTweezers(Hardware, Protocol):
    """The moving tweezers."""

    def prepare(self, program: ToneProgram) -> float:
        """Render and upload a program without playing it.

        Returns:
            Playing time in seconds.

        Raises:
            LimitError: The program asks for more than the device can do.
        """
        ...

    def play(self) -> None:
        """Start playing what was prepared; returns at once."""
        ...

    def wait(self, timeout_s: float) -> None:
        """Wait until the program has been played to its end.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
        """
        ...


class Device(Hardware, Protocol):
    """Any other instrument: a shutter, a laser controller, a synthesizer."""

    def command(self, name: str, **arguments: Any) -> None:
        """Carry out one of the commands that the device declares."""
        ...

    def read(self, name: str) -> Any:
        """Read one of the values that the device declares."""
        ...


class Lines(Hardware, Protocol):
    """The timing box that switches light and sends triggers."""

    def compile(self, timeline: Sequence[TimelineEntry]) -> None:
        """Work out the edges of a shot."""
        ...

    def arm(self) -> None:
        """Get ready to fire."""
        ...

    def fire(self) -> None:
        """Start the compiled timeline."""
        ...

    def wait(self, timeout_s: float) -> None:
        """Wait for its end."""
        ...


class Planner(Protocol):
    """Decides the moves. Pure: deterministic, no I/O, the input left untouched."""

    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target.

        With too few atoms it fills what it can, from the centre of the target.

        Args:
            occupancy: bool (n_rows, n_cols), as detected; of any memory layout, and
                perhaps read-only.
            target: What to end with.
        """
        ...


class Detector(Protocol):
    """Turns a frame into an occupancy."""

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """Find the atoms.

        Returns:
            The occupancy, bool (n_rows, n_cols), and the confidence per site,
            float32 (n_rows, n_cols), 0 at the threshold and 1 for certainty.
        """
        ...


class Simulation(Protocol):
    """The world that virtual drivers act on; one per run, opened before them."""

    def open(self) -> None:
        """Draw the machine's own disorder."""
        ...

    def close(self) -> None:
        """Forget everything."""
        ...

    def begin_shot(self) -> None:
        """Remove all atoms; called after the random stream was set to the shot."""
        ...

    def load(self, t_start_s: float, duration_s: float) -> None:
        """The atom source is on: loads every site whose static tweezer is on."""
        ...

    def play(self, role: str, signal: ToneProgram | DepthRamp, t_start_s: float) -> None:
        """A device's output, from ``t_start_s`` on: role "mobile_tweezers" or "static_tweezers"."""
        ...

    def expose(self, t_start_s: float, exposure_s: float) -> Frame:
        """The frame that a camera sees; imaging light is on."""
        ...

    def describe(self) -> Mapping[str, Any]:
        """Every constant of the model: JSON-ready values."""
        ...


@runtime_checkable
class KnownLoading(Protocol):
    """A simulation that tells how well it loads, for estimates before a run."""

    @property
    def loading_probability(self) -> float:
        """Probability that a site holds an atom after loading."""
        ...


@runtime_checkable
class TruthTeller(Protocol):
    """A simulation that knows, and tells for the record, where the atoms really are."""

    def truth(self) -> Occupancy:
        """The true occupancy now, bool (n_rows, n_cols)."""
        ...


@runtime_checkable
class Storyteller(Protocol):
    """A simulation that tells, for the record, what happened to the atoms."""

    def story(self, since_s: float) -> Mapping[str, NDArray[Any]]:
        """What happened since the shot began: name -> structured array, with a field for each column.

        Args:
            since_s: Time on the session's clock from which times are counted.
        """
        ...


class RfSource(Protocol):
    """The two outputs of a simulated device that drives the mobile tweezers."""

    def played(self, until_s: float) -> tuple[Sequence[RfSpan], Sequence[RfSpan]]:
        """What the row output and the column output played since the last call, in time's order.

        Args:
            until_s: Time on the session's clock at which to stop for now.
        """
        ...


@runtime_checkable
class Listening(Protocol):
    """A simulation that acts on what a device's outputs really play, rather than on what it is told."""

    def warm(self) -> None:
        """Compile the kernels for that; a driver that will be listened to calls it in its own ``warm``."""
        ...

    def listen(self, role: str, source: RfSource) -> None:
        """From now on listen to these outputs of a role, in the place of earlier ones."""
        ...


@runtime_checkable
class Warmable(Protocol):
    """A planner, detector or driver with kernels to compile before the first shot."""

    def warm(self) -> None:
        """Compile (or load from the cache) every kernel that a shot will need."""
        ...


class NeverStopped:
    """A real clock that nobody stops; for plugins used outside of a run."""

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
        """Nothing to look for."""


@dataclass(frozen=True, slots=True)
class Context:
    """What a plugin's factory is given besides its settings.

    Attributes:
        name: Role or device name in the profile: "camera", "planner", "shutter".
        grid: The grid of sites.
        motion: How the mobile tweezers move.
        clock: The session's time; drivers wait by ``clock.sleep``.
        random: The plugin's own random numbers.
        calibrations: Active calibrations: kind -> value.
        simulation: The world, in every context; None where the profile has none.
    """

    name: str = ""
    grid: SiteGrid = field(default_factory=SiteGrid)
    motion: MotionSpec = field(default_factory=MotionSpec)
    clock: Clock = field(default_factory=NeverStopped)
    random: RandomStream = field(default_factory=lambda: RandomStream(0))
    calibrations: Mapping[str, Any] = field(default_factory=dict[str, Any])
    simulation: Simulation | None = None


class Shot(Protocol):
    """What a step works with: the devices, guarded, and the shot's state."""

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
        """What the array shall look like."""
        ...

    @property
    def clock(self) -> Clock:
        """The session's time."""
        ...

    @property
    def simulation(self) -> Simulation | None:
        """The simulated world, if there is one."""
        ...

    @property
    def static_tweezers(self) -> StaticTweezers:
        """The static array."""
        ...

    @property
    def mobile_tweezers(self) -> MobileTweezers:
        """The moving tweezers."""
        ...

    @property
    def planner(self) -> Planner:
        """The planner."""
        ...

    @property
    def occupancy(self) -> Occupancy | None:
        """Occupancy on the last image of this shot; None before the first."""
        ...

    @property
    def planner_name(self) -> str:
        """Name of the planner, for messages."""
        ...

    @property
    def degree_of_parallelism(self) -> int:
        """Most mobile tweezers that a batch of this run may use."""
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
        """How long a device call may take beyond its own duration, from the profile."""
        ...

    @property
    def plan_timeout_s(self) -> float:
        """How long one plan may take, from the profile."""
        ...

    def device(self, name: str) -> Device:
        """A named device of the profile."""
        ...

    def judge(self) -> None:
        """Judge the shot's success on the image just taken."""
        ...

    def call(
        self, owner: str, timeout_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Call a device or plugin so that neither a hang nor a stop request is lost.

        Args:
            owner: Role or device name, for the error message.
            timeout_s: How long the call may take before the device counts as hung.
            function: For example ``shot.mobile_tweezers.play``.
            *args: Passed on to it.
            **kwargs: Passed on to it.

        Raises:
            DeviceTimeoutError: The call did not return in time.
            StopRequested: The operator asked the run to stop.
            DeviceError: The call raised anything that is not a ``LabseqError``.
        """
        ...

    def stage(self, name: str, budget_s: float = ..., cycle: int = 0) -> AbstractContextManager[None]:
        """Context manager that times a stage against its budget."""
        ...

    def take_image(self, exposure_s: float, cycle: int = 0) -> Occupancy:
        """Expose, read, detect and record an image."""
        ...

    def record_cycle(self, cycle: CycleRecord) -> None:
        """Add a rearrangement cycle to the shot's record."""
        ...

    def log(self, event: str, **values: Any) -> None:
        """Add a line to the run's event log."""
        ...


@dataclass(frozen=True, slots=True)
class StepContext:
    """What a step needs to know to lay out its timeline before anything is opened.

    Attributes:
        grid: The grid of sites.
        motion: How the mobile tweezers move.
        target: What the array shall look like.
        camera: What the camera says of itself before it is opened.
    """

    grid: SiteGrid
    motion: MotionSpec
    target: TargetPattern
    camera: CameraFacts = field(default_factory=CameraFacts)


class Step(Protocol):
    """One step of a shot.

    Attributes:
        needs_image: Whether an image must have been taken before it in the shot.
        takes_image: Whether later steps find an image of it.
    """

    needs_image: bool
    takes_image: bool

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """What the step will do, at most, for ``labseq check``."""
        ...

    def run(self, shot: Shot) -> None:
        """Do it."""
        ...


class RunObserver(Protocol):
    """Somebody who watches a run: the live view, a log. Failures never stop the run."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Something happened: "run_started", "shot_started", "stage", "image", ..."""
        ...
