"""What all recording devices share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

from labseq.errors import DeviceError, LimitError
from labseq.roles import Context
from labseq.testing.fakes.calls import Calls, Failure, Faults, Hang
from labseq.testing.fakes.clock import FakeClock


class RecordingHardware:
    """Notes every call in a list and keeps the promises of its role, in memory only.

    Args:
        context: As a plugin's factory is given it; by default the role's name and
            a :class:`FakeClock`.
        calls: Where calls are noted; share one list between the devices of a test.
        fail_on: Method -> what it raises, for example ``{"play": DeviceError(...)}``.
        hang_on: Method -> the :class:`Hang` that it waits for.

    Attributes:
        calls: Every call so far.
        is_open: Whether it was opened and not closed since.
    """

    role: ClassVar[str] = "device"

    def __init__(
        self,
        context: Context | None = None,
        calls: Calls | None = None,
        *,
        fail_on: Mapping[str, Failure] | None = None,
        hang_on: Mapping[str, Hang] | None = None,
    ) -> None:
        context = context or Context(self.role, clock=FakeClock())
        self.name = context.name or self.role
        self.grid = context.grid
        self.clock = context.clock
        self.simulation = context.simulation
        self.calls = Calls(context.clock) if calls is None else calls
        self.is_open = False
        self._faults = Faults(fail_on or {}, hang_on or {})

    def open(self) -> None:
        """Note it."""
        self.note("open")
        self.is_open = True

    def close(self) -> None:
        """Note it and forget the state."""
        self.note("close")
        self.is_open = False
        self.reset()

    def safe_state(self) -> None:
        """Note it and forget the state."""
        self.note("safe_state")
        self.reset()

    def describe(self) -> Mapping[str, Any]:
        """Say that it is a fake."""
        self.note("describe")
        return {"model": type(self).__name__, "serial_number": "fake"}

    def reset(self) -> None:
        """Forget what the role's methods have left; roles with a state do more."""

    def note(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Note a call, then hang or fail if the test has planned it."""
        self.calls.note(self.name, method, *args, **kwargs)
        self._faults.inject_fault(method)

    def use(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Note a call that needs the device to be open."""
        self.note(method, *args, **kwargs)
        if not self.is_open:
            raise DeviceError(self.name, f"{method}() was called while it is not open")


def require_within(what: str, value: float, lowest: float, highest: float) -> None:
    """Refuse a number outside of its limits, nan included.

    Raises:
        LimitError: It is outside.
    """
    if not (math.isfinite(value) and lowest <= value <= highest):
        raise LimitError(what, value, f"{lowest:g} to {highest:g}")
