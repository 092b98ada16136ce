"""The roles of hardware."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from labseq.model import CameraFacts, Frame, LineProgram, LinesFacts, ToneProgram

Trigger = Literal["software", "internal", "external"]


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


@runtime_checkable
class HasSelfTest(Protocol):
    """A device that can tell whether it works, for ``labseq devices``."""

    def self_test(self) -> None:
        """Check what can be checked without harm: no light, nothing that moves; the device is open.

        Raises:
            DeviceError: With what is wrong.
        """
        ...


@runtime_checkable
class NeedsSettling(Protocol):
    """A device that needs time after ``open()`` until it works as it shall: a camera that cools."""

    @property
    def settling_timeout_s(self) -> float:
        """How long that may take, in seconds; 0 if there is nothing to wait for."""
        ...

    def settle(self) -> None:
        """Wait for it on the session's clock; all devices are open.

        Raises:
            DeviceTimeoutError: It takes longer than it may.
        """
        ...


@runtime_checkable
class HasReadings(Protocol):
    """A device some of whose values are read at the start of each shot and kept with it."""

    def poll(self) -> Mapping[str, bool | int | float | str]:
        """Name -> value; they stand among the shot's readings as "device.name"."""
        ...


@runtime_checkable
class Interlocked(Protocol):
    """A device that tells when something is so far off that no atom may be picked up."""

    def check_interlocks(self) -> None:
        """Read what is watched; asked at the start of each shot and before each pick-up.

        Raises:
            DeviceError: A value is past its limit; the run ends safely.
        """
        ...


@runtime_checkable
class LeaderLink(Protocol):
    """A device through which another control system leads: it says `go`, and is told what came of it.

    For each `go` it gets exactly one answer, `ready` or `failed`, within the device's deadline, whatever
    becomes of the shot: the device answers by itself where labseq does not in time.
    """

    @property
    def deadline_s(self) -> float:
        """Longest time from a signal to its answer, in seconds."""
        ...

    def wait_for(self, signal: str, timeout_s: float) -> str:
        """Wait for a signal on the session's clock, and tell the leader that labseq is busy from now on.

        A signal that came since the last answer counts. Looks for a stop request at least every 50 ms.

        Args:
            signal: "go".
            timeout_s: How long to wait, in seconds.

        Returns:
            What the leader said with it; "" if nothing.

        Raises:
            DeviceTimeoutError: It did not come in time.
            StopRequested: The operator asked the run to stop.
        """
        ...

    def report(self, state: Literal["ready", "failed"], about: Mapping[str, bool | int | float | str]) -> str:
        """Answer the signal that was waited for; without one, nothing is said.

        Args:
            state: What came of it.
            about: "shot"; of one that is ready and was judged, "success" and "filling" (of the target, 0 to
                1); of a failure its "reason".

        Returns:
            What the leader was told: "ready", "failed"; "late" if it was told of a failure when the deadline
            passed; "gone" if it is not there any more; "" if it is owed nothing.
        """
        ...

    def new_events(self) -> Sequence[str]:
        """What happened since the last call, for the log: who came and went, what was not understood."""
        ...


@runtime_checkable
class ChecksCommands(Protocol):
    """A device that knows its commands before it is opened, for ``labseq check`` and the start of a run."""

    def check_command(self, name: str, **arguments: Any) -> None:
        """Check a command and its arguments; nothing is sent.

        Raises:
            DeviceError: It has no such command, or other arguments.
            LimitError: An argument is past its limit.
        """
        ...


class Camera(Hardware, Protocol):
    """Takes frames, in series.

    Its ``safe_state`` ends the acquisition, closes the shutter and sets the EM gain to 1.
    """

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """Get ready for a series of ``n_frames`` exposures; the internal trigger starts them at once."""
        ...

    def trigger(self) -> None:
        """Start the next exposure of the series (software trigger); returns at once."""
        ...

    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame not yet read.

        Raises:
            DeviceTimeoutError: No frame came within ``timeout_s``.
            TransientError: A frame of the series was lost; a repeated shot may mend it.
        """
        ...


@runtime_checkable
class ReportsCameraFacts(Protocol):
    """A camera that tells its limits before it is opened, for ``labseq check`` and budgets."""

    @property
    def facts(self) -> CameraFacts:
        """Read-out time, longest exposure, shape of its frames, EM gain, triggers."""
        ...


class StaticTweezers(Hardware, Protocol):
    """The static array."""

    def load(self, amplitudes: tuple[NDArray[np.float64], NDArray[np.float64]] | None) -> None:
        """Set the tone amplitudes of the rows (n_rows,) and columns (n_cols,).

        Fractions of full scale; None stands for the calibrated ones.
        """
        ...

    def start(self) -> None:
        """Bring the array to its nominal depth, from off or after a ramp; no effect if it is there.

        Each shot begins with it.
        """
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


@runtime_checkable
class ReportsTimings(Protocol):
    """Mobile tweezers that tell how long the parts of their last ``prepare()`` took."""

    def timings(self) -> Mapping[str, float]:
        """Name of a part ("render", "upload") -> seconds on this computer's clock; no I/O."""
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
    """The timing box that switches light and sends triggers; ``context.lines`` says what is wired to it.

    Between steps the lines are idle: on where :data:`labseq.model.lines.IDLE` says so. ``open()``
    puts them there, ``safe_state`` turns all of them off.
    """

    def compile(self, program: LineProgram) -> None:
        """Take a program for the next firing; one that it knows already costs no time.

        Raises:
            LimitError: More edges, or nearer to one another, than the box can make.
        """
        ...

    def arm(self) -> None:
        """Get ready to fire what was compiled last."""
        ...

    def fire(self) -> None:
        """Start the program; returns at once."""
        ...

    def wait(self, timeout_s: float) -> None:
        """Wait for its end.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
            DeviceError: The box did something else, for example a reset.
        """
        ...


@runtime_checkable
class ReportsLinesFacts(Protocol):
    """A timing box that tells its limits before it is opened, for ``labseq check``."""

    @property
    def lines_facts(self) -> LinesFacts:
        """Channels, edges, resolution."""
        ...
