"""The base classes of drivers, one for each role of hardware.

Every driver implements the abstract methods. The others are optional abilities, whose defaults do nothing.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError, DeviceError, Problem, one_of
from labseq.messages import clean, did_you_mean
from labseq.model import CameraFacts, Frame, LineProgram, LinesFacts, ToneProgram, TweezersFacts

LineTrigger = Literal["external", "external_start", "bulb"]
"""How a line starts exposures.

With "external" an edge at the trigger input starts each exposure. With "external_start" one edge starts the
series, and the camera times the exposures itself and ignores later edges. With "bulb" the camera exposes as
long as the input is on.
"""

Trigger = Literal["software", "internal", LineTrigger]
"""What starts an exposure: labseq, the camera's own clock, or a line."""


@dataclass(frozen=True, slots=True)
class Emergency:
    """How another process brings a device to its safe state after the run has died or hangs.

    The script is loaded by its path and may import the standard library and pyserial only. It defines
    ``off(**arguments) -> str``, which is idempotent, raises with the reason, and describes its action in a
    few words. It may also define ``prepare(**arguments)``, which only loads libraries.

    Attributes:
        script: A Python file next to the driver.
        arguments: JSON values known once the device is open, such as port, card, bytes or register values.
    """

    script: Path
    arguments: Mapping[str, Any]


class Hardware(ABC):
    """Base class of all hardware roles.

    Attributes:
        any_thread: Whether the vendor's library allows calls from different threads. By default each device
            has its own thread for all calls, and waking it takes 0.1 ms. If True, ``safe_state`` may be
            called while another call hangs.
    """

    any_thread: ClassVar[bool] = False

    @abstractmethod
    def open(self) -> None:
        """Connect and initialise. This is the first call that may do I/O.

        It turns no output on, because the watchdog learns only afterwards how to switch the device off.
        """

    @abstractmethod
    def close(self) -> None:
        """Disconnect. Legal in any state."""

    @abstractmethod
    def safe_state(self) -> None:
        """Make all outputs harmless. Idempotent and legal in any state."""

    def emergency(self) -> Emergency | None:
        """How another process brings this device to its safe state. Called right after ``open()``.

        None if it has no output to switch off.
        """
        return None

    @abstractmethod
    def describe(self) -> Mapping[str, Any]:
        """Model, serial number, firmware and current settings as JSON-ready values.

        Exports look up the SI units of the values of :meth:`poll` under "units", name -> unit.
        """

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of packages, libraries and firmware of the open device, for ``labseq devices``.

        Name -> the version found, and the versions that the driver was tried with, separated by ", ". Either
        is "" if there is none.
        """
        return {}

    @property
    def idle_output(self) -> str:
        """Output when nothing plays, in a few words for ``labseq check``. "" for no output."""
        return ""

    def check_settings(self) -> Mapping[str, Problem]:
        """Check settings against this computer, for example for a missing file. Returns setting -> problem.

        Called by ``labseq check`` and before a run's folder is made, without touching hardware.
        """
        return {}

    def warm(self) -> None:
        """Import every kernel that a shot needs, before ``open()``. labseq then compiles or loads them."""

    @property
    def settling_timeout_s(self) -> float:
        """Longest time that :meth:`settle` may take, in seconds. 0 if there is nothing to wait for."""
        return 0.0

    def settle(self) -> None:
        """Wait until the device is ready, for example until a camera is cold. All devices are open.

        Raises:
            DeviceTimeoutError: It is not ready after ``settling_timeout_s`` on the session's clock.
        """

    def self_test(self) -> None:
        """Check the open device without light and without moving anything, for ``labseq devices``.

        Raises:
            DeviceError: The device does not work. The message says why.
        """

    def poll(self) -> Mapping[str, bool | int | float | str]:
        """Read the values to record at the start of each shot. Each becomes the reading "device.name".

        If the driver's settings have a property ``polled`` with the names, a sequence can measure only these.
        """
        return {}

    def check_interlocks(self) -> None:
        """Read the watched values. Called at the start of each shot and before each pick-up of atoms.

        Raises:
            DeviceError: A value exceeds its limit. The run ends safely.
            ShotAbortedError: The external control system aborted the shot, which is repeated at the next
                `go`.
        """


class Camera(Hardware):
    """Takes frames, in series.

    Its ``safe_state`` ends the acquisition, closes the shutter and sets the EM gain to 1.
    """

    @property
    def facts(self) -> CameraFacts:
        """Read-out time, longest exposure, frame shape, EM gain and triggers. Known before ``open()``."""
        return CameraFacts()

    @abstractmethod
    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """Get ready for a series of ``n_frames`` exposures. The internal trigger starts them at once.

        With "bulb" ``exposure_s`` is how long the line will be on, which is not sent to the camera. A shot
        arms once for all its images with the same exposure time, for the most that it may need.
        """

    def disarm(self) -> None:
        """End the series, with EM gain 1 in case other light reaches the camera. Legal in any state."""

    @abstractmethod
    def trigger(self) -> None:
        """Start the next exposure of the series (software trigger). Returns at once."""

    @abstractmethod
    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame that has not been read yet.

        Raises:
            DeviceTimeoutError: No frame came within ``timeout_s``.
            TransientError: A frame of the series was lost. Repeating the shot may help.
        """


