"""A client's session with a served device, and the call in progress."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from labseq.guard import StopFlag
from labseq.remote.drivers import ClientDriver

GRACE_S: Final = 0.3
"""Longest time for an aborted call to end, in seconds. Then another thread makes the device safe."""

CLOSED: Final = "closed"
"""Why a session has ended, if the client ended it."""


FAULTY_S: Final = 0.1
"""Thread time that the wrong messages of a client may take at once, in seconds."""
FAULTY_SHARE: Final = 0.01
"""The share of the thread's time that they may take after that."""


class Faults:
    """The time taken by wrong messages, per client. Used in one thread.

    A client that takes too much is not read until its share has grown again, so that others need not wait.
    """

    def __init__(self) -> None:
        self._left: dict[object, tuple[float, float]] = {}  # client -> time left, and when it was computed

    def are_too_many(self, client: object) -> bool:
        """Whether to throw away the messages of a client unread."""
        return client in self._left and self._left_s(client) <= 0.0

    def count(self, client: object, took_s: float) -> None:
        """Count the time that a wrong message of a client took, in seconds."""
        left_s = self._left_s(client) - took_s
        self._left.pop(client, None)
        self._left[client] = left_s, time.monotonic()
        for oldest in [*self._left][:-1000]:
            del self._left[oldest]

    def _left_s(self, client: object) -> float:
        left_s, then_s = self._left.get(client, (FAULTY_S, 0.0))
        return min(FAULTY_S, left_s + FAULTY_SHARE * (time.monotonic() - then_s))


class Abort(StopFlag):
    """The request to end the call in progress. The next call begins without it."""

    def clear(self) -> None:
        """Withdraw the request."""
        self._event.clear()


@dataclass(eq=False)
class Session:
    """A client's connection to a device. The control's thread sees and aborts its calls.

    Attributes:
        peer: The client's public key, or "" without keys.
        who: Name that the client gave itself, for other users.
        connection: The connection of its heartbeats, see :class:`labseq.wire.Connections`.
        token: Names the session in each message.
        port_peer: ZeroMQ's name of the connection to the device's port; empty before the first call.
        beat_s: Time of its last heartbeat.
        ended: Why it has ended, or "" before.
        driver: The session's driver object. None before the client has sent its context.
        number: Number of the last call.
        call: Name of the last call.
        reply: The parts of the last reply, in case its message comes again.
        began_s: Start of the call in progress, or None.
        rescue: Outcome of making the device safe during that call. "" if it was not necessary, "under way",
            "safe", or why it failed.
    """

    peer: str
    who: str
    connection: tuple[int, int]
    token: bytes = field(default_factory=lambda: secrets.token_bytes(16))
    port_peer: bytes = b""
    beat_s: float = field(default_factory=time.monotonic)
    ended: str = ""
    driver: ClientDriver | None = None
    number: int = 0
    call: str = ""
    reply: list[Any] = field(default_factory=list[Any])
    began_s: float | None = None
    rescue: str = ""
    abort: Abort = field(default_factory=Abort)
    _aborted_s: float | None = None
    _is_rescued: threading.Event = field(default_factory=threading.Event)
    _deciding: threading.Lock = field(default_factory=threading.Lock)

    def begin_call(self, number: int, call: str) -> None:
        """Record the start of a call."""
        self.number, self.call, self.reply = number, call, []
        self.abort.clear()
        self._aborted_s, self.rescue, self.began_s = None, "", time.monotonic()

    def end_call(self) -> None:
        """Record the end of a call. If another thread is making the device safe, wait for that first.

        A driver need not accept other calls while ``safe_state()`` runs.
        """
        with self._deciding:
            self.began_s = None
            is_under_way = self.rescue == "under way"
        if is_under_way:
            self._is_rescued.wait()

    def abort_call(self) -> None:
        """Ask the call in progress to end."""
        if self.began_s is not None:
            self._aborted_s = self._aborted_s or time.monotonic()
            self.abort.request()

    def rescue_if_stuck(self, report: Callable[[str], object]) -> None:
        """Make the device safe in another thread if an aborted call does not end."""
        with self._deciding:
            is_stuck = self._aborted_s is not None and time.monotonic() > self._aborted_s + GRACE_S
            if self.began_s is None or not is_stuck or self.rescue or self.driver is None:
                return
            self.rescue = "under way"
            self._is_rescued.clear()
        threading.Thread(target=self._rescue, args=[self.driver, report], daemon=True).start()

    def _rescue(self, driver: ClientDriver, report: Callable[[str], object]) -> None:
        self.rescue = driver.make_safe_during_call() or "safe"
        report(f"{self.call}() does not return, so it was made safe from another thread: {self.rescue}")
        self._is_rescued.set()
