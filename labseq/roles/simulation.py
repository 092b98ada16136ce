"""The role of the simulated world, and what it may offer beyond it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol, TypeAlias, runtime_checkable

from numpy.typing import NDArray

from labseq.model import (
    DepthRamp,
    Frame,
    LineProgram,
    Occupancy,
    RfSpan,
    SensorMode,
    ToneProgram,
    TweezerAmplitudes,
)

Signal: TypeAlias = ToneProgram | DepthRamp | TweezerAmplitudes | LineProgram
"""What devices play on a simulated world."""

WHOLE_SENSOR: Final = SensorMode()
"""What a camera does that sets nothing: the whole sensor, the simulation's own gain."""


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

    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        """A device's output, from ``t_start_s`` on.

        Args:
            role: "mobile_tweezers", which plays a ``ToneProgram``; "static_tweezers": ``DepthRamp`` or
                ``TweezerAmplitudes``; "lines": ``LineProgram``.
            signal: What it plays.
            t_start_s: When it begins, on the session's clock.
        """
        ...

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        """The frame that a camera sees; imaging light is on.

        Args:
            t_start_s: Start of the exposure on the session's clock.
            exposure_s: Exposure time.
            mode: How the camera exposes and reads its sensor.
        """
        ...

    def describe(self) -> Mapping[str, Any]:
        """Every constant of the model: JSON-ready values."""
        ...


@runtime_checkable
class ReportsSensor(Protocol):
    """A simulation that tells of the sensor that its frames come from, before anything is opened."""

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """(height, width) in pixels of the sensor."""
        ...

    def readout_fraction(self, mode: SensorMode) -> float:
        """Time to read a frame, relative to that of the whole sensor without binning."""
        ...

    def prepare_sensor(self, mode: SensorMode) -> None:
        """Work out what all frames of a mode have in common, before a run."""
        ...


@runtime_checkable
class WiresTriggers(Protocol):
    """A simulation in which an edge of a line reaches the trigger input that it is wired to."""

    def wire(self, role: str, on_edge: Callable[[float], object]) -> None:
        """Tell a device of the edges of the line that triggers its role, from now on.

        Args:
            role: "camera".
            on_edge: Called with the time of the edge on the session's clock, by whoever fires the lines.
        """
        ...


@runtime_checkable
class ReportsLoading(Protocol):
    """A simulation that tells how well it loads, for estimates before a run."""

    @property
    def loading_probability(self) -> float:
        """Probability that a site holds an atom after loading."""
        ...


@runtime_checkable
class ReportsTruth(Protocol):
    """A simulation that knows, and tells for the record, where the atoms really are."""

    def truth(self) -> Occupancy:
        """The true occupancy now, bool (n_rows, n_cols)."""
        ...


@runtime_checkable
class ReportsLosses(Protocol):
    """A simulation that knows, and tells for the record, what atoms were lost by."""

    def losses(self) -> Mapping[str, int]:
        """Atoms lost since the shot began: cause -> number."""
        ...


@runtime_checkable
class ReportsEvents(Protocol):
    """A simulation that tells, for the record, what happened to the atoms."""

    def atom_events(self, since_s: float) -> Mapping[str, NDArray[Any]]:
        """What happened since the shot began: name -> structured array, with a field for each column.

        A dtype with ``metadata={"descriptions": {column: text}}`` takes its texts into the shot's file.

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


class ToneSource(Protocol):
    """The two outputs of a simulated device that drives the static tweezers."""

    def played(self, until_s: float) -> Sequence[TweezerAmplitudes]:
        """What the amplitudes of the tones were since the last call, in time's order; nothing if unchanged.

        A depth is part of them: at half the depth the amplitudes of rows and columns are lower. They are 0
        before the first call.

        Args:
            until_s: Time on the session's clock at which to stop for now.
        """
        ...


@runtime_checkable
class ReceivesOutput(Protocol):
    """A simulation that acts on what a device's outputs really play, rather than on what it is told."""

    def warm(self) -> None:
        """Compile the kernels for that; a driver that will be listened to calls it in its own ``warm``."""
        ...

    def connect_outputs(self, role: str, source: RfSource | ToneSource) -> None:
        """From now on listen to these outputs of a role, in the place of earlier ones.

        Args:
            role: "mobile_tweezers", with an ``RfSource``, or "static_tweezers", with a ``ToneSource``.
            source: Its outputs.
        """
        ...
