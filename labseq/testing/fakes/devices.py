"""In-memory devices of every role, which record every call."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError, DeviceTimeoutError, LimitError
from labseq.guard import StopFlag
from labseq.model import DepthRamp, Frame, LineProgram, ToneProgram, TweezersFacts
from labseq.roles import (
    Camera,
    Clock,
    Context,
    Device,
    Hardware,
    Lines,
    MobileTweezers,
    StaticTweezers,
    Trigger,
    unknown_name,
)
from labseq.sequencer.clock import VirtualClock
from labseq.sequencer.lines import idle_program, off_program

Failure: TypeAlias = BaseException | Sequence[BaseException | None]
"""An error for every call, or a sequence of errors for successive calls (None for a call that works)."""


class Call(NamedTuple):
    """One call.

    Attributes:
        device: Name of the device.
        method: Name of the method.
        args: Its positional arguments.
        kwargs: Its keyword arguments.
        t_s: Time on the clock of the list of calls, in seconds.
    """

    device: str
    method: str
    args: tuple[Any, ...] = ()
    kwargs: Mapping[str, Any] = {}
    t_s: float = 0.0

    @property
    def name(self) -> str:
        """Name of the call, such as "camera.arm"."""
        return f"{self.device}.{self.method}"

    def __str__(self) -> str:
        given = [repr(value) for value in self.args]
        given += [f"{key}={value!r}" for key, value in self.kwargs.items()]
        return f"{self.name}({', '.join(given)})"


class Calls(list[Call]):
    """A list of calls that all fakes of a test share.

    Args:
        clock: Gives each call its time. Without a clock all times are 0.

    Example:
        >>> calls = Calls()
        >>> calls.note("camera", "arm", 1, exposure_s=0.045)
        >>> calls.note("shutter", "open")
        >>> calls.names(), str(calls[0])
        (['camera.arm', 'shutter.open'], 'camera.arm(1, exposure_s=0.045)')
        >>> calls.names("shutter")
        ['shutter.open']
    """

    def __init__(self, clock: Clock | None = None) -> None:
        super().__init__()
        self._clock = clock

    def note(self, device: str, method: str, *args: Any, **kwargs: Any) -> None:
        """Add a call."""
        t_s = self._clock.now() if self._clock is not None else 0.0
        self.append(Call(device, method, args, kwargs, t_s))

    def names(self, *devices: str) -> list[str]:
        """Names of the calls, such as "camera.arm", for the given devices or all."""
        return [call.name for call in self if not devices or call.device in devices]

    def of(self, name: str) -> list[Call]:
        """The calls of one method, for example "camera.arm"."""
        return [call for call in self if call.name == name]


class Hang:
    """A call that does not return until the test releases it.

    Attributes:
        reached: Set when the call has begun to hang. Wait for it in the test.
        release: Set it to let the call continue.
    """

    def __init__(self) -> None:
        self.reached = threading.Event()
        self.release = threading.Event()

    def wait(self) -> None:
        """Hang."""
        self.reached.set()
        self.release.wait(30.0)  # so that every test ends


class Faults:
    """Planned failures and hangs of one device, by method."""

    def __init__(self, fail_on: Mapping[str, Failure], hang_on: Mapping[str, Hang]) -> None:
        self._failures = {method: _in_turn(failure) for method, failure in fail_on.items()}
        self._hangs = hang_on

    def inject_fault(self, method: str) -> None:
        """Hang or raise if planned for the method."""
        if method in self._hangs:
            self._hangs[method].wait()
        failure = next(self._failures.get(method, iter(())), None)
        if failure is not None:
            raise failure


def _in_turn(failure: Failure) -> Iterator[BaseException | None]:
    if not isinstance(failure, BaseException):
        yield from failure
        return
    while True:
        yield failure


class FakeClock(VirtualClock):
    """Virtual time that records every wait.

    Attributes:
        stop: The stop request that the waits check.
        sleeps: Every wait in seconds, in order.

    Example:
        >>> clock = FakeClock()
        >>> clock.sleep(0.5)
        >>> clock.now(), clock.sleeps
        (0.5, [0.5])
    """

    def __init__(self, stop: StopFlag | None = None) -> None:
        self.stop = stop or StopFlag()
        self.sleeps: list[float] = []
        super().__init__(self.stop)

    def sleep(self, duration_s: float) -> None:
        """Let time pass and record it."""
        super().sleep(duration_s)
        self.sleeps.append(duration_s)


class RecordingHardware(Hardware):
    """A device in memory that keeps the promises of its role and records every call.

    Args:
        context: As passed to a plugin's factory. Default the role's name and
            a :class:`FakeClock`.
        calls: The list for the calls. Share one list between the devices of a test.
        fail_on: Method -> the error that it raises, for example ``{"play": DeviceError(...)}``.
        hang_on: Method -> the :class:`Hang` in which it waits.

    Attributes:
        calls: Every call so far.
        is_open: Whether it was opened and not closed since.
    """

    role: ClassVar[str] = "device"

    def __init__(
        self,
        context: Context | None = None,
        calls: Calls | None = None,
        *,
        fail_on: Mapping[str, Failure] | None = None,
        hang_on: Mapping[str, Hang] | None = None,
    ) -> None:
        context = context or Context(self.role, clock=FakeClock())
        self.name = context.name or self.role
        self.grid = context.grid
        self.clock = context.clock
        self.simulation = context.simulation
        self.calls = Calls(context.clock) if calls is None else calls
        self.is_open = False
        self._faults = Faults(fail_on or {}, hang_on or {})

    def open(self) -> None:
        """Record the call."""
        self.note("open")
        self.is_open = True

    def close(self) -> None:
        """Record the call and reset the state."""
        self.note("close")
        self.is_open = False
        self.reset()

    def safe_state(self) -> None:
        """Record the call and reset the state."""
        self.note("safe_state")
        self.reset()

    def describe(self) -> Mapping[str, Any]:
        """A description that names the fake."""
        self.note("describe")
        return {"model": type(self).__name__, "serial_number": "fake"}

    def reset(self) -> None:
        """Reset the state of the role. Overridden by roles that have a state."""

    def note(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Record a call, then hang or fail if the test has planned it."""
        self.calls.note(self.name, method, *args, **kwargs)
        self._faults.inject_fault(method)

    def use(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Record a call that needs an open device."""
        self.note(method, *args, **kwargs)
        if not self.is_open:
            raise DeviceError(self.name, f"{method}() was called while it is not open")


def require_within(name: str, value: float, lowest: float, highest: float) -> None:
    """Refuse a number outside its limits, nan included.

    Raises:
        LimitError: The number is outside its limits.
    """
    if not (math.isfinite(value) and lowest <= value <= highest):
        raise LimitError(name, value, f"{lowest:g} to {highest:g}")


class RecordingCamera(RecordingHardware, Camera):
    """A camera whose frame k has the value k in every pixel, uint16 (16, 16)."""

    role: ClassVar[str] = "camera"

    def __init__(self, context: Context | None = None, calls: Calls | None = None, **faults: Any) -> None:
        super().__init__(context, calls, **faults)
        self.frame_shape = (16, 16)
        self._n_taken = 0
        self.reset()

    def reset(self) -> None:
        """Forget the series and its frames."""
        self._n_left = self._n_in_series = 0
        self._exposure_s = 0.0
        self._frames: deque[Frame] = deque()

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """Begin a series."""
        self.use("arm", n_frames, exposure_s, trigger)
        require_within("the number of frames", n_frames, 1, 1e6)
        require_within("the exposure in seconds", exposure_s, 1e-6, 10.0)
        if trigger != "software":
            raise DeviceError(self.name, f"has no {trigger} trigger; expected 'software'")
        self.reset()
        self._n_left, self._exposure_s = n_frames, exposure_s

    def disarm(self) -> None:
        """End the series."""
        self.use("disarm")
        self.reset()

    def trigger(self) -> None:
        """Take the next frame, which can be read at the end of its exposure."""
        self.use("trigger")
        if self._n_left == 0:
            raise DeviceError(self.name, "trigger() needs arm() with frames left")
        self._n_left -= 1
        image = np.full(self.frame_shape, self._n_taken, np.uint16)
        self._n_taken += 1
        self._frames.append(Frame(image, self._exposure_s, self.clock.now(), self.name, self._n_in_series))
        self._n_in_series += 1

    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame."""
        self.use("read", timeout_s)
        end_s = self._frames[0].t_start_s + self._exposure_s if self._frames else float("inf")
        left_s = end_s - self.clock.now()
        if left_s > timeout_s:
            self.clock.sleep(timeout_s)
            raise DeviceTimeoutError(self.name, f"no frame came within {timeout_s} s", timeout_s)
        self.clock.sleep(max(0.0, left_s))
        return self._frames.popleft()


class RecordingStaticTweezers(RecordingHardware, StaticTweezers):
    """Static tweezers that only know their depth.

    Attributes:
        depth: Present fraction of the nominal depth.
    """

    role: ClassVar[str] = "static_tweezers"

    def __init__(self, context: Context | None = None, calls: Calls | None = None, **faults: Any) -> None:
        super().__init__(context, calls, **faults)
        self.depth = 0.0

    def reset(self) -> None:
        """Turn off."""
        self.depth = 0.0

    def load(self, amplitudes: tuple[NDArray[np.float64], NDArray[np.float64]] | None) -> None:
        """Take amplitudes between 0 and 1, one for each row and column."""
        self.use("load", amplitudes)
        for axis, n_tones in zip(amplitudes or (), self.grid.shape, strict=False):
            require_within("the number of tones", len(axis), n_tones, n_tones)
            for amplitude in axis:
                require_within("an amplitude", float(amplitude), 0.0, 1.0)

    def start(self) -> None:
        """Go to the nominal depth."""
        self.use("start")
        if self.depth != 1.0:
            self._go(1.0, 0.0)

    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth and wait for the end."""
        self.use("ramp", depth, duration_s)
        require_within("the depth", depth, 0.0, 1.0)
        require_within("the ramp's duration in seconds", duration_s, 0.0, 3600.0)
        self._go(depth, duration_s)

    @property
    def facts(self) -> TweezersFacts:
        """Facts of tweezers that can release for any time."""
        return TweezersFacts(shortest_release_s=0.0)

    def release(self, duration_s: float) -> float:
        """Be dark for a time. A planned error comes after the light is back."""
        require_within("the release in seconds", duration_s, 1e-9, 3600.0)
        self.clock.sleep(duration_s)
        self.use("release", duration_s)
        return duration_s

    def _go(self, depth: float, duration_s: float) -> None:
        if self.simulation is not None:
            ramp = DepthRamp(self.depth, depth, duration_s)
            self.simulation.play(self.name, ramp, self.clock.now())
        self.clock.sleep(duration_s)
        self.depth = depth


class RecordingMobileTweezers(RecordingHardware, MobileTweezers):
    """Mobile tweezers that keep their programs.

    Attributes:
        programs: Every program that was prepared, in order.
    """

    role: ClassVar[str] = "mobile_tweezers"

    def __init__(self, context: Context | None = None, calls: Calls | None = None, **faults: Any) -> None:
        super().__init__(context, calls, **faults)
        self.programs: list[ToneProgram] = []
        self.reset()

    def reset(self) -> None:
        """Stop playing and forget the program."""
        self._prepared: ToneProgram | None = None
        self._end_s = float("nan")

    def prepare(self, program: ToneProgram) -> float:
        """Check a program against the limits and keep it."""
        self.use("prepare", program)
        for axis in (program.row, program.column):
            for frequency in (*axis.start_hz, *axis.end_hz):
                require_within("a tone's frequency in Hz", float(frequency), 50e6, 150e6)
            for amplitude in (*axis.start_amplitude, *axis.end_amplitude):
                require_within("a tone's amplitude", float(amplitude), 0.0, 1.0)
        self._prepared = program
        self.programs.append(program)
        return program.total_duration_s

    def play(self) -> None:
        """Start the prepared program."""
        self.use("play")
        if self._prepared is None:
            raise DeviceError(self.name, "play() needs prepare()")
        start_s = self.clock.now()
        if self.simulation is not None:
            self.simulation.play(self.name, self._prepared, start_s)
        self._end_s = start_s + self._prepared.total_duration_s

    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program."""
        self.use("wait", timeout_s)
        if np.isnan(self._end_s):
            raise DeviceError(self.name, "wait() needs play()")
        left_s = self._end_s - self.clock.now()
        if left_s > timeout_s:
            self.clock.sleep(timeout_s)
            raise DeviceTimeoutError(self.name, f"it still plays after {timeout_s} s", timeout_s)
        self.clock.sleep(max(0.0, left_s))


class RecordingLines(RecordingHardware, Lines):
    """A timing box whose programs take their time and act on the simulation.

    Attributes:
        programs: Every program that was fired, in order.
    """

    role: ClassVar[str] = "lines"

    def __init__(self, context: Context | None = None, calls: Calls | None = None, **faults: Any) -> None:
        super().__init__(context, calls, **faults)
        self.programs: list[LineProgram] = []
        self._specs = () if context is None else context.lines
        self.reset()

    def idle(self) -> None:
        """Turn on the lines that are on at rest in the profile."""
        self.use("idle")
        self._apply_lines(idle_program(self._specs))

    def safe_state(self) -> None:
        """Turn all lines off."""
        super().safe_state()
        if self.is_open:
            self._apply_lines(off_program(self._specs))

    def reset(self) -> None:
        """Forget the compiled program."""
        self._compiled: LineProgram | None = None
        self._is_armed = False
        self._over_s = 0.0

    def compile(self, program: LineProgram) -> None:
        """Keep a program."""
        self.use("compile", program)
        require_within("the number of edges", len(program.t_s), 1, 1000)
        shortest_s = float(np.diff(program.t_s).min()) if len(program.t_s) > 1 else 1.0
        require_within("the time between two edges", shortest_s, 1e-6, 1e6)
        self._compiled, self._is_armed = program, False

    def arm(self) -> None:
        """Allow one firing."""
        self.use("arm")
        if self._compiled is None:
            raise DeviceError(self.name, "arm() needs compile()")
        self._is_armed = True

    def fire(self) -> None:
        """Start the compiled program."""
        self.use("fire")
        if not self._is_armed or self._compiled is None:
            raise DeviceError(self.name, "fire() needs arm()")
        self._is_armed = False
        self.programs.append(self._compiled)
        self._apply_lines(self._compiled)
        self._over_s = self.clock.now() + self._compiled.duration_s

    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program."""
        self.use("wait", timeout_s)
        left_s = self._over_s - self.clock.now()
        self.clock.sleep(max(0.0, min(left_s, timeout_s)))
        if left_s > timeout_s:
            raise DeviceTimeoutError(self.name, f"it still runs after {timeout_s} s", timeout_s)

    def _apply_lines(self, program: LineProgram) -> None:
        if self.simulation is not None:
            self.simulation.play(self.name, program, self.clock.now())


class RecordingDevice(RecordingHardware, Device):
    """An instrument whose commands only set ``values["state"]``.

    Attributes:
        commands: Known commands.
        values: Values that can be read.
    """

    def __init__(
        self,
        context: Context | None = None,
        calls: Calls | None = None,
        *,
        commands: tuple[str, ...] = ("on", "off"),
        **faults: Any,
    ) -> None:
        super().__init__(context, calls, **faults)
        self.commands = commands
        self.values: dict[str, Any] = {"state": "off"}

    def check_command(self, name: str, **arguments: Any) -> None:  # noqa: ARG002 - takes any
        """Refuse an unknown command."""
        if name not in self.commands:
            raise unknown_name(self.name, "command", name, self.commands)

    def command(self, name: str, **arguments: Any) -> None:
        """Carry out a command."""
        self.use("command", name, **arguments)
        self.check_command(name)
        self.values["state"] = name

    def read(self, name: str) -> Any:
        """Return a value."""
        self.use("read", name)
        if name not in self.values:
            raise unknown_name(self.name, "value", name, tuple(self.values))
        return self.values[name]


class RecordingLeader(RecordingDevice):
    """An external control system that sends `go` some time after wait_for(), and records the answers.

    Attributes:
        goes_after_s: Time after wait_for(), in seconds.
        answers: The state reported for each `go`, with its details that are numbers and text.
        noted: Events that new_events() returns once.
    """

    role: ClassVar[str] = "leader"
    deadline_s = 10.0

    def __init__(self, context: Context | None = None, calls: Calls | None = None, **faults: Any) -> None:
        super().__init__(context, calls, **faults)
        self.goes_after_s = 0.5
        self.answers: list[tuple[str, dict[str, Any]]] = []
        self.noted: list[str] = []
        self._n_gos = 0
        self._answer_due = False

    def wait_for(self, signal: str, timeout_s: float) -> str:
        """Wait, then count the signals: "1", "2", ..."""
        self.use("wait_for", signal, timeout_s)
        self.clock.sleep(min(self.goes_after_s, timeout_s))
        if self.goes_after_s > timeout_s:
            raise DeviceTimeoutError(self.name, f"no '{signal}' within {timeout_s} s", timeout_s)
        self._answer_due = True
        self._n_gos += 1
        return str(self._n_gos)

    def report(self, state: Literal["ready", "failed"], about: Mapping[str, Any]) -> str:
        """Record the answer, if one is due."""
        self.use("report", state)
        if not self._answer_due:
            return ""
        self._answer_due = False
        plain = {key: value for key, value in about.items() if key not in ("record", "target", "start_s")}
        self.answers.append((state, plain))
        return state

    def new_events(self) -> Sequence[str]:
        """The events since the last call."""
        noted, self.noted = self.noted, []
        return noted
