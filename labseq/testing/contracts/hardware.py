"""What all hardware roles promise."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

from labseq.errors import DeviceError, DeviceTimeoutError, LimitError
from labseq.roles import Context, Hardware
from labseq.testing.contracts.bench import (
    Action,
    D,
    Factory,
    HardwareContractBase,
    Wait,
    begin_shot,
    close_quietly,
    n_calls,
)
from labseq.testing.contracts.process import quietly
from labseq.testing.contracts.promises import CallHungError, doing, promise, promised, refusal

__all__ = ["Action", "Factory", "HardwareContract", "Wait", "n_calls"]

ALWAYS_SAFE: Final = "safe_state() is legal in every state, and twice"


class HardwareContract(HardwareContractBase[D]):
    """Promises of every camera, tweezer driver and instrument.

    Inherit the suite of the role, not this one, and provide the fixture ``factory``.

    Attributes:
        role: Name that the device has in the profile.
        max_wait_s: Real time after which a call counts as hung, in seconds.
    """

    @promise("the constructor does no I/O, and changes nothing that all code shares")
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

    @promise("describe() gives values that JSON can hold")
    def test_describes_itself(self, factory: Factory[D]) -> None:
        """It is written into every run."""
        with self.opened(factory) as (device, _):
            described: Any = device.describe()
            assert isinstance(described, Mapping), f"it gave a {type(described).__name__}"
            json.dumps(dict(described), allow_nan=False)

    @promise("calls before open() and after close() raise DeviceError")
    def test_refuses_calls_while_closed(self, factory: Factory[D]) -> None:
        """Every call of the role that needs the device."""
        for what, use in self.uses().items():
            with self.made(factory) as (device, _):
                refusal(DeviceError, f"{what} before open()", use, device)
        with self.opened(factory) as (device, _):
            device.close()
            for what, use in self.uses().items():
                refusal(DeviceError, f"{what} after close()", use, device)

    @promise("what exceeds a limit is refused with LimitError before anything moves")
    def test_refuses_what_exceeds_limits(self, factory: Factory[D]) -> None:
        """Neither does time pass nor does the simulation see anything, and the device goes on working."""
        with self.opened(factory) as (device, context):
            for what, ask in self.excesses().items():
                self.ready(device)
                before_s, before = context.clock.now(), n_calls(context)
                refusal(LimitError, what, ask, device)
                assert context.clock.now() == before_s, f"{what} was refused only after a wait"
                assert n_calls(context) == before, f"{what} was refused only after it was played"
                with doing(f"work after {what} was refused"):
                    self.work(device)

    @promise("timeouts are kept, and end with DeviceTimeoutError")
    def test_keeps_timeouts(self, factory: Factory[D]) -> None:
        """On the virtual clock, so that it costs no time."""
        for what, wait in self.waits().items():
            with self.opened(factory) as (device, context):
                wait.enter(device)
                before_s = context.clock.now()
                self.call_in_time(context, what, refusal, DeviceTimeoutError, what, wait.wait, device)
                passed_s = context.clock.now() - before_s
                assert passed_s <= 1.1 * wait.timeout_s + 1e-3, f"{what} took {passed_s:g} s"

    @promise("a DeviceError names the device as the profile does")
    def test_errors_name_the_device(self, factory: Factory[D]) -> None:
        """Else nobody knows which of the instruments failed."""
        for what, use in self.uses().items():
            with self.made(factory) as (device, context):
                self._named(context, what, use, device)
        for failures in self.failures():
            with self.opened(factory) as (device, context):
                for what, fail in failures.items():
                    self._named(context, what, fail, device)

    def _named(self, context: Context, what: str, fail: Action[D], device: D) -> None:
        """Check whom the error of a call names, if it is a DeviceError; then the device is made safe."""
        named = context.name
        try:
            self.call_in_time(context, what, fail, device)
        except DeviceError as error:
            named = error.device
        except Exception:  # noqa: BLE001, S110 - that it fails rightly has tests of its own
            pass
        text = f"{what} raised an error of '{named}'; the profile calls it '{context.name}'"
        assert named == context.name, text
        with suppress(Exception):  # and so has this
            device.safe_state()


def _safe_twice(device: Hardware, state: str) -> None:
    for count in ("once", "twice"):
        with doing(f"safe_state() {state}, {count}"):
            device.safe_state()
