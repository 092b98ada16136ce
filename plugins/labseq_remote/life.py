"""Whether a connection lives, which all of its parts and the other connections of its run must know."""

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass, field

from labseq.plugin import Clock, DeviceError


@dataclass(eq=False)
class Run:
    """What the connections of a run have in common.

    Attributes:
        lost: Those that are lost and not closed yet; calls over the others are aborted.
        was_lost: Whether one was lost: then the ends of the others are not waited for.
    """

    lost: set[Life] = field(default_factory=set["Life"])
    was_lost: bool = False


_runs: weakref.WeakKeyDictionary[Clock, Run] = weakref.WeakKeyDictionary()
"""The session's clock -> its run."""


class Life:
    """The life of a connection: it is made once, and stays broken when it is.

    Attributes:
        device: Name of the device, for messages.
        address: The server.
        lost: Why the connection is lost; "" while it is not.
        ended: Set when it was closed.

    Args:
        clock: The session's clock, which connections of the same run share.
    """

    def __init__(self, device: str, address: str, clock: Clock) -> None:
        self.device = device
        self.address = address
        self.lost = ""
        self.ended = threading.Event()
        self._run = _runs.setdefault(clock, Run())

    @property
    def is_over(self) -> bool:
        """Whether it is lost, or was closed."""
        return bool(self.lost) or self.ended.is_set()

    @property
    def run_lost_one(self) -> bool:
        """Whether this connection or another one of the run was lost."""
        return self._run.was_lost

    def lose(self, why: str) -> None:
        """It is lost, unless it was closed; the first reason counts."""
        if not self.ended.is_set():
            self.lost = self.lost or f"the connection is lost: {why}; its computer makes the device safe"
            self._run.lost.add(self)
            self._run.was_lost = True

    def end(self) -> None:
        """It was closed."""
        self.ended.set()
        self._run.lost.discard(self)

    def failure(self, text: str = "") -> DeviceError:
        """An error of the device, by default that its connection is lost or closed."""
        text = text or self.lost or "the connection is closed"
        return DeviceError(self.device, f"{text} (at {self.address})")

    def failure_of_another(self) -> DeviceError | None:
        """That another connection of the run is lost; None if none is."""
        others = [life for life in tuple(self._run.lost) if life is not self]
        return others[0].failure() if others else None