class StaticTweezers(Hardware):
    """The static tweezer array."""

    @property
    def facts(self) -> TweezersFacts:
        """Which controls, ramp timing and release of atoms the device offers. Known before ``open()``."""
        return TweezersFacts()

    @abstractmethod
    def load(self, amplitudes: tuple[NDArray[np.float64], NDArray[np.float64]] | None) -> None:
        """Set the tone amplitudes of the rows (n_rows,) and columns (n_cols,).

        Fractions of full scale. None means the calibrated amplitudes and weights. Called with amplitudes only
        if ``facts.control`` is "tones".
        """

    def load_weights(self, weights: NDArray[np.float64]) -> None:
        """Set the share of the light for each site, float64 (n_rows, n_cols).

        Only their ratios count. Called only if ``facts.control`` is "sites".
        """
        raise NotImplementedError("these static tweezers have no weight for each site")

    @abstractmethod
    def start(self) -> None:
        """Bring the array to its nominal depth, from off or after a ramp, unless it is there already.

        Each shot begins with it.
        """

    @abstractmethod
    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth linearly, to a fraction of the nominal depth.

        Raises:
            LimitError: The depth is out of range, or neither 0 nor 1 for tweezers without ``facts.ramps``.
        """

    def release(self, duration_s: float) -> float:
        """Turn the light off for a time that the device itself keeps, then on again at the same depth.

        One command to the device must do both, so that the light returns even if labseq is killed meanwhile,
        or the device makes itself safe. Called only if ``facts.shortest_release_s`` is finite.

        Returns:
            The time without light, in seconds. Returns when it is over.
        """
        raise NotImplementedError("these static tweezers cannot release atoms")

    def leave_on(self) -> bool:
        """Disconnect and leave the light on after a complete run, if the profile asks for it.

        From then on ``safe_state`` and ``close`` have no effect, and no watchdog knows of the light. The next
        ``open()``, for example by ``labseq safe``, must be able to switch it off.

        Returns:
            Whether the light was left on. If not, or if this fails, ``safe_state`` and ``close`` follow.
        """
        return False


class MobileTweezers(Hardware):
    """The mobile tweezers."""

    @property
    def waits_for_trigger(self) -> bool:
        """True if ``play`` only arms the device, and an edge at its input starts it. Known before ``open()``.

        Drivers with this ability use it if ``trigger_line(context.lines, "mobile_tweezers")`` names a line.
        """
        return False

    def warnings(self) -> Sequence[str]:
        """Warnings for ``labseq check`` and runs, such as motion that the device can only approximate."""
        return ()

    def check_program(self, program: ToneProgram) -> None:
        """Check before opening, without sending anything, that ``prepare`` would accept a program.

        Raises:
            LimitError: The program exceeds a limit that the settings imply.
        """

    @abstractmethod
    def prepare(self, program: ToneProgram) -> float:
        """Render and upload a program without playing it.

        Returns:
            Playing time in seconds.

        Raises:
            LimitError: The program exceeds a limit of the device.
        """

    @abstractmethod
    def play(self) -> None:
        """Start playing the prepared program, or arm it for its trigger. Returns at once."""

    @abstractmethod
    def wait(self, timeout_s: float) -> None:
        """Wait until the program has been played to its end.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
        """

    @property
    def start_delay_s(self) -> float:
        """Time from ``play`` or the trigger to the first tones at the outputs. Known once open."""
        return 0.0

    @property
    def beginning_s(self) -> float:
        """Shortest playing time of a beginning whose rest can follow by :meth:`append`. inf for never.

        It is long enough to compute the rest meanwhile. Tones are off where a program is cut.
        """
        return math.inf

    def prepare_beginning(self, program: ToneProgram) -> float:
        """As :meth:`prepare`, for the beginning of a program. :meth:`append` follows right after ``play``."""
        raise NotImplementedError("these mobile tweezers take whole programs only")

    def append(self, program: ToneProgram) -> None:
        """Play the rest of a program right after its beginning, or after a pause if it comes too late.

        Raises:
            LimitError: It exceeds a limit of the device.
            TransientError: It came so late that it cannot be played.
        """
        raise NotImplementedError("these mobile tweezers take whole programs only")

    def timings(self) -> Mapping[str, float]:
        """Real time that each part of the last ``prepare()`` took, name -> seconds, for example "render".

        No I/O.
        """
        return {}


class Device(Hardware):
    """Any other instrument, such as a shutter, a laser controller or a synthesizer."""

    @abstractmethod
    def command(self, name: str, **arguments: Any) -> None:
        """Carry out one of the commands that the device declares."""

    @abstractmethod
    def read(self, name: str) -> Any:
        """Read one of the values that the device declares."""

    def check_command(self, name: str, **arguments: Any) -> None:
        """Check a command and its arguments before the device is opened, without sending anything.

        Raises:
            DeviceError: The device has no such command, or the command takes other arguments.
            LimitError: An argument exceeds its limit.
        """


class Lines(Hardware):
    """The timing box that switches light and sends triggers. ``context.lines`` names its wired channels.

    Between steps the lines are idle, which means on if :data:`labseq.model.lines.IDLE` says so. ``open()``
    leaves all of them off, as ``safe_state`` does.
    """

    @property
    def lines_facts(self) -> LinesFacts:
        """Channels, number of edges and resolution. Known before ``open()``."""
        return LinesFacts(())

    def check_program(self, program: LineProgram) -> None:
        """Check before opening, without sending anything, that ``compile`` would accept a program.

        Raises:
            LimitError: The program has more edges, or edges closer together, than the box can make.
        """

    @abstractmethod
    def idle(self) -> None:
        """Turn on the lines that are on between steps, and the others off. Called once, after ``open()``."""

    @abstractmethod
    def compile(self, program: LineProgram) -> None:
        """Compile a program for the next firing. A program that was compiled before takes no time.

        Raises:
            LimitError: The program has more edges, or edges closer together, than the box can make.
        """

    @abstractmethod
    def arm(self) -> None:
        """Get ready to fire the program compiled last."""

    @abstractmethod
    def fire(self) -> None:
        """Start the program. Returns at once."""

    @abstractmethod
    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
            DeviceError: The box failed, for example because it was reset.
        """


