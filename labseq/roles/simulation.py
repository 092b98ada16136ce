"""The role of the simulated world, and what it may offer beyond it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray

from labseq.model import (
    DepthRamp,
    Frame,
    Occupancy,
    RfSpan,
    ToneProgram,
    TweezerAmplitudes,
)


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

    def play(self, role: str, signal: ToneProgram | DepthRamp | TweezerAmplitudes, t_start_s: float) -> None:
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
class LossTeller(Protocol):
    """A simulation that knows, and tells for the record, what atoms were lost by."""

    def losses(self) -> Mapping[str, int]:
        """Atoms lost since the shot began: cause -> number."""
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
