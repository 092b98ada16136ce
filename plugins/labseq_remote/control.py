"""The control of a server, which answers questions also while a call hangs; heartbeats; why nothing comes."""

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
"""How long connecting may take; a connection that is refused fails at once."""


class Control:
    """Questions to the control of a server, one at a time, from any thread.

    Args:
        life: That of the connection.
        socket: Not connected yet.
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
            What the server says about itself, with the token of the session.

        Raises:
            DeviceError: The server does not answer, refuses, or has another version.
            ConfigError: This is the port of a device, not of its server.
        """
        self._socket.connect(wire.endpoint(settings.host, settings.port))
        me = {"protocol": wire.PROTOCOL, "labseq": version("labseq")}
        who = f"{platform.node()}, process {os.getpid()}"
        try:
            about = self.ask("hello", CONNECT_S, device=settings.device, kind=kind, who=who, **me)
        except ConfigError as error:  # the port is that of a device; the server does not know this profile
            place = f"{self._life.device} at {self._life.address}"
            raise ConfigError([replace(problem, source=place) for problem in error.problems]) from error
        if not isinstance(about, dict) or about.get("protocol") != wire.PROTOCOL:
            raise self._life.failure("it is not a server of this version of labseq")
        self._session = {"session": about["session"]}
        return about

    def ask(self, what: str, timeout_s: float | None = None, **about: Any) -> Any:
        """Ask, and wait for the answer.

        Raises:
            DeviceError: The server refuses, or does not answer in time.
        """
        import zmq

        timeout_s = wire.LOST_S if timeout_s is None else timeout_s
        late = f"the server did not answer within {timeout_s:.3g} s"
        if not self._asking.acquire(timeout=timeout_s):  # a heartbeat is not answered
            raise self._life.failure(late)
        try:
            if self._life.ended.is_set():
                raise self._life.failure("the connection is closed")
            self._n_asked += 1
            self._socket.send_multipart(wire.pack({**about, "n": self._n_asked, "op": what, **self._session}))
            return self._answer(timeout_s, late)
        except zmq.Again:  # it cannot be sent: the connection was refused or has ended
            raise self._life.failure(self._monitor.reason or late) from None
        except zmq.ZMQError as error:
            raise self._life.failure(f"{error.strerror}") from error
        finally:
            self._asking.release()

    def close(self) -> None:
        """Close the socket, after the question that is under way."""
        with self._asking:
            self._monitor.close()
            self._socket.close()

    def _answer(self, timeout_s: float, late: str) -> Any:
        deadline_s = time.monotonic() + timeout_s
        while self._monitor.wait(deadline_s - time.monotonic()):
            answer = read_message(self._socket.recv_multipart())
            if answer.get("n") in (self._n_asked, 0):  # others are late answers to earlier questions
                if "error" in answer:
                    raise wire.error_of(answer["error"], self._life.device, self._life.address)
                return answer.get("value")
        raise self._life.failure(self._monitor.reason or late)


class Heartbeat:
    """Signs of life, from a thread of their own, which notices when the server gives none.

    Attributes:
        answer: The server's last one: number of the last call, whether it is under way, and what making the
            device safe beside it has come to.
        heard_s: When that was asked for.

    Args:
        life: That of the connection.
        control: Where it asks.
        at_end: Called by the thread when the connection was closed.
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
    """Waits for messages at a socket; the socket's events say why there are none.

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
        """Whether there is a message; False at once if the connection has ended, or cannot be made.

        A message that is there counts, even if this computer stood still for longer than the time.
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
        """Why there is no connection; "" if there is one."""
        import zmq

        self._read_events()
        if zmq.EVENT_HANDSHAKE_SUCCEEDED in self._seen:
            return "the server has ended" if self._has_ended else ""
        if zmq.EVENT_HANDSHAKE_FAILED_AUTH in self._seen:
            what = "the server does not know the key of this computer, or no longer"
            return f"{what}: its public key must be in the folder `known` there"
        if zmq.EVENT_CONNECTED in self._seen:
            what = "it is not a server of devices, or the keys do not fit"
            return f"{what}: both need keys, and each the public key of the other"
        return "nothing answers there; is `labseq serve-devices` running, and its port open in the firewall?"

    def close(self) -> None:
        """End it, before the socket is closed."""
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
    """A message; one that cannot be read is as good as none."""
    try:
        message = wire.unpack(parts)
    except wire.MessageError:
        return {}
    return message if isinstance(message, dict) else {}
