"""The control of a device server, where sessions begin and end and calls are aborted.

Its thread makes no calls into drivers, so it always answers.
"""

from __future__ import annotations

import platform
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

import labseq
from labseq.errors import DeviceError, one_of
from labseq.messages import clean, format_error
from labseq.remote.known import KnownKeys
from labseq.remote.served import POLL_S, ServedDevice, why_ended
from labseq.remote.sessions import CLOSED, Faults, Session
from labseq.wire import LOST_S, PROTOCOL, Connections, MessageError, pack, report_error, unpack

MAX_SESSIONS: Final = 64
"""Maximum number of connections at a time. A client that makes more is faulty."""
_FIELDS: Final[Mapping[str, Mapping[str, type]]] = {
    "hello": {"protocol": int, "labseq": str, "who": str, "device": str, "kind": str},
    "beat": {"session": bytes},
    "bye": {"session": bytes},
    "abort": {"session": bytes, "number": int},
}
"""Request -> its fields and their types."""


class Control:
    """Answers clients even while their calls hang, and notices when clients disappear.

    Attributes:
        ports: Name of a device -> its port.
        failure: The error that ended its thread, or None.

    Args:
        devices: The served devices, by name.
        port: Port of the control. The devices have the next ports.
        keys: Keys of the clients that may connect.
        socket: A ROUTER, used only in the control's thread.
    """

    def __init__(self, devices: Mapping[str, ServedDevice], port: int, keys: KnownKeys, socket: Any) -> None:
        self.failure: BaseException | None = None
        self._devices = devices
        self.ports = {name: port + number for number, name in enumerate(devices, 1)}
        self._keys = keys
        self._socket = socket
        self._faults = Faults()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="labseq control", daemon=True)

    def start(self) -> None:
        """Start its thread."""
        self._thread.start()

    def end(self) -> None:
        """End its thread."""
        self._ended.set()
        self._thread.join(1.0)

    def _serve(self) -> None:
        import zmq

        self._socket.set(zmq.RCVTIMEO, int(1e3 * POLL_S))
        self._connections = Connections(self._socket)
        checked_s = time.monotonic()
        try:
            while not self._ended.is_set():
                self._step()
                self._keys.read_again()
                if (now_s := time.monotonic()) > checked_s + POLL_S:
                    self._end_lost_sessions(now_s, now_s - checked_s, self._connections.ended())
                    checked_s = time.monotonic()
        except BaseException as error:  # noqa: BLE001 - the main thread ends the server
            self.failure = error
        finally:
            self._connections.close()
            self._socket.close()

    def _step(self) -> None:
        """Answer the next message, if one comes within POLL_S."""
        import zmq

        try:
            frames = self._socket.recv_multipart(copy=False)
        except zmq.Again:
            return
        client = self._keys.client_of(frames)
        if self._faults.are_too_many(client):
            return
        with suppress(zmq.ZMQError):  # the client is gone
            self._socket.send_multipart([frames[0], *self._answer(frames, client)])

    def _end_lost_sessions(self, now_s: float, passed_s: float, ended: set[tuple[int, int]]) -> None:
        """End the sessions of clients that have disappeared, or whose key was withdrawn."""
        # after a long pause this computer was suspended, and could not receive heartbeats
        stood_still_s = passed_s if passed_s > LOST_S / 2 else 0.0
        for device in self._devices.values():
            for session in list(device.sessions.values()):
                session.beat_s += stood_still_s
                if session.connection in ended:
                    device.end_session(session, "its process has ended")
                elif now_s - session.beat_s > LOST_S:
                    device.end_session(session, f"no heartbeat for {LOST_S:g} s")
                elif not self._keys.is_known(session.peer):
                    device.end_session(session, "its key was withdrawn")
            device.rescue_stuck()

    def _answer(self, frames: list[Any], client: object) -> list[Any]:
        number, start_s = 0, time.thread_time()
        try:
            message = unpack([frame.buffer for frame in frames[1:]])
            if not isinstance(message, dict) or type(message.get("n")) is not int:
                raise MessageError("it has no number")
            number = message["n"]
            return pack({"n": number, "value": self._value(message, frames[-1])})
        except DeviceError as error:
            return pack({"n": number, "error": report_error(error)})
        except Exception as error:  # noqa: BLE001 - no message may end this thread
            self._faults.count(client, time.thread_time() - start_s)
            failure = DeviceError("server", f"the server cannot read a message: {format_error(error)}")
            return pack({"n": number, "error": report_error(failure)})

    def _value(self, message: Mapping[str, Any], frame: Any) -> Any:
        """Carry out a message. Its frame names the client's key and connection."""
        import zmq

        peer = str(frame.get("User-Id")) if self._keys.own is not None else ""
        if not self._keys.is_known(peer):
            raise DeviceError("server", "the key was withdrawn")
        request = message.get("op")
        if not isinstance(request, str) or request not in _FIELDS:
            raise MessageError("its request is unknown")
        for name, kind in _FIELDS[request].items():
            if type(message.get(name)) is not kind:
                raise MessageError(f"'{name}' is not of the type {kind.__name__}")
        if request == "hello":
            return self._hello(message, peer, self._connections.named(frame.get(zmq.SRCFD)))
        handler = {"beat": self._beat, "bye": self._bye, "abort": self._abort}[request]
        return handler(message, *self._of(message, peer))

    def _hello(self, message: Mapping[str, Any], peer: str, connection: tuple[int, int]) -> dict[str, Any]:
        if message["protocol"] != PROTOCOL:
            theirs = f"{clean(message['labseq'])} speaks protocol {clean(str(message['protocol']))}"
            ours = f"labseq {labseq.__version__} of the server speaks {PROTOCOL}"
            raise DeviceError("server", f"labseq {theirs}, and {ours}; update one of them")
        device = self._devices.get(message["device"])
        if device is None:
            text = f"there is no device '{clean(message['device'])}'; expected {one_of([*self._devices])}"
            raise DeviceError("server", text)
        if message["kind"] != device.kind:
            used = clean(message["kind"])
            text = f"'{device.name}' is of the kind {device.kind}, but the profile uses it as {used}"
            raise DeviceError("server", text)
        if sum(len(other.sessions) for other in self._devices.values()) >= MAX_SESSIONS:
            raise DeviceError("server", f"it already has {MAX_SESSIONS} connections")
        session = Session(peer, f"{self._keys.name(peer)} ({clean(message['who'])})", connection)
        device.sessions[session.token] = session
        return {
            "protocol": PROTOCOL,
            "labseq": labseq.__version__,
            "host": platform.node(),
            "session": session.token,
            "port": self.ports[device.name],
        }

    def _of(self, message: Mapping[str, Any], peer: str) -> tuple[ServedDevice, Session]:
        """The device and the session that a message names.

        Raises:
            DeviceError: The session has ended.
        """
        token = message["session"]
        for device in self._devices.values():
            session = device.sessions.get(token)
            if session is not None and session.peer == peer:
                if session.ended:
                    raise DeviceError(device.name, session.ended)
                return device, session
        ended = {key: why for device in self._devices.values() for key, why in device.ended.items()}
        raise DeviceError("server", why_ended(ended, token))

    def _beat(self, _message: Mapping[str, Any], device: ServedDevice, session: Session) -> dict[str, Any]:
        session.beat_s = time.monotonic()
        running = session.began_s is not None or device.is_busy
        return {"number": session.number, "running": running, "rescue": session.rescue}

    def _bye(self, _message: Mapping[str, Any], device: ServedDevice, session: Session) -> None:
        device.end_session(session, CLOSED)

    def _abort(self, message: Mapping[str, Any], _device: ServedDevice, session: Session) -> None:
        if session.number == message["number"]:
            session.abort_call()
