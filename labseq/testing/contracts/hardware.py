"""Promises of all hardware roles."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, Generic, TypeAlias, TypeVar

import pytest

from labseq.errors import ConfigError, DeviceError, DeviceTimeoutError, LimitError
from labseq.model import LineSpec, SiteGrid
from labseq.roles import Context, Hardware
from labseq.testing.contracts.promises import (
    CallHungError,
    ContractViolation,
    calls_of_sleep,
    doing,
    format_error,
    in_time,
    no_factory,
    promise,
    promised,
    quietly,
    refusal,
)
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation

D = TypeVar("D", bound=Hardware)
Factory: TypeAlias = Callable[[Context], D]
Action: TypeAlias = Callable[[D], object]


@dataclass(frozen=True, slots=True)
class Wait(Generic[D]):
    """A wait that must end in a timeout.

    Attributes:
        timeout_s: The timeout, in seconds.
        enter: Brings an open device into the state for the wait.
        wait: The call with that timeout.
    """

    timeout_s: float
    enter: Action[D]
    wait: Action[D]


WORKS: Final = "factory(context) makes the device, and it can be opened, used as in a shot, and closed"
_HANGING: Final[set[type]] = set()
"""Classes of devices that hang at their work, so that the suite waits for each only once."""
USE_THE_CLOCK: Final = (
    "wait with context.clock (self._clock of a CameraDriver): first context.clock.sleep until the result is "
    "due, then labseq.plugin.wait_for if the device may be late. In tests and rehearsals the clock is "
    "virtual, and time.sleep or a blocking read of a library does not move it"
)
ALWAYS_SAFE: Final = "safe_state() is legal in every state, also twice"


class HardwareContract(Generic[D]):
    """Promises of every camera, tweezer driver and instrument.

    Inherit the suite of the role, not this one, and provide the fixture ``factory``. A role defines its
    calls, states and waits.

    Attributes:
        role: Name that the device has in the profile.
        how_it_works: What its methods must do, for the message when a device fails at its work.
        max_wait_s: Real time after which a call counts as hung, in seconds.
    """

    bases: ClassVar[tuple[str, ...]] = (WORKS, ALWAYS_SAFE)
    role: ClassVar[str] = "device"
    how_it_works: ClassVar[str] = ""
    max_wait_s: ClassVar[float] = 10.0

    @pytest.fixture
    def factory(self) -> Factory[D]:
        """Constructs the device from a context. Provided by the plugin's test."""
        no_factory(self, "context -> device")

    def context(self) -> Context:
        """Context of the device. Override it for another grid or simulation.

        Keep the clock virtual, so that waiting for a timeout costs no time.
        """
        clock = FakeClock()
        return Context(self.role, SiteGrid(), clock=clock, simulation=RecordingSimulation(Calls(clock)))

    def work(self, device: D) -> None:
        """Do the role's work in a shot once, with an open device."""

    def work_time_s(self) -> float:
        """Minimum time of the work on the context's clock, in seconds."""
        return 0.0

    def ready(self, device: D) -> None:
        """Do whatever the work requires first, with an open device."""

    def uses(self) -> Mapping[str, Action[D]]:
        """Calls of the role that need an open device, as description -> call."""
        return {}

    def states(self) -> Mapping[str, Action[D]]:
        """States of an open device, as description -> function that brings it there."""
        return {}

    def excesses(self) -> Mapping[str, Action[D]]:
        """Calls beyond the limits of any device, as description -> call."""
        return {}

    def waits(self) -> Mapping[str, Wait[D]]:
        """Waits that must time out, as description -> wait."""
        return {}

    @contextmanager
    def wired(
        self, factory: Factory[D], kind: str
    ) -> Generator[tuple[D | None, Context, Callable[[float], None]]]:
        """A new device, opened, that a line triggers in steps of a kind.

        Returns:
            The device (None if it refuses the line), its context, and a function that pulses the line,
            given its width in seconds.
        """
        context = self.context()
        simulation = RecordingSimulation(Calls(context.clock))
        line = LineSpec("trigger", 0, (kind,), triggers="camera" if kind == "image" else "mobile_tweezers")
        context = replace(context, simulation=simulation, lines=(line,))

        def pulse(width_s: float) -> None:
            simulation.pulse(self.role, context.clock.now(), width_s)

        with ExitStack() as stack:
            try:
                device, _ = stack.enter_context(self.opened(factory, context))
            except ConfigError:
                device = None
            yield device, context, pulse

    @contextmanager
    def made(self, factory: Factory[D], context: Context | None = None) -> Generator[tuple[D, Context]]:
        """A new device, not opened, with its context. Always closed at the end."""
        context = self.context() if context is None else context
        device = factory(context)
        try:
            yield device, context
        finally:
            close_quietly(device)

    @contextmanager
    def opened(self, factory: Factory[D], context: Context | None = None) -> Generator[tuple[D, Context]]:
        """A new device, opened, with its context. Closed at the end."""
        with self.made(factory, context) as (device, context):
            if type(device) in _HANGING:
                pytest.skip(f"cannot continue: promise: {WORKS}")
            if context.simulation is not None:
                context.simulation.open()
            begin_shot(context)
            device.open()
            yield device, context

    @contextmanager
    def each_state(self, factory: Factory[D]) -> Generator[Iterator[tuple[str, D, Context]]]:
        """A device in each of its states, as (state, device, context).

        The same device goes from state to state. If it cannot, a new device is made.
        """
        with ExitStack() as stack:

            def states() -> Iterator[tuple[str, D, Context]]:
                device, context = stack.enter_context(self.opened(factory))
                for state, enter in {"after open()": _stay, **self.states()}.items():
                    try:
                        enter(device)
                    except Exception:  # noqa: BLE001 - leaving a state is tested elsewhere
                        stack.close()
                        device, context = stack.enter_context(self.opened(factory))
                        enter(device)
                    yield state, device, context

            yield states()

    def failures(self) -> Iterator[Mapping[str, Action[D]]]:
        """Every way in which the suite makes an open device fail, in groups that share a device."""

        def waiting(wait: Wait[D]) -> Action[D]:
            return lambda device: (wait.enter(device), wait.wait(device))

        yield self.excesses()
        for what, wait in self.waits().items():
            yield {what: waiting(wait)}

    def call_in_time(self, context: Context, what: str, call: Callable[..., object], *args: object) -> None:
        """Make a call that must return. If it polls the clock for ever, the clock ends it."""
        try:
            in_time(self.max_wait_s, what, call, *args)
        except CallHungError:
            if isinstance(context.clock, FakeClock):
                context.clock.stop.request()
            raise

    @promise(WORKS)
    def test_works(self, factory: Factory[D]) -> None:
        """Do the role's work once. Nothing else can be tested without it."""
        try:
            close_quietly(factory(self.context()))
        except TypeError as error:
            advice = "the fixture 'factory' takes the context alone, as in partial(MyDriver, MySettings())"
            about_arguments = "argument" in str(error)
            detail = f"its constructor {format_error(error)}"
            raise ContractViolation(WORKS, detail, advice if about_arguments else "") from error
        with self.opened(factory) as (device, context):
            before_s, needed_s = context.clock.now(), self.work_time_s()
            detail, cause, advice = "", None, self.how_it_works
            try:
                self.call_in_time(context, "its work", self.work, device)
            except CallHungError as error:
                _HANGING.add(type(device))
                detail, cause = str(error), error
            except Exception as error:
                raise ContractViolation(WORKS, f"it {format_error(error)}", advice) from error
            passed_s = context.clock.now() - before_s
            if passed_s < needed_s:
                which = f"{passed_s:g} s passed on context.clock during work that takes {needed_s:g} s"
                detail, advice = f"{detail}, and {which}" if detail else which, USE_THE_CLOCK
            if detail:
                raise ContractViolation(WORKS, detail, advice) from cause
            device.close()

    @promise("the constructor does no I/O and changes no shared state")
    def test_constructor_does_no_io(self, factory: Factory[D]) -> None:
        """Nothing is opened, connected or started before open()."""
        context = self.context()
        device: D | None = None
        try:
            with quietly("open() is the place for that"):
                device = factory(context)
        finally:
            if device is not None:
                close_quietly(device)

    @promise("open() and close() twice do no harm, and a closed device can be opened again")
    def test_opens_and_closes_twice(self, factory: Factory[D]) -> None:
        """Open, open, close, close, and open again."""
        with self.opened(factory) as (device, _):
            for method in (device.open, device.close, device.close, device.open, device.close):
                with doing(f"{method.__name__}()"):
                    method()

    @promise("close() is legal before open()")
    def test_closes_before_open(self, factory: Factory[D]) -> None:
        """A run that fails while it opens its devices closes them all."""
        with self.made(factory) as (device, _):
            device.close()

    @promise(ALWAYS_SAFE)
    def test_safe_state_in_every_state(self, factory: Factory[D]) -> None:
        """Before open(), after it, in each state of the role, after close()."""
        with self.made(factory) as (device, _):
            _safe_twice(device, "before open()")
        with self.each_state(factory) as states:
            for state, device, _ in states:
                _safe_twice(device, state)
        with self.opened(factory) as (device, _):
            device.close()
            _safe_twice(device, "after close()")

    @promise("the device works in the next shot after safe_state()")
    def test_works_after_safe_state(self, factory: Factory[D]) -> None:
        """A shot that failed with TransientError is repeated without another open()."""
        with self.each_state(factory) as states:
            for state, device, context in states:
                with promised(ALWAYS_SAFE):
                    device.safe_state()
                begin_shot(context)
                with doing(f"work after safe_state() {state}"):
                    self.work(device)

    @promise("safe_state() and close() work after a failure")
    def test_closes_after_failures(self, factory: Factory[D]) -> None:
        """A failure must leave a device that can be made safe and closed."""
        for failures in self.failures():
            with self.opened(factory) as (device, context):
                what = "open()"
                for what, fail in failures.items():
                    try:
                        self.call_in_time(context, what, fail, device)
                    except CallHungError:  # timeouts have a test of their own
                        break
                    except Exception:  # noqa: BLE001, S110 - and so have errors
                        pass
                    with doing(f"safe_state() after {what}"):
                        device.safe_state()
                else:
                    with doing(f"close() after {what}"):
                        device.close()

    @promise(
        "describe() gives values that JSON can hold",
        "give a dict of text, bool, int, float, None and lists of them, with float(...) for numbers of numpy",
    )
    def test_describes_itself(self, factory: Factory[D]) -> None:
        """Check the description, which is written into every run."""
        with self.opened(factory) as (device, _):
            described: Any = device.describe()
            assert isinstance(described, Mapping), f"it gave a {type(described).__name__}"
            json.dumps(dict(described), allow_nan=False)

    @promise(
        "calls before open() and after close() raise DeviceError",
        "begin each of them with: if not open, raise DeviceError(context.name, 'it is not open')",
    )
    def test_refuses_calls_while_closed(self, factory: Factory[D]) -> None:
        """Make every call of the role that needs an open device."""
        for what, use in self.uses().items():
            with self.made(factory) as (device, _):
                refusal(DeviceError, f"{what} before open()", use, device)
        with self.opened(factory) as (device, _):
            device.close()
            for what, use in self.uses().items():
                refusal(DeviceError, f"{what} after close()", use, device)

    @promise(
        "a call beyond a limit is refused with LimitError before anything moves",
        "check the arguments first, all in SI units, and raise LimitError(what, value, limit)",
    )
    def test_refuses_what_exceeds_limits(self, factory: Factory[D]) -> None:
        """No time passes, the simulation sees nothing, and the device still works."""
        with self.opened(factory) as (device, context):
            for what, ask in self.excesses().items():
                self.ready(device)
                before_s, before = context.clock.now(), n_calls(context)
                refusal(LimitError, what, ask, device)
                assert context.clock.now() == before_s, f"{what} was refused only after a wait"
                assert n_calls(context) == before, f"{what} was refused only after it was played"
                with doing(f"work after {what} was refused"):
                    self.work(device)

    @promise(
        "timeouts are kept, and end with DeviceTimeoutError",
        "wait with context.clock.sleep or labseq.plugin.wait_for, which a stop request ends, then raise "
        "DeviceTimeoutError(context.name, ...)",
    )
    def test_keeps_timeouts(self, factory: Factory[D]) -> None:
        """Wait on the virtual clock, so that it costs no time."""
        for what, wait in self.waits().items():
            with self.opened(factory) as (device, context):
                wait.enter(device)
                before_s = context.clock.now()
                with calls_of_sleep(type(device).__module__) as slept_s:
                    self.call_in_time(context, what, refusal, DeviceTimeoutError, what, wait.wait, device)
                assert not slept_s, f"{what} called time.sleep({slept_s[0]:g})"
                passed_s = context.clock.now() - before_s
                assert passed_s <= 1.1 * wait.timeout_s + 1e-3, f"{what} took {passed_s:g} s"

    @promise(
        "a DeviceError names the device as the profile does",
        "raise DeviceError(context.name, ...), with the name that the constructor received",
    )
    def test_errors_name_the_device(self, factory: Factory[D]) -> None:
        """Check the name in each error, so that the message shows which instrument failed."""
        for what, use in self.uses().items():
            with self.made(factory) as (device, context):
                self._named(context, what, use, device)
        for failures in self.failures():
            with self.opened(factory) as (device, context):
                for what, fail in failures.items():
                    self._named(context, what, fail, device)

    def _named(self, context: Context, what: str, fail: Action[D], device: D) -> None:
        """Check the device named in a call's DeviceError, if it raises one. Then make the device safe."""
        named = context.name
        try:
            self.call_in_time(context, what, fail, device)
        except DeviceError as error:
            named = error.device
        except Exception:  # noqa: BLE001, S110 - that it fails rightly has tests of its own
            pass
        text = f"{what} raised an error of '{named}', but the profile calls it '{context.name}'"
        assert named == context.name, text
        with suppress(Exception):  # as has safe_state()
            device.safe_state()


def _safe_twice(device: Hardware, state: str) -> None:
    for count in ("once", "twice"):
        with doing(f"safe_state() {state}, {count}"):
            device.safe_state()


def close_quietly(device: Hardware) -> None:
    """Close a device and ignore errors. The promises of close() have their own tests."""
    with suppress(Exception):
        device.close()


def _stay(device: object) -> None:
    """Do nothing, because the device is already open."""
    del device


def begin_shot(context: Context) -> None:
    """Begin a shot of the simulation, if there is one, as the sequencer does."""
    if context.simulation is not None:
        context.simulation.begin_shot()


def n_calls(context: Context) -> int:
    """Number of calls of the simulation, or 0 if it does not record them."""
    simulation = context.simulation
    return len(simulation.calls) if isinstance(simulation, RecordingSimulation) else 0
