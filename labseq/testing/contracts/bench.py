"""Where the suites of hardware roles put a device: making it, opening it, its states, its failures."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import ClassVar, Generic, TypeAlias, TypeVar

import pytest

from labseq.model import SiteGrid
from labseq.roles import Context, Hardware
from labseq.testing.contracts.promises import CallHungError, in_time, no_factory
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation

D = TypeVar("D", bound=Hardware)
Factory: TypeAlias = Callable[[Context], D]
Action: TypeAlias = Callable[[D], object]


@dataclass(frozen=True, slots=True)
class Wait(Generic[D]):
    """A wait for something that does not come within its timeout.

    Attributes:
        timeout_s: The timeout, in seconds.
        enter: Brings an open device to where it can wait.
        wait: The call, with that timeout.
    """

    timeout_s: float
    enter: Action[D]
    wait: Action[D]


class HardwareContractBase(Generic[D]):
    """What the suites of all hardware roles are told by the suite of one, and where they put a device.

    Attributes:
        role: Name that the device has in the profile.
        max_wait_s: Real time after which a call counts as hung, in seconds.
    """

    role: ClassVar[str] = "device"
    max_wait_s: ClassVar[float] = 10.0

    @pytest.fixture
    def factory(self) -> Factory[D]:
        """Constructs the device, given a context; provided by the plugin's test."""
        no_factory(self, "context -> device")

    def context(self) -> Context:
        """What the device is constructed with; override it for another grid or simulation.

        Keep the clock virtual: then waiting for a timeout costs no time.
        """
        clock = FakeClock()
        return Context(self.role, SiteGrid(), clock=clock, simulation=RecordingSimulation(Calls(clock)))

    def work(self, device: D) -> None:
        """What the role does in a shot, once; the device is open."""

    def ready(self, device: D) -> None:
        """What comes before any work; the device is open."""

    def uses(self) -> Mapping[str, Action[D]]:
        """Calls of the role that need an open device: description -> call."""
        return {}

    def states(self) -> Mapping[str, Action[D]]:
        """States of an open device: description -> how to get there."""
        return {}

    def excesses(self) -> Mapping[str, Action[D]]:
        """Calls that ask for more than any device can do: description -> call."""
        return {}

    def waits(self) -> Mapping[str, Wait[D]]:
        """Waits in vain: description -> wait."""
        return {}

    @contextmanager
    def made(self, factory: Factory[D]) -> Generator[tuple[D, Context]]:
        """A new device, not opened, with its context; closed at the end, whatever has become of it."""
        context = self.context()
        device = factory(context)
        try:
            yield device, context
        finally:
            close_quietly(device)

    @contextmanager
    def opened(self, factory: Factory[D]) -> Generator[tuple[D, Context]]:
        """A new device, opened, with its context; closed at the end."""
        with self.made(factory) as (device, context):
            if context.simulation is not None:
                context.simulation.open()
            begin_shot(context)
            device.open()
            yield device, context

    @contextmanager
    def each_state(self, factory: Factory[D]) -> Generator[Iterator[tuple[str, D, Context]]]:
        """A device in each of its states: (state, device, context).

        It is one device from state to state, and a new one only where that cannot get there.
        """
        with ExitStack() as stack:

            def states() -> Iterator[tuple[str, D, Context]]:
                device, context = stack.enter_context(self.opened(factory))
                for state, enter in {"after open()": _stay, **self.states()}.items():
                    try:
                        enter(device)
                    except Exception:  # noqa: BLE001 - that the last state is left rightly has tests of its own
                        stack.close()
                        device, context = stack.enter_context(self.opened(factory))
                        enter(device)
                    yield state, device, context

            yield states()

    def failures(self) -> Iterator[Mapping[str, Action[D]]]:
        """Every way in which the suite makes an open device fail, in groups for one device each."""

        def waiting(wait: Wait[D]) -> Action[D]:
            return lambda device: (wait.enter(device), wait.wait(device))

        yield self.excesses()
        for what, wait in self.waits().items():
            yield {what: waiting(wait)}

    def call_in_time(self, context: Context, what: str, call: Callable[..., object], *args: object) -> None:
        """A call that must come back; one that polls the clock for ever is ended by it."""
        try:
            in_time(self.max_wait_s, what, call, *args)
        except CallHungError:
            if isinstance(context.clock, FakeClock):
                context.clock.stop.request()
            raise


def close_quietly(device: Hardware) -> None:
    """Whatever the test has found; what close() promises has tests of its own."""
    with suppress(Exception):
        device.close()


def _stay(device: object) -> None:
    """A device that was opened is in that state already."""
    del device


def begin_shot(context: Context) -> None:
    """As the sequencer begins one, where there is a simulated world."""
    if context.simulation is not None:
        context.simulation.begin_shot()


def n_calls(context: Context) -> int:
    """How often the simulation was called; 0 for one that does not note it."""
    simulation = context.simulation
    return len(simulation.calls) if isinstance(simulation, RecordingSimulation) else 0
