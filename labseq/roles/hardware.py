"""The roles of hardware: base classes of drivers.

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

"external": an edge at the trigger input starts each one. "external_start": one edge starts the series, in
which the camera times the exposures itself and ignores later edges. "bulb": the camera exposes as long as the
input is on."""

Trigger = Literal["software", "internal", LineTrigger]
"""What starts an exposure: labseq, the camera's own clock, or a line."""


@dataclass(frozen=True, slots=True)
class Emergency:
    """How another process brings a device to its safe state after the run has died or hangs.

    The script is loaded by its path and may import the standard library and pyserial only. It defines
    ``off(**arguments) -> str``, which is idempotent, raises with the reason, and returns in a few words what
    was done. It may also define ``prepare(**arguments)``, which loads libraries and leaves the device alone.

    Attributes:
        script: A Python file beside the driver.
        arguments: JSON values: port, card, bytes, register values, known once the device is open.
    """

    script: Path
    arguments: Mapping[str, Any]


class Hardware(ABC):
    """Base class of all hardware roles.

    Attributes:
        any_thread: Whether the vendor's library allows calls from different threads. By default each device
            has a thread of its own for all calls; waking it takes 0.1 ms. ``safe_state`` of a device
            that says True may be called while another call hangs.
    """

    any_thread: ClassVar[bool] = False

    @abstractmethod
    def open(self) -> None:
        """Connect and initialise; the first call that may do I/O.

        It turns no output on: the watchdog learns only afterwards how to switch the device off.
        """

    @abstractmethod
    def close(self) -> None:
        """Disconnect; legal in any state."""

    @abstractmethod
    def safe_state(self) -> None:
        """Make all outputs harmless; idempotent and legal in any state."""

    def emergency(self) -> Emergency | None:
        """How another process brings this device to its safe state; called right after ``open()``.

        None if it has no output to switch off.
        """
        return None

    @abstractmethod
    def describe(self) -> Mapping[str, Any]:
        """Model, serial number, firmware, current settings: JSON-ready values.

        Under "units", exports find the unit of each value that :meth:`poll` gives: name -> unit, in SI.
        """

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of packages, libraries and firmware of the open device, for ``labseq devices``.

        Each name -> the version found, and those that the driver was tried with, separated by ", "; "" where
        there is none.
        """
        return {}

    @property
    def idle_output(self) -> str:
        """What it puts out when nothing plays, in a few words for ``labseq check``; "" for nothing."""
        return ""

    def check_settings(self) -> Mapping[str, Problem]:
        """Setting -> what is wrong with it that a look at the computer shows, such as a missing file.

        Called by ``labseq check`` and before a run's folder is made, without touching hardware.
        """
        return {}

    def warm(self) -> None:
        """Import every kernel that a shot needs, before ``open()``; labseq then compiles or loads them."""

    @property
    def settling_timeout_s(self) -> float:
        """Longest time that :meth:`settle` may take, in seconds; 0 if there is nothing to wait for."""
        return 0.0

    def settle(self) -> None:
        """Wait until the device is ready, for example until a camera is cold; all devices are open.

        Raises:
            DeviceTimeoutError: It is not ready after ``settling_timeout_s`` on the session's clock.
        """

    def self_test(self) -> None:
        """Check the open device without light and without moving anything; for ``labseq devices``.

        Raises:
            DeviceError: The device does not work; says why.
        """

    def poll(self) -> Mapping[str, bool | int | float | str]:
        """Read the values to record at the start of each shot; each becomes the reading "device.name".

        If the driver's settings have a property ``polled`` with the names, a sequence cannot measure others.
        """
        return {}

    def check_interlocks(self) -> None:
        """Read the watched values; called at the start of each shot and before each pick-up of atoms.

        Raises:
            DeviceError: A value exceeds its limit; the run ends safely.
            ShotAbortedError: The external control system aborted the shot; it is repeated at the next `go`.
        """


class Camera(Hardware):
    """Takes frames, in series.

    Its ``safe_state`` ends the acquisition, closes the shutter and sets the EM gain to 1.
    """

    @property
    def facts(self) -> CameraFacts:
        """Read-out time, longest exposure, frame shape, EM gain and triggers; also before ``open()``."""
        return CameraFacts()

    @abstractmethod
    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """Get ready for a series of ``n_frames`` exposures; the internal trigger starts them at once.

        With "bulb" ``exposure_s`` is how long the line will be on, which is not sent to the camera.

        A shot arms once for all its images with the same exposure time, as many as it may need at most.
        """

    def disarm(self) -> None:
        """End the series, EM gain to 1: other light may reach the camera now; legal in any state."""

    @abstractmethod
    def trigger(self) -> None:
        """Start the next exposure of the series (software trigger); returns at once."""

    @abstractmethod
    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame that has not been read yet.

        Raises:
            DeviceTimeoutError: No frame came within ``timeout_s``.
            TransientError: A frame of the series was lost; repeating the shot may help.
        """