@runtime_checkable
class LeaderLink(Protocol):
    """A device or timing box through which another control system starts the shots of this run.

    The other system sends the signal `go` and gets exactly one answer to it, `ready` or `failed`, within
    the device's deadline. The device answers `failed` itself if labseq does not answer in time.
    """

    @property
    def deadline_s(self) -> float:
        """Longest time from a signal to its answer, in seconds."""
        ...

    def wait_for(self, signal: str, timeout_s: float) -> str:
        """Wait for a signal on the session's clock, then report to the other system that labseq is busy.

        A signal that arrived since the last answer counts. Checks for a stop request at least every 50 ms.

        Args:
            signal: "go".
            timeout_s: How long to wait, in seconds.

        Returns:
            The text that came with the signal, or "" if none.

        Raises:
            DeviceTimeoutError: It did not come in time.
            StopRequested: The operator asked the run to stop.
        """
        ...

    def report(self, state: Literal["ready", "failed"], about: Mapping[str, Any]) -> str:
        """Answer the start signal. Nothing is sent if there was none.

        Args:
            state: The outcome.
            about: Details. Always "shot", its "record" so far (``ShotRecord``), "start_s", from which the
                record's times count on the session's clock, and the "target". For a ready shot the folder of
                its "run" and the "file" in it, and if it was judged, "success" and "filling" (of the target,
                0 to 1). For a failure its "reason".

        Returns:
            The answer that the other system got, "ready" or "failed". "late" if a failure was reported when
            the deadline passed, "gone" if it has disconnected, "" if no answer was due.
        """
        ...

    def new_events(self) -> Sequence[str]:
        """Messages for the log since the last call, about connections and texts that were not understood."""
        ...


