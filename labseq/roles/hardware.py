"""The roles of hardware."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from labseq.model import (
    CameraFacts,
    Frame,
    TimelineEntry,
    ToneProgram,
)

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
class SelfTesting(Protocol):
    """A device that can tell whether it works, for ``labseq devices``."""

    def self_test(self) -> None:
        """Check what can be checked without harm: no light, nothing that moves; the device is open.

        Raises:
            DeviceError: With what is wrong.
        """
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