class StaticTweezers(Hardware):
    """The static tweezer array."""

    @property
    def facts(self) -> TweezersFacts:
        """What labseq can set, how ramps are timed, whether atoms can be released; also before ``open()``."""
        return TweezersFacts()

    @abstractmethod
    def load(self, amplitudes: tuple[NDArray[np.float64], NDArray[np.float64]] | None) -> None:
        """Set the tone amplitudes of the rows (n_rows,) and columns (n_cols,).

        Fractions of full scale; None means the calibrated ones, also of weights. Called with amplitudes only
        if ``facts.control`` is "tones".
        """

    def load_weights(self, weights: NDArray[np.float64]) -> None:
        """Set the share of the light that each site is to have, float64 (n_rows, n_cols).

        Only their ratios count. Called only if ``facts.control`` is "sites".
        """
        raise NotImplementedError("these static tweezers have no weight for each site")

    @abstractmethod
    def start(self) -> None:
        """Bring the array to its nominal depth, from off or after a ramp; no effect if it is there.

        Each shot begins with it.
        """

    @abstractmethod
    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth linearly, to a fraction of the nominal depth.

        Raises:
            LimitError: A depth that they cannot have; without ``facts.ramps`` any but 0 and 1.
        """

    def release(self, duration_s: float) -> float:
        """Turn the light off for a time that the device itself keeps, then on again at the same depth.

        One command to the device must do both: the light returns even if labseq is killed meanwhile, or the
        device makes itself safe. Called only if ``facts.shortest_release_s`` is finite.

        Returns:
            The time without light, in seconds; when it is over.
        """
        raise NotImplementedError("these static tweezers cannot release atoms")

    def leave_on(self) -> bool:
        """Disconnect and leave the light on, if the profile asks for it; after a run that took all its shots.

        From then on ``safe_state`` and ``close`` have no effect, and no watchdog knows of the light. The next
        ``open()``, as of ``labseq safe``, must be able to switch it off.

        Returns:
            Whether the light was left on; if not, or if this fails, ``safe_state`` and ``close`` follow.
        """
        return False


class MobileTweezers(Hardware):
    """The mobile tweezers."""

    @property
    def waits_for_trigger(self) -> bool:
        """Whether ``play`` only arms them, and an edge at their input starts them; also before ``open()``.

        Drivers that can do so do it if ``trigger_line(context.lines, "mobile_tweezers")`` names a line.
        """
        return False

    def warnings(self) -> Sequence[str]:
        """What ``labseq check`` and a run warn of, such as motion that the device can only approximate."""
        return ()

    def check_program(self, program: ToneProgram) -> None:
        """Refuse before the device is opened what ``prepare`` would refuse; nothing is sent.

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
        """Start playing the prepared program, or arm it for its trigger; returns at once."""

    @abstractmethod
    def wait(self, timeout_s: float) -> None:
        """Wait until the program has been played to its end.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
        """

    @property
    def start_delay_s(self) -> float:
        """Time from ``play``, or from the trigger, to the first tones at the outputs; known once open."""
        return 0.0

    @property
    def beginning_s(self) -> float:
        """Playing time after which a program can be cut and its rest follow by :meth:`append`; inf: never.

        It is long enough to make the rest meanwhile. Tones are off where a program is cut.
        """
        return math.inf

    def prepare_beginning(self, program: ToneProgram) -> float:
        """As :meth:`prepare`, for the beginning of a program; :meth:`append` follows right after ``play``."""
        raise NotImplementedError("these mobile tweezers take whole programs only")

    def append(self, program: ToneProgram) -> None:
        """Have the rest of a program follow what plays, at once, or after a pause if it comes too late.

        Raises:
            LimitError: It exceeds a limit of the device.
            TransientError: It came so late that it cannot be played.
        """
        raise NotImplementedError("these mobile tweezers take whole programs only")

    def timings(self) -> Mapping[str, float]:
        """Durations of the parts of the last ``prepare()``, such as "render": name -> seconds of real time.

        No I/O.
        """
        return {}


class Device(Hardware):
    """Any other instrument: a shutter, a laser controller, a synthesizer."""

    @abstractmethod
    def command(self, name: str, **arguments: Any) -> None:
        """Carry out one of the commands that the device declares."""

    @abstractmethod
    def read(self, name: str) -> Any:
        """Read one of the values that the device declares."""

    def check_command(self, name: str, **arguments: Any) -> None:
        """Check a command and its arguments before the device is opened; nothing is sent.

        Raises:
            DeviceError: The device has no such command, or the arguments differ.
            LimitError: An argument exceeds its limit.
        """


