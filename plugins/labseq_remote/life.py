"""Whether a connection is alive, for all its parts and the other connections of its run."""

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass, field

from labseq.plugin import Clock, DeviceError


@dataclass(eq=False)
class Run:
    """State that the connections of a run share.

    Attributes:
        lost: Connections that are lost and not closed yet. Calls over the others are aborted.
        was_lost: Whether any was lost, after which the others end without waiting.
    """

    lost: set[Life] = field(default_factory=set["Life"])
    was_lost: bool = False


_runs: weakref.WeakKeyDictionary[Clock, Run] = weakref.WeakKeyDictionary()
"""The session's clock -> its run."""


class Life:
    """The life of a connection, which is made once and stays broken if it breaks.

    Attributes:
        device: Name of the device, for messages.
        address: Address of the server.
        lost: Why the connection is lost, or "".
        ended: Set when the connection was closed.

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
        """Whether the connection is lost or closed."""
        return bool(self.lost) or self.ended.is_set()

    @property
    def run_lost_one(self) -> bool:
        """Whether this connection or another connection of the run was lost."""
        return self._run.was_lost

    def lose(self, why: str) -> None:
        """Record that the connection is lost, unless it was closed. The first reason counts."""
        if not self.ended.is_set():
            self.lost = self.lost or f"the connection is lost: {why} (its computer makes the device safe)"
            self._run.lost.add(self)
            self._run.was_lost = True

    def end(self) -> None:
        """Record that the connection was closed."""
        self.ended.set()
        self._run.lost.discard(self)

    def failure(self, text: str = "") -> DeviceError:
        """An error of the device, by default about its lost or closed connection."""
        text = text or self.lost or "the connection is closed"
        return DeviceError(self.device, f"{text} (at {self.address})")

    def failure_of_another(self) -> DeviceError | None:
        """The error for another lost connection of the run, or None."""
        others = [life for life in tuple(self._run.lost) if life is not self]
        return others[0].failure() if others else None