@runtime_checkable
class LeaderDialogue(LeaderLink, Protocol):
    """A link that also carries values for a shot, images, and steps and light of the other system."""

    @property
    def asks_for_light(self) -> bool:
        """Whether the other system turns the imaging light on when labseq asks for it."""
        ...

    def expect_values(self, check: Callable[[Mapping[str, str]], object]) -> None:
        """From now on, check values that the other system sends in advance with this function, or raise."""
        ...

    def take_values(self) -> Mapping[str, str]:
        """The values that it has sent for the shot that begins, address -> value as for ``--set``."""
        ...

    def take_turn(self, step: str, timeout_s: float, shot: int) -> str:
        """Let the other system do a step of its own. Returns the text with which it reports the end.

        Raises:
            TransientError: It is not connected, leaves, or does not report the end in time.
        """
        ...

    def light_on(self, exposure_s: float, shot: int) -> None:
        """Have it turn the imaging light on. Returns once the light is on.

        Raises:
            TransientError: As for a step.
        """
        ...

    def light_off(self, shot: int) -> None:
        """Have it turn the light off. ``check_interlocks`` waits for that, and raises in the end."""
        ...

    def report_image(self, about: Mapping[str, Any]) -> None:
        """Send an image if it wants them, as "shot", "image" (``ImageRecord``), "target", "start_s"."""
        ...


def leaders(devices: Mapping[str, object]) -> Iterator[tuple[str, LeaderLink]]:
    """Name and device of all devices and lines that can receive signals of another control system."""
    for name, device in devices.items():
        if isinstance(device, LeaderLink):
            yield name, device


def find_leader(devices: Mapping[str, object], name: str = "") -> tuple[str, LeaderLink]:
    """The device that receives the signal that a step waits for.

    Args:
        devices: All hardware of the profile.
        name: Name of the device. "" for the only one that can receive signals.

    Raises:
        ConfigError: This device cannot receive signals, no device can, or several can.
    """
    able = dict(leaders(devices))
    if name in able:
        return name, able[name]
    if name:
        fault = f"'{name}' cannot receive signals of another control system"
        raise ConfigError(Problem(fault, expected=one_of(list(able))) if able else fault)
    if not able:
        fault = "the profile has no device that receives signals of another control system"
        hint = (
            "add `leader: {use: tcp_leader}` to its `devices` (a full dry run simulates it and sends `go`, "
            "a fast dry run leaves it out)"
        )
        raise ConfigError(Problem(fault, hint=hint))
    if len(able) > 1:
        raise ConfigError(f"several devices receive signals; set `device` to {one_of(list(able))}")
    return next(iter(able.items()))


def unknown_name(device: str, kind: str, name: str, names: Sequence[str]) -> DeviceError:
    """The error of a device that has no such command or value.

    Args:
        device: Name of the device.
        kind: "command" or "value".
        name: The unknown name.
        names: The names that it knows.

    Example:
        >>> str(unknown_name("shutter", "command", "opne", ["open", "close"]))
        "shutter: unknown command 'opne'; expected one of 'open', 'close'; did you mean 'open'?"
    """
    message = f"unknown {kind} '{clean(name)}'; expected {one_of(names) if names else 'nothing, it has none'}"
    hint = did_you_mean(name, names)
    return DeviceError(device, f"{message}; {hint}" if hint else message)
