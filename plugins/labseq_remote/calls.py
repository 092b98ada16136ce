"""Calls of a served device's methods, with their numbers and replies, and how they are aborted."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final

from labseq.plugin import Clock, DeviceError, Frame, LabseqError, StopRequested, wire
from labseq_remote.control import Control, Heartbeat, read_message
from labseq_remote.life import Life

POLL_S: Final = 0.05
"""Interval at which a waiting call checks for a stop request, in seconds."""
GRACE_S: Final = 0.4
"""Longest time for an aborted call to end, in seconds. Then its device is made safe in parallel."""


class Calls:
    """Calls over one connection, one at a time.

    Args:
        life: Life of the connection.
        control: The control, which aborts calls.
        heartbeat: Heartbeat, which reports whether the server is carrying out a call.
        clock: The session's clock, for the times of frames.
        socket: Socket connected to the device's port. Receives for :data:`POLL_S`.
        state: Updated with the properties that come with the replies.
    """

    def __init__(
        self,
        life: Life,
        control: Control,
        heartbeat: Heartbeat,
        clock: Clock,
        socket: Any,
        state: dict[str, Any],
    ) -> None:
        self._life = life
        self._control = control
        self._heartbeat = heartbeat
        self._clock = clock
        self._socket = socket
        self._state = state
        self._calling = threading.Lock()
        self._number = self._given_up = 0

    def call(self, session: bytes, name: str, args: list[Any], named: dict[str, Any], stoppable: bool) -> Any:
        """Have the server call a method of the device, and wait for its end. See ``Connection.call``."""
        with self._calling:
            if self._life.is_over:
                raise self._life.failure()
            message = {"session": session, "n": self._number + 1, "call": name, "args": args, "named": named}
            try:
                parts = wire.pack(message)
            except wire.MessageError as error:
                raise DeviceError(self._life.device, f"{name}(): {error}") from error
            self._number += 1
            reply = self._await(name, parts, stoppable)
        return self._result(reply)

    @property
    def is_hanging(self) -> bool:
        """Whether the server is still carrying out a call, so that others would have to wait."""
        if self._calling.locked():
            return True
        if self._given_up == self._number and not self._life.lost:
            self._given_up = self._number if self._control.ask("beat")["running"] else 0
            return bool(self._given_up)
        return False

    def abort(self, timeout_s: float | None = None) -> None:
        """Ask the server to end the call in progress."""
        self._control.ask("abort", timeout_s, number=self._number)

    def close(self) -> None:
        """Close the socket, unless a call still waits on it."""
        if self._calling.acquire(timeout=2 * POLL_S):
            self._socket.close()
            self._calling.release()

    def _await(self, name: str, parts: list[Any], stoppable: bool) -> dict[str, Any]:
        """Send a call and wait for its reply."""
        import zmq

        sent_s = give_up_s = time.monotonic()
        why: LabseqError | None = None
        try:
            self._socket.send_multipart(parts, copy=False)
            while not self._life.is_over:
                if reply := self._receive(name):
                    if why is not None:
                        raise why  # making the device safe in parallel may have ended the call
                    return reply
                if self._is_missing(sent_s):
                    self._life.lose(f"{name}() got no reply although the server has no call in progress")
                if why is None and stoppable:
                    give_up_s = time.monotonic() + GRACE_S
                    why = self._abort_if_asked()
                if why is not None and time.monotonic() > give_up_s:
                    self._given_up = self._number
                    raise why
        except zmq.ZMQError as error:
            self._life.lose(str(error.strerror))
        raise self._life.failure()

    def _abort_if_asked(self) -> LabseqError | None:
        """Have the server end the call if there is a reason. Returns the reason."""
        why = self._reason_to_stop()
        if why is not None:
            with suppress(DeviceError):  # otherwise the connection is also lost
                self.abort(min(GRACE_S, wire.LOST_S))
        return why

    def _receive(self, name: str) -> dict[str, Any]:
        """The reply to the call, or {} if none comes within :data:`POLL_S`."""
        import zmq

        try:
            frames = self._socket.recv_multipart(copy=False)
        except zmq.Again:
            return {}
        reply = read_message([frame.buffer for frame in frames])
        if not reply:
            self._life.lose(f"the reply to {name}() cannot be read")
        return reply if reply.get("n") in (self._number, 0) else {}

    def _reason_to_stop(self) -> LabseqError | None:
        """Why a call is aborted, which is a stop request or another lost connection of the run."""
        try:
            self._clock.check()
        except StopRequested as error:
            return error
        return self._life.failure_of_another()

    def _is_missing(self, sent_s: float) -> bool:
        """Whether the call did not reach the server, or its reply was lost."""
        late_s = sent_s + wire.LOST_S
        is_late = time.monotonic() > late_s and self._heartbeat.heard_s > late_s
        return is_late and not self._heartbeat.answer["running"] and not self._socket.poll(0)

    def _result(self, reply: dict[str, Any]) -> Any:
        """The value of a reply. The time of a frame is on the session's clock."""
        if "error" in reply:
            error = wire.error_of(reply["error"], self._life.device, self._life.address)
            if isinstance(error, StopRequested):
                raise self._reason_to_stop() or self._life.failure("the call was aborted")
            raise error
        self._state |= reply.get("state", {})
        value = reply["value"]
        if isinstance(value, Frame):
            t_start_s = value.t_start_s + self._clock.now() - float(reply["now"])
            value = replace(value, t_start_s=t_start_s)
        return value
