"""The control of a server (which answers even while a call hangs), heartbeats, and reasons of silence."""

from __future__ import annotations

import os
import platform
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from typing import Any, Final

from labseq.plugin import ConfigError, DeviceError, wire
from labseq_remote.life import Life
from labseq_remote.settings import RemoteSettings

CONNECT_S: Final = 5.0
"""Longest time to connect, in seconds. A refused connection fails at once."""


class Control:
    """Questions to the control of a server, one at a time, from any thread.

    Args:
        life: Life of the connection.
        socket: Socket, not connected yet.
    """

    def __init__(self, life: Life, socket: Any) -> None:
        self._life = life
        self._socket = socket
        self._monitor = Monitor(socket)
        self._asking = threading.Lock()
        self._n_asked = 0
        self._session: dict[str, Any] = {}

    def hello(self, settings: RemoteSettings, kind: str) -> dict[str, Any]:
        """Connect, and begin a session.

        Returns:
            Facts about the server, with the token of the session.

        Raises:
            DeviceError: The server does not answer, refuses, or has another version.
            ConfigError: The port belongs to a device, not to its server.
        """
        self._socket.connect(wire.endpoint(settings.host, settings.port))
        me = {"protocol": wire.PROTOCOL, "labseq": version("labseq")}
        who = f"{platform.node()}, process {os.getpid()}"
        try:
            about = self.ask("hello", CONNECT_S, device=settings.device, kind=kind, who=who, **me)
        except ConfigError as error:  # it is the port of a device, and the server does not know this profile
            place = f"{self._life.device} at {self._life.address}"
            raise ConfigError([replace(problem, source=place) for problem in error.problems]) from error
        if not isinstance(about, dict) or about.get("protocol") != wire.PROTOCOL:
            raise self._life.failure("it is not a server of this version of labseq")
        self._session = {"session": about["session"]}
        return about

    def ask(self, what: str, timeout_s: float | None = None, **about: Any) -> Any:
        """Send a request, and wait for the answer.

        Raises:
            DeviceError: The server refuses, or does not answer in time.
        """
        import zmq

        timeout_s = wire.LOST_S if timeout_s is None else timeout_s
        late = f"the server did not answer within {timeout_s:.3g} s"
        if not self._asking.acquire(timeout=timeout_s):  # a heartbeat is still unanswered
            raise self._life.failure(late)
        try:
            if self._life.ended.is_set():
                raise self._life.failure("the connection is closed")
            self._n_asked += 1
            self._socket.send_multipart(wire.pack({**about, "n": self._n_asked, "op": what, **self._session}))
            return self._answer(timeout_s, late)
        except zmq.Again:  # it cannot be sent because the connection was refused or has ended
            raise self._life.failure(self._monitor.reason or late) from None
        except zmq.ZMQError as error:
            raise self._life.failure(f"{error.strerror}") from error
        finally:
            self._asking.release()

    def close(self) -> None:
        """Close the socket, after the request in progress."""
        with self._asking:
            self._monitor.close()
            self._socket.close()

    def _answer(self, timeout_s: float, late: str) -> Any:
        deadline_s = time.monotonic() + timeout_s
        while self._monitor.wait(deadline_s - time.monotonic()):
            answer = read_message(self._socket.recv_multipart())
            if answer.get("n") in (self._n_asked, 0):  # others are late answers to earlier requests
                if "error" in answer:
                    raise wire.error_of(answer["error"], self._life.device, self._life.address)
                return answer.get("value")
        raise self._life.failure(self._monitor.reason or late)


class Heartbeat:
    """A thread that sends heartbeats and notices when the server does not answer.

    Attributes:
        answer: The server's last answer, with the number of the last call, whether it is in progress, and the
            outcome of making the device safe in parallel.
        heard_s: Time when that answer was requested.

    Args:
        life: Life of the connection.
        control: The control, which receives the heartbeats.
        at_end: Called by the thread after the connection was closed.
    """

    def __init__(self, life: Life, control: Control, at_end: Callable[[], object]) -> None:
        self.answer: dict[str, Any] = {"number": 0, "running": False, "rescue": ""}
        self.heard_s = time.monotonic()
        self._life = life
        self._control = control
        self._at_end = at_end
        threading.Thread(target=self._beat, name=f"labseq beats {life.device}", daemon=True).start()

    def _beat(self) -> None:
        while not self._life.ended.wait(wire.BEAT_S):
            asked_s = time.monotonic()
            try:
                self.answer = self._control.ask("beat")
                self.heard_s = asked_s
            except DeviceError as error:
                self._life.lose(error.message.removesuffix(f" (at {self._life.address})"))
                self._life.ended.wait()
        self._at_end()


class Monitor:
    """Waits for messages at a socket. The socket's events give the reason if none come.

    Args:
        socket: The socket, before it connects.
    """

    def __init__(self, socket: Any) -> None:
        import zmq

        self._socket = socket
        self._events = socket.get_monitor_socket()
        self._poller = zmq.Poller()
        self._poller.register(socket, zmq.POLLIN)
        self._poller.register(self._events, zmq.POLLIN)
        self._seen: set[int] = set()

    def wait(self, timeout_s: float) -> bool:
        """Wait for a message. False at once if the connection has ended or cannot be made.

        A message that has arrived counts, even if this computer was suspended for longer than the timeout.
        """
        until_s = time.monotonic() + timeout_s
        while True:
            left_s = 0.0 if self._has_ended else until_s - time.monotonic()
            ready = dict(self._poller.poll(int(1e3 * max(0.0, left_s))))
            if self._socket in ready:
                return True
            self._read_events()
            if self._has_ended or not ready:
                return False

    @property
    def reason(self) -> str:
        """Why there is no connection, or "" if there is one."""
        import zmq

        self._read_events()
        if zmq.EVENT_HANDSHAKE_SUCCEEDED in self._seen:
            return "the server has ended" if self._has_ended else ""
        if zmq.EVENT_HANDSHAKE_FAILED_AUTH in self._seen:
            what = "the server does not know this computer's key, or no longer accepts it"
            return f"{what}; put the public key into the folder `known` of the server's keys"
        if zmq.EVENT_CONNECTED in self._seen:
            what = "it is not a device server, or the keys do not match"
            return f"{what}; each computer needs its own keys and the other's public key"
        return "nothing answers there; check that `labseq serve-devices` runs and the firewall opens its port"

    def close(self) -> None:
        """Stop monitoring, before the socket is closed."""
        self._socket.disable_monitor()
        self._events.close()

    @property
    def _has_ended(self) -> bool:
        import zmq

        return bool(self._seen & {zmq.EVENT_CLOSED, zmq.EVENT_DISCONNECTED})

    def _read_events(self) -> None:
        from zmq.utils.monitor import recv_monitor_message

        while self._events.poll(0):
            self._seen.add(int(recv_monitor_message(self._events)["event"]))


def read_message(parts: Any) -> dict[str, Any]:
    """Read a message. An unreadable message counts as none."""
    try:
        message = wire.unpack(parts)
    except wire.MessageError:
        return {}
    return message if isinstance(message, dict) else {}
