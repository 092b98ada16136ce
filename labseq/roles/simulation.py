"""The role of the simulation that virtual drivers and simulated devices act on."""

from __future__ import annotations

from abc import ABC, abstractmethod
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
from labseq.model.grid import PAPERS_LOADING

Signal: TypeAlias = ToneProgram | DepthRamp | TweezerAmplitudes | LineProgram
"""The output of a device that the simulation acts on."""

WHOLE_SENSOR: Final = SensorMode()
"""Default mode, with the whole sensor and the simulation's own gain."""


class Simulation(ABC):
    """The atoms, tweezers and light of a simulated lab. A run has one, opened before the devices.

    Methods with a default are optional, as in :mod:`labseq.roles.hardware`.
    """

    @abstractmethod
    def open(self) -> None:
        """Draw the static disorder of the machine, such as unequal tweezer depths."""

    @abstractmethod
    def close(self) -> None:
        """Discard the state of the simulation."""

    @abstractmethod
    def begin_shot(self) -> None:
        """Remove all atoms. Called after the random stream was set to the shot."""

    @abstractmethod
    def load(self, t_start_s: float, duration_s: float) -> None:
        """Load every site whose static tweezer is on, while the atom source is on."""

    @abstractmethod
    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        """Receive the output of a device that begins at ``t_start_s``.

        Args:
            role: "mobile_tweezers" for a ``ToneProgram``, "static_tweezers" for ``DepthRamp`` or
                ``TweezerAmplitudes``, or "lines" for a ``LineProgram``.
            signal: The output.
            t_start_s: Start of the output on the session's clock.
        """

    @abstractmethod
    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        """The frame of a camera exposed while imaging light is on.

        Args:
            t_start_s: Start of the exposure on the session's clock.
            exposure_s: Exposure time.
            mode: How the camera exposes and reads its sensor.
        """

    @abstractmethod
    def describe(self) -> Mapping[str, Any]:
        """Every constant of the model, as JSON-ready values."""

    @property
    def sensor_shape(self) -> tuple[int, int] | None:
        """(height, width) in pixels of the sensor, also before ``open()``. None if it has no sensor."""
        return None

    def warm(self) -> None:
        """Import every kernel that a shot needs, before ``open()``. labseq then compiles or loads them."""

    def warnings(self) -> Sequence[str]:
        """Warnings for ``labseq check`` and runs, such as settings beyond the range of the model."""
        return ()

    def readout_fraction(self, mode: SensorMode) -> float:
        """Time to read a frame, relative to the whole sensor without binning."""
        del mode
        return 1.0

    def prepare_sensor(self, mode: SensorMode) -> None:
        """Compute, before a run, the values that all frames of a mode share."""

    def seen_by(self, camera: str) -> Simulation:
        """The view of this simulation by a camera other than the camera of the atoms.

        Args:
            camera: Name of the camera among the profile's devices.

        Returns:
            Its own view of this simulation, in which ``expose`` and the methods about the sensor differ.
        """
        del camera
        return self

    def wire(self, role: str, on_pulse: Callable[[float, float], object]) -> None:
        """Pass the pulses of the line that triggers a role to its simulated device, from now on.

        Args:
            role: "camera" or "mobile_tweezers".
            on_pulse: Called by the device that fires the lines, for all pulses of a program in order of time,
                with the time of switching on, on the session's clock, and the duration, in seconds.
        """

    @property
    def loading_probability(self) -> float | None:
        """Probability that a site holds an atom after loading, for estimates. None if unknown."""
        return None

    def truth(self) -> Occupancy | None:
        """The current true occupancy, bool (n_rows, n_cols), for the record. None if unknown."""
        return None

    def losses(self) -> Mapping[str, int]:
        """Atoms lost since the shot began, for the record, cause -> number."""
        return {}

    def atom_events(self, since_s: float) -> Mapping[str, NDArray[Any]]:
        """Events of the shot, for the record, name -> structured array with a field for each column.

        Texts in a dtype's ``metadata={"descriptions": {column: text}}`` are written to the shot's file.

        Args:
            since_s: Time on the session's clock from which times are counted.
        """
        del since_s
        return {}


def loading_of(simulation: Simulation | None) -> float:
    """Fraction of the sites that hold an atom after loading, from the simulation or else from the paper."""
    simulated = None if simulation is None else simulation.loading_probability
    return PAPERS_LOADING if simulated is None else simulated


class RfSource(Protocol):
    """The two outputs of a simulated device that drives the mobile tweezers."""

    def played(self, until_s: float) -> tuple[Sequence[RfSpan], Sequence[RfSpan]]:
        """The signals of the row output and the column output since the last call, in order of time.

        Args:
            until_s: Time on the session's clock at which to stop for now.
        """
        ...


class ToneSource(Protocol):
    """The two outputs of a simulated device that drives the static tweezers."""

    def played(self, until_s: float) -> Sequence[TweezerAmplitudes]:
        """The amplitudes of the tones since the last call, in order of time. Empty if unchanged.

        They include depth ramps, so they are lower at half the depth. They are 0 before the first call.

        Args:
            until_s: Time on the session's clock at which to stop for now.
        """
        ...


@runtime_checkable
class ReceivesOutput(Protocol):
    """A simulation that acts on the samples that a device outputs, not on the program it was given."""

    def warm(self) -> None:
        """Compile the kernels for output samples. A driver with such outputs calls it in its own ``warm``."""
        ...

    def connect_outputs(self, role: str, source: RfSource | ToneSource) -> None:
        """Receive these outputs of a role from now on, instead of earlier ones.

        Args:
            role: "mobile_tweezers", with an ``RfSource``, or "static_tweezers", with a ``ToneSource``.
            source: Its outputs.
        """
        ...
