"""What was called, in which order; and calls that fail or hang when a test says so."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeAlias

from labseq.roles import Clock

Failure: TypeAlias = BaseException | Sequence[BaseException | None]
"""Raised at every call; or one after the other, where None lets the call pass, and then no more."""

TEST_IS_OVER_S: Final = 30.0
"""A call that hangs goes on after this time, so that a test that forgot it still ends."""


class Call(NamedTuple):
    """One call.

    Attributes:
        device: Whose method it was.
        method: Its name.
        args: Its positional arguments.
        kwargs: Its keyword arguments.
        t_s: When, on the clock that the calls are noted with.
    """

    device: str
    method: str
    args: tuple[Any, ...] = ()
    kwargs: Mapping[str, Any] = {}
    t_s: float = 0.0

    @property
    def name(self) -> str:
        """For example "camera.arm"."""
        return f"{self.device}.{self.method}"

    def __str__(self) -> str:
        given = [repr(value) for value in self.args]
        given += [f"{key}={value!r}" for key, value in self.kwargs.items()]
        return f"{self.name}({', '.join(given)})"


class Calls(list[Call]):
    """The list that all fakes of a test share.

    Args:
        clock: Gives each call its time; without one all times are 0.

    Example:
        >>> calls = Calls()
        >>> calls.note("camera", "arm", 1, exposure_s=0.045)
        >>> calls.note("shutter", "open")
        >>> calls.names(), str(calls[0])
        (['camera.arm', 'shutter.open'], 'camera.arm(1, exposure_s=0.045)')
        >>> calls.names("shutter")
        ['shutter.open']
    """

    def __init__(self, clock: Clock | None = None) -> None:
        super().__init__()
        self._clock = clock

    def note(self, device: str, method: str, *args: Any, **kwargs: Any) -> None:
        """Add a call."""
        t_s = self._clock.now() if self._clock is not None else 0.0
        self.append(Call(device, method, args, kwargs, t_s))

    def names(self, *devices: str) -> list[str]:
        """The calls in short, "camera.arm"; of some devices, or of all."""
        return [call.name for call in self if not devices or call.device in devices]

    def of(self, name: str) -> list[Call]:
        """The calls of one method, for example "camera.arm"."""
        return [call for call in self if call.name == name]


class Hang:
    """A call that does not come back until the test lets it.

    Attributes:
        reached: Set when the call has begun to hang; wait for it in the test.
        release: Set it to let the call go on.
    """

    def __init__(self) -> None:
        self.reached = threading.Event()
        self.release = threading.Event()

    def wait(self) -> None:
        """Hang."""
        self.reached.set()
        self.release.wait(TEST_IS_OVER_S)


class Faults:
    """The failures and hangs that a test has planned for one device, by method."""

    def __init__(self, fail_on: Mapping[str, Failure], hang_on: Mapping[str, Hang]) -> None:
        self._failures = {method: _in_turn(failure) for method, failure in fail_on.items()}
        self._hangs = hang_on

    def inject_fault(self, method: str) -> None:
        """Hang or raise if this is planned for the method."""
        if method in self._hangs:
            self._hangs[method].wait()
        failure = next(self._failures.get(method, iter(())), None)
        if failure is not None:
            raise failure


def _in_turn(failure: Failure) -> Iterator[BaseException | None]:
    if not isinstance(failure, BaseException):
        yield from failure
        return
    while True:
        yield failure