class Lines(Hardware):
    """The timing box that switches light and sends triggers; ``context.lines`` names its wired channels.

    Between steps the lines are idle: on where :data:`labseq.model.lines.IDLE` says so. ``open()``
    leaves all of them off, as ``safe_state`` does.
    """

    @property
    def lines_facts(self) -> LinesFacts:
        """Channels, number of edges and resolution; also before ``open()``."""
        return LinesFacts(())

    def check_program(self, program: LineProgram) -> None:
        """Refuse before the box is opened what ``compile`` would refuse; nothing is sent.

        Raises:
            LimitError: The program has more edges, or edges closer together, than the box can make.
        """

    @abstractmethod
    def idle(self) -> None:
        """Turn on the lines that are on between steps, and the others off; called once, after ``open()``."""

    @abstractmethod
    def compile(self, program: LineProgram) -> None:
        """Compile a program for the next firing; a program that was compiled before takes no time.

        Raises:
            LimitError: The program has more edges, or edges closer together, than the box can make.
        """

    @abstractmethod
    def arm(self) -> None:
        """Get ready to fire the program compiled last."""

    @abstractmethod
    def fire(self) -> None:
        """Start the program; returns at once."""

    @abstractmethod
    def wait(self, timeout_s: float) -> None:
        """Wait for its end.

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
            The text that came with the signal; "" if none.

        Raises:
            DeviceTimeoutError: It did not come in time.
            StopRequested: The operator asked the run to stop.
        """
        ...

    def report(self, state: Literal["ready", "failed"], about: Mapping[str, Any]) -> str:
        """Answer the start signal; nothing is sent if there was none.

        Args:
            state: The outcome.
            about: Details: "shot"; its "record" so far (``ShotRecord``), whose times count from "start_s" on
                the session's clock; the "target". For a ready shot the folder of its "run" and in it the
                "file" that it will be written to; if it was judged, "success" and "filling" (of the target,
                0 to 1). For a failure its "reason".

        Returns:
            The answer that the other system got: "ready", "failed"; "late" if a failure was reported when
            the deadline passed; "gone" if it has disconnected; "" if no answer was due.
        """
        ...

    def new_events(self) -> Sequence[str]:
        """Messages for the log since the last call: connections, and texts that were not understood."""
        ...


@runtime_checkable
class LeaderDialogue(LeaderLink, Protocol):
    """A link that carries more than edges: values for a shot, images, steps and light of the other system."""

    @property
    def asks_for_light(self) -> bool:
        """Whether the other system turns the imaging light on when it is asked to."""
        ...

    def expect_values(self, check: Callable[[Mapping[str, str]], object]) -> None:
        """From now on, check values that the other system sends in advance by this function, which raises."""
        ...

    def take_values(self) -> Mapping[str, str]:
        """The values that it has sent for the shot that begins: address -> value as for ``--set``."""
        ...

    def take_turn(self, step: str, timeout_s: float, shot: int) -> str:
        """Let the other system do a step of its own; returns the text with which it reports the end.

        Raises:
            TransientError: It is not connected, leaves, or does not report the end in time.
        """
        ...

    def light_on(self, exposure_s: float, shot: int) -> None:
        """Have it turn the imaging light on; returns once the light is on.

        Raises:
            TransientError: As for a step.
        """
        ...

    def light_off(self, shot: int) -> None:
        """Have it turn the light off. Until it has, ``check_interlocks`` waits, and raises at last."""
        ...

    def report_image(self, about: Mapping[str, Any]) -> None:
        """Tell an image if it has asked for that: "shot", "image" (``ImageRecord``), "target", "start_s"."""
        ...


def leaders(devices: Mapping[str, object]) -> Iterator[tuple[str, LeaderLink]]:
    """Name and device, of the devices or lines that can receive the signals of another control system."""
    for name, device in devices.items():
        if isinstance(device, LeaderLink):
            yield name, device


def find_leader(devices: Mapping[str, object], name: str = "") -> tuple[str, LeaderLink]:
    """The device that receives the signal that a step waits for.

    Args:
        devices: All hardware of the profile.
        name: Name of the device; "" for the only one that can receive signals.

    Raises:
        ConfigError: It cannot receive one, no device can, or several can.
    """
    able = dict(leaders(devices))
    if name in able:
        return name, able[name]
    if name:
        fault = f"no other control system leads through '{name}'"
        raise ConfigError(Problem(fault, expected=one_of(list(able))) if able else fault)
    if not able:
        fault = "the profile has no device through which another control system leads"
        hint = (
            "add one to its `devices`: `leader: {use: tcp_leader}`; in a full dry run it says `go` itself, "
            "in a fast one it is missing"
        )
        raise ConfigError(Problem(fault, hint=hint))
    if len(able) > 1:
        raise ConfigError(f"several devices lead; set `device` to {one_of(list(able))}")
    return next(iter(able.items()))


def unknown_name(device: str, kind: str, name: str, names: Sequence[str]) -> DeviceError:
    """The error of a device that has no such command or value.

    Args:
        device: Name of the device.
        kind: "command" or "value".
        name: The name that it does not know.
        names: What it has.

    Example:
        >>> str(unknown_name("shutter", "command", "opne", ["open", "close"]))
        "shutter: unknown command 'opne'; expected one of 'open', 'close'; did you mean 'open'?"
    """
    message = f"unknown {kind} '{clean(name)}'; expected {one_of(names) if names else 'none: it has none'}"
    hint = did_you_mean(name, names)
    return DeviceError(device, f"{message}; {hint}" if hint else message)
