"""A served device, with its socket and the one thread in which all calls into its drivers are made.

One client at a time, the owner, may open the device. The others may make calls that need no open device,
and read the description by the owner's driver. A client's calls are made in the order of their numbers.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from labseq.errors import ConfigError, DeviceError, LabseqError, Problem, StopRequested
from labseq.messages import format_error
from labseq.remote.drivers import DESCRIBING, ClientDriver, DeviceEntry
from labseq.remote.known import KnownKeys
from labseq.remote.sessions import Faults, Session
from labseq.wire import Connections, MessageError, pack, report_error, unpack

POLL_S: Final = 0.03
"""Longest time that a thread waits for messages before it does its other work, in seconds."""


@dataclass(frozen=True, slots=True)
class Call:
    """A client's message that calls a method.

    Attributes:
        session: Token of the client's session.
        n: Number of the call, from 1.
        call: Name of the method.
        args: Positional arguments.
        named: Named arguments.
    """

    session: bytes
    n: int
    call: str
    args: list[Any]
    named: dict[str, Any]


_TYPES: Final = {"session": bytes, "n": int, "call": str, "args": list, "named": dict}


class RefusedError(Exception):
    """A message that is not carried out.

    Attributes:
        number: Number of the call. 0 for a message that cannot be read.
        error: Why the message is refused.
    """

    def __init__(self, number: int, error: LabseqError) -> None:
        super().__init__(str(error))
        self.number = number
        self.error = error


class ForControlError(Exception):
    """A message for the control came to the port of a device."""


def read_call(parts: list[Any]) -> Call:
    """Read the call in a message.

    Raises:
        MessageError: The message is damaged, or is not a call.
        ForControlError: It is the first message of a client, which is for the control.
    """
    message = unpack(parts)
    if isinstance(message, dict) and message.get("op") == "hello":
        raise ForControlError
    if not isinstance(message, dict) or any(
        type(message.get(key)) is not kind for key, kind in _TYPES.items()
    ):
        raise MessageError("it is not a call")
    return Call(**{key: message[key] for key in _TYPES})


class ServedDevice:
    """A device, the thread that makes all calls into its drivers, and the socket that receives the calls.

    Attributes:
        name: Role of the device, or its name in the profile.
        kind: Kind of the device, "camera".
        sessions: Token -> session.
        ended: Token -> why that session ended, for the last 64.
        is_busy: Whether its thread does anything other than wait for messages.
        failure: The error that ended its thread, or None.

    Args:
        entry: The device.
        socket: A ROUTER, used only in the device's thread.
        control_port: The port that clients have to connect to first.
        keys: Keys of the clients that may connect.
        report: Receives lines of text for the operator.
    """

    def __init__(
        self,
        entry: DeviceEntry,
        socket: Any,
        control_port: int,
        keys: KnownKeys,
        report: Callable[[str], object],
    ) -> None:
        self.name = entry.name
        self.kind = entry.kind
        self.sessions: dict[bytes, Session] = {}
        self.ended: dict[bytes, str] = {}
        self.is_busy = False
        self.failure: BaseException | None = None
        self._entry = entry
        self._socket = socket
        self._control_port = control_port
        self._keys = keys
        self._report = report
        self._faults = Faults()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=f"labseq {entry.name}", daemon=True)

    def start(self) -> None:
        """Start its thread."""
        self._thread.start()

    def begin_end(self) -> None:
        """Begin to end all sessions, with the device safe and closed, and then its thread."""
        for session in list(self.sessions.values()):
            self.end_session(session, "the server ends")
        self._ended.set()

    @property
    def is_alive(self) -> bool:
        """Whether its thread runs."""
        return self._thread.is_alive()

    @property
    def owner(self) -> Session | None:
        """The session that has opened the device, or None."""
        sessions = list(self.sessions.values())
        return next((s for s in sessions if s.driver is not None and s.driver.is_open), None)

    def end_session(self, session: Session, why: str) -> None:
        """Ask the device's thread to end a session. The call in progress is aborted."""
        if not session.ended:
            session.ended = why
            session.abort_call()

    def rescue_stuck(self) -> None:
        """Make the device safe in another thread if an aborted call does not end."""
        for session in list(self.sessions.values()):
            session.rescue_if_stuck(self._report_with_name)

    def _report_with_name(self, text: str) -> None:
        self._report(f"{self.name}: {text}")

    def _serve(self) -> None:
        import zmq

        self._socket.set(zmq.RCVTIMEO, int(1e3 * POLL_S))
        connections, checked_s = Connections(self._socket), time.monotonic()
        try:
            while not (self._ended.is_set() and not self.sessions):
                if time.monotonic() - checked_s > POLL_S:
                    connections.ended()  # discards them: sessions end at the control port
                    checked_s = time.monotonic()
                self._step()
        except BaseException as error:  # noqa: BLE001 - the main thread ends the server
            self.failure = error
        finally:
            for session in list(self.sessions.values()):
                self.end_session(session, "the server failed")
                self._close(session)
            connections.close()
            self._socket.close()

    def _step(self) -> None:
        """Answer the next message, if one comes within POLL_S, and close sessions that have ended."""
        import zmq

        self.is_busy = False
        try:
            frames = self._socket.recv_multipart(copy=False)
        except zmq.Again:
            frames = []
        self.is_busy = True
        if frames:
            self._handle(frames)
        for session in [session for session in list(self.sessions.values()) if session.ended]:
            self._close(session)

    def _handle(self, frames: list[Any]) -> None:
        import zmq

        client = self._keys.client_of(frames)
        if self._faults.are_too_many(client):
            return
        start_s = time.thread_time()
        try:
            try:
                parts = self._answer(frames)
            except RefusedError as refused:
                parts = pack({"n": refused.number, "error": report_error(refused.error)})
                self._faults.count(client, time.thread_time() - start_s)
            if parts:
                with suppress(zmq.ZMQError):  # the client is gone
                    self._socket.send_multipart([frames[0], *parts], copy=False)
        except Exception as error:  # noqa: BLE001 - no message may end this thread
            self._report_with_name(f"a message could not be answered: {format_error(error)}")

    def _answer(self, frames: list[Any]) -> list[Any]:
        """The reply to a message. Empty if the message is not answered.

        Raises:
            RefusedError: The message is not carried out.
        """
        try:
            call = read_call([frame.buffer for frame in frames[1:]])
        except MessageError as error:
            raise self._refused(0, f"the server cannot read a message: {error}") from error
        except ForControlError as error:
            raise RefusedError(0, self._wrong_port()) from error
        session = self.sessions.get(call.session)
        if session is None:
            raise self._refused(call.n, why_ended(self.ended, call.session))
        peer = frames[-1].get("User-Id") if session.peer else ""
        if reason := self._why_refused(session, peer, frames[0].bytes, call.n):
            raise self._refused(call.n, reason)
        session.port_peer = frames[0].bytes
        if call.n <= session.number:  # a repeated message, for which the method must not be called again
            return session.reply if call.n == session.number else []
        session.begin_call(call.n, call.call)
        session.reply = self._reply(session, call)
        session.end_call()
        return session.reply

    def _why_refused(self, session: Session, peer: str, port_peer: bytes, number: int) -> str:
        """Why a call is not carried out, or "" if it may be. Wrong calls end their session."""
        if peer != session.peer:
            return "the connection belongs to another key"
        # frames may wait in memory for one connection only that does not read them
        if session.port_peer not in (b"", port_peer):
            return "its calls come from another connection"
        if not self._keys.is_known(session.peer):
            self.end_session(session, "its key was withdrawn")
        elif number > session.number + 1:
            self.end_session(session, f"its calls came out of order: {number} after {session.number}")
        return session.ended

    def _wrong_port(self) -> ConfigError:
        what = f"this is the port of the device '{self.name}', not of its server"
        return ConfigError(Problem(what, expected=f"port {self._control_port}", hint="change 'address'"))

    def _refused(self, number: int, text: str) -> RefusedError:
        return RefusedError(number, DeviceError(self.name, text))

    def _reply(self, session: Session, call: Call) -> list[Any]:
        answer: dict[str, Any] = {"n": call.n}
        try:
            answer["value"] = self._carry_out(session, call)
            if session.driver is not None:
                answer["state"] = session.driver.state_after(call.call)
                answer["now"] = session.driver.clock.now()  # the client's clock has a different zero
        except BaseException as error:  # noqa: BLE001 - of the driver's class; it goes to the client
            if session.ended and isinstance(error, StopRequested):
                error = DeviceError(self.name, f"the server has ended the connection: {session.ended}")
            answer["error"] = report_error(error)
        try:
            return pack(answer)
        except MessageError as error:
            failure = DeviceError(self.name, f"the result of {call.call}() cannot be sent: {error}")
            return pack({"n": call.n, "error": report_error(failure)})

    def _carry_out(self, session: Session, call: Call) -> Any:
        if call.call == "attach":
            return self._attach(session, *call.args)
        if session.driver is None:
            raise DeviceError(self.name, "the connection has no driver yet")
        if call.call == "open":
            return self._open(session, session.driver)
        if call.call == "close":
            return self._close_driver(session.driver)
        driver, owner = session.driver, self.owner
        if call.call in DESCRIBING and owner is not None and owner.driver is not None:
            driver = owner.driver
        return driver.call(call.call, call.args, call.named)

    def _attach(self, session: Session, client_context: Any) -> dict[str, Any]:
        """Construct the client's driver."""
        if session.driver is not None:
            raise DeviceError(self.name, "the connection already has a driver")
        session.driver = ClientDriver(self._entry, client_context, session.abort, self._report)
        plugin = self._entry.plugin
        return {
            "abilities": session.driver.abilities(),
            "plugin": plugin.entry.name,
            "settings": plugin.dump(),
        }

    def _open(self, session: Session, driver: ClientDriver) -> None:
        owner = self.owner
        if owner not in (None, session):
            assert owner is not None
            raise DeviceError(self.name, f"in use by {owner.who}, and only one client at a time can use it")
        if owner is None:
            self._report_with_name(f"in use by {session.who}")
        driver.open(partial(self.end_session, session))

    def _close_driver(self, driver: ClientDriver) -> None:
        if failures := driver.close():
            raise DeviceError(self.name, "; ".join(failures))

    def _close(self, session: Session) -> None:
        """End a session. Its device is made safe and closed if the client has not done so."""
        latest = [*self.ended.items()][-63:]
        self.ended = {**dict(latest), session.token: session.ended}
        try:
            if session.driver is not None and session.driver.is_open:
                start_s = time.monotonic()
                failures = session.driver.close()
                outcome = "; ".join(failures) or f"made safe in {1e3 * (time.monotonic() - start_s):.0f} ms"
                who, why = session.who, session.ended
                self._report_with_name(f"the connection of {who} ended ({why}): {outcome}")
        finally:
            del self.sessions[session.token]


def why_ended(ended: dict[bytes, str], token: Any) -> str:
    """Why there is no longer a session with this token."""
    return ended.get(token, "the connection has ended, or the server was restarted")
