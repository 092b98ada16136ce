"""In-memory devices of every hardware role; they note what they are asked to do."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError, DeviceTimeoutError, one_of
from labseq.lines import idle_program, off_program
from labseq.model import DepthRamp, Frame, LineProgram, ToneProgram
from labseq.roles import Context, Trigger
from labseq.testing.fakes.base import RecordingHardware, require_within
from labseq.testing.fakes.calls import Calls, Failure, Hang

MAX_EXPOSURE_S: Final = 10.0
BAND_HZ: Final = (50e6, 150e6)


class RecordingCamera(RecordingHardware):
    """A camera whose frame k is full of k: uint16 (16, 16)."""

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
        require_within("the exposure in seconds", exposure_s, 1e-6, MAX_EXPOSURE_S)
        if trigger != "software":
            raise DeviceError(self.name, f"has no {trigger} trigger; expected 'software'")
        self.reset()
        self._n_left, self._exposure_s = n_frames, exposure_s

    def trigger(self) -> None:
        """Take the next frame; it can be read at the end of its exposure."""
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


class RecordingStaticTweezers(RecordingHardware):
    """Static tweezers that only know their depth.

    Attributes:
        depth: Fraction of the nominal depth, now.
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

    def _go(self, depth: float, duration_s: float) -> None:
        if self.simulation is not None:
            ramp = DepthRamp(self.depth, depth, duration_s)
            self.simulation.play(self.name, ramp, self.clock.now())
        self.clock.sleep(duration_s)
        self.depth = depth


class RecordingMobileTweezers(RecordingHardware):
    """Mobile tweezers that keep the programs they were given.

    Attributes:
        programs: Every program that was prepared, in order.
    """

    role: ClassVar[str] = "mobile_tweezers"

    def __init__(self, context: Context | None = None, calls: Calls | None = None, **faults: Any) -> None:
        super().__init__(context, calls, **faults)
        self.programs: list[ToneProgram] = []
        self.reset()

    def reset(self) -> None:
        """Silence."""
        self._prepared: ToneProgram | None = None
        self._end_s = float("nan")

    def prepare(self, program: ToneProgram) -> float:
        """Check a program against the limits and keep it."""
        self.use("prepare", program)
        for axis in (program.row, program.column):
            for frequency in (*axis.start_hz, *axis.end_hz):
                require_within("a tone's frequency in Hz", float(frequency), *BAND_HZ)
            for amplitude in (*axis.start_amplitude, *axis.end_amplitude):
                require_within("a tone's amplitude", float(amplitude), 0.0, 1.0)
        self._prepared = program
        self.programs.append(program)
        return program.total_duration_s

    def play(self) -> None:
        """Start what was prepared."""
        self.use("play")
        if self._prepared is None:
            raise DeviceError(self.name, "play() needs prepare()")
        start_s = self.clock.now()
        if self.simulation is not None:
            self.simulation.play(self.name, self._prepared, start_s)
        self._end_s = start_s + self._prepared.total_duration_s

    def wait(self, timeout_s: float) -> None:
        """Wait for its end."""
        self.use("wait", timeout_s)
        if np.isnan(self._end_s):
            raise DeviceError(self.name, "wait() needs play()")
        left_s = self._end_s - self.clock.now()
        if left_s > timeout_s:
            self.clock.sleep(timeout_s)
            raise DeviceTimeoutError(self.name, f"it still plays after {timeout_s} s", timeout_s)
        self.clock.sleep(max(0.0, left_s))


class RecordingLines(RecordingHardware):
    """A timing box whose programs take their time, and that tells the simulation of them.

    Attributes:
        programs: Every program that was fired, in order.
    """

    role: ClassVar[str] = "lines"

    def __init__(self, context: Context | None = None, calls: Calls | None = None, **faults: Any) -> None:
        super().__init__(context, calls, **faults)
        self.programs: list[LineProgram] = []
        self._specs = () if context is None else context.lines
        self.reset()

    def open(self) -> None:
        """Idle."""
        super().open()
        self._apply_lines(idle_program(self._specs))

    def safe_state(self) -> None:
        """All off."""
        super().safe_state()
        if self.is_open:
            self._apply_lines(off_program(self._specs))

    def reset(self) -> None:
        """Nothing compiled, nothing armed."""
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
        """Start what was compiled."""
        self.use("fire")
        if not self._is_armed or self._compiled is None:
            raise DeviceError(self.name, "fire() needs arm()")
        self._is_armed = False
        self.programs.append(self._compiled)
        self._apply_lines(self._compiled)
        self._over_s = self.clock.now() + self._compiled.duration_s

    def wait(self, timeout_s: float) -> None:
        """Wait for its end."""
        self.use("wait", timeout_s)
        left_s = self._over_s - self.clock.now()
        self.clock.sleep(max(0.0, min(left_s, timeout_s)))
        if left_s > timeout_s:
            raise DeviceTimeoutError(self.name, f"it still runs after {timeout_s} s", timeout_s)

    def _apply_lines(self, program: LineProgram) -> None:
        if self.simulation is not None:
            self.simulation.play(self.name, program, self.clock.now())


class RecordingDevice(RecordingHardware):
    """An instrument whose commands do nothing but set ``values["state"]``.

    Attributes:
        commands: The commands that it knows.
        values: What it can be asked for.
    """

    def __init__(
        self,
        context: Context | None = None,
        calls: Calls | None = None,
        *,
        commands: tuple[str, ...] = ("on", "off"),
        fail_on: Mapping[str, Failure] | None = None,
        hang_on: Mapping[str, Hang] | None = None,
    ) -> None:
        super().__init__(context, calls, fail_on=fail_on, hang_on=hang_on)
        self.commands = commands
        self.values: dict[str, Any] = {"state": "off"}

    def command(self, name: str, **arguments: Any) -> None:
        """Carry out a command."""
        self.use("command", name, **arguments)
        if name not in self.commands:
            raise DeviceError(self.name, f"unknown command '{name}'; expected {one_of(self.commands)}")
        self.values["state"] = name

    def read(self, name: str) -> Any:
        """Give a value."""
        self.use("read", name)
        if name not in self.values:
            known = one_of(tuple(self.values))
            raise DeviceError(self.name, f"unknown value '{name}'; expected {known}")
        return self.values[name]
