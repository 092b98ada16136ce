"""A connection to one served device: calls on one socket; heartbeats, questions and aborts on another."""

from __future__ import annotations

import math
import os
import platform
import threading
import time
import weakref
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Any, Final

from labseq.plugin import Clock, Context, DeviceError, Frame, LabseqError, StopRequested, wire
from labseq_remote.events import Monitor
from labseq_remote.settings import RemoteSettings

POLL_S: Final = 0.05
"""How often a call that waits looks for a stop request."""
CONNECT_S: Final = 5.0
"""How long connecting may take; a connection that is refused fails at once."""
GRACE_S: Final = 0.4
"""How long a call may take to end after it was aborted; then its device is made safe beside it."""
BYE_S: Final = 0.1
"""How long a server may take to answer the end of a connection that is lost."""
SAFE_S: Final = 4.0
"""How long making a device safe beside a call that hangs may take."""


@dataclass(eq=False)
class Run:
    """What the connections of a run have in common.

    Attributes:
        lost: Connections that are lost and not closed yet; calls over the others are aborted.
        was_lost: Whether one was lost: then the ends of the others are not waited for.
    """

    lost: set[Connection] = field(default_factory=set["Connection"])
    was_lost: bool = False


_runs: weakref.WeakKeyDictionary[Clock, Run] = weakref.WeakKeyDictionary()
"""The session's clock -> its run."""


class Connection:
    """A session with a served device; it is made once, and stays broken when it is.

    Args:
        settings: Where the device is.
        context: The driver's context, which the server constructs its driver with.
        kind: Kind of the device, "camera".

    Raises:
        DeviceError: The server does not answer, refuses, or has another version.
        ConfigError: Keys are missing, or the served driver refuses its settings.
    """

    def __init__(self, settings: RemoteSettings, context: Context, kind: str) -> None:
        wire.require_packages()
        self.address = settings.address
        self._name = context.name or kind
        self._clock = context.clock
        self._run = _runs.setdefault(context.clock, Run())
        self._calling = threading.Lock()
        self._controlling = threading.Lock()
        self._number = self._question = self._given_up = 0
        self._lost = ""
        self._lost_s = wire.LOST_S
        self._is_abandoned = False
        self._ended = threading.Event()
        self._heard_s = time.monotonic()
        self._beat: dict[str, Any] = {"number": 0, "running": False, "rescue": ""}
        self.state: dict[str, Any] = {}
        keys, server = _keys(settings)
        self._control = wire.client_socket(keys, server)
        self._monitor = Monitor(self._control)
        try:
            self.about = self._hello(settings, kind)
            self._token = self.about["session"]
            self._calls = wire.client_socket(keys, server, timeout_s=POLL_S)
            self._calls.connect(wire.endpoint(settings.host, int(self.about["port"])))
        except BaseException:
            self._monitor.close()
            self._control.close()
            raise
        threading.Thread(target=self._beats, name=f"labseq beats {self._name}", daemon=True).start()
        try:
            self.about |= self.call("attach", self._about(context))
        except BaseException:
            self.close()
            raise

    @property
    def lost(self) -> str:
        """Why the connection is lost; "" while it is not."""
        return self._lost

    def call(self, name: str, *args: Any, stoppable: bool = True, **named: Any) -> Any:
        """Have the server call a method of the device, and wait for its end.

        Raises:
            LabseqError: What the method raised there; or ``DeviceError``: the connection is lost.
            StopRequested: The run was asked to stop; the call was aborted.
        """
        with self._calling:
            if self._lost or self._ended.is_set():
                raise self.failure(self._lost or "the connection is closed")
            self._number += 1
            message = {
                "session": self._token,
                "n": self._number,
                "call": name,
                "args": list(args),
                "named": named,
            }
            try:
                parts = wire.pack(message)
            except wire.MessageError as error:
                self._number -= 1
                raise DeviceError(self._name, f"{name}(): {error}") from error
            reply = self._await(name, parts, stoppable)
        return self._result(reply)

    def make_safe(self) -> None:
        """Make the device safe, also while another call hangs.

        Raises:
            DeviceError: It could not be made safe, or the connection is lost.
        """
        if self.is_hanging:
            self.ask("abort", number=self._number)
        deadline_s = time.monotonic() + SAFE_S
        while self.is_hanging:
            rescue = self.ask("beat")["rescue"]
            if rescue == "safe":
                return
            if rescue not in ("", "under way"):
                raise self.failure(f"a call hangs, and safe_state() beside it failed: {rescue}")
            if time.monotonic() > deadline_s:
                raise self.failure("a call hangs, and the device could not be made safe")
            self._ended.wait(POLL_S)
        self.call("safe_state", stoppable=False)

    @property
    def is_hanging(self) -> bool:
        """Whether the server is still carrying out a call, which others would have to wait for."""
        if self._calling.locked():
            return True
        if self._given_up == self._number and not self._lost:
            self._given_up = self._number if self.ask("beat")["running"] else 0
            return bool(self._given_up)
        return False

    def close(self) -> None:
        """End the connection; the server makes the device safe if that was not done."""
        if not self._ended.is_set():
            with suppress(LabseqError):
                self.ask("bye", BYE_S if self._run.was_lost else self._lost_s)
            self._ended.set()
            self._run.lost.discard(self)
            if self._calling.acquire(timeout=2 * POLL_S):
                self._calls.close()
                self._calling.release()

    def abandon(self) -> None:
        """End the heartbeats of a driver that is no longer used; the collector of garbage may not wait."""
        self._is_abandoned = True
        self._ended.set()

    def ask(self, what: str, timeout_s: float | None = None, **about: Any) -> Any:
        """Ask the control of the server; also while a call is out.

        Raises:
            DeviceError: It refuses, or does not answer in time.
        """
        import zmq

        timeout_s = self._lost_s if timeout_s is None else timeout_s
        late = f"the server did not answer within {timeout_s:.3g} s"
        if not self._controlling.acquire(timeout=timeout_s):  # a heartbeat is not answered
            raise self.failure(late)
        try:
            if self._ended.is_set():
                raise self.failure("the connection is closed")
            self._question += 1
            about |= {"n": self._question, "op": what}
            if "session" not in about and what != "hello":
                about["session"] = self._token
            self._control.send_multipart(wire.pack(about))
            deadline_s = time.monotonic() + timeout_s
            while self._monitor.wait(deadline_s - time.monotonic()):
                answer = _read(self._control.recv_multipart())
                if answer.get("n") in (self._question, 0):
                    if "error" in answer:
                        raise wire.error_of(answer["error"], self._name, self.address)
                    return answer.get("value")
            raise self.failure(self._monitor.reason or late)
        except zmq.Again:  # it cannot be sent: the connection was refused or has ended
            raise self.failure(self._monitor.reason or late) from None
        except zmq.ZMQError as error:
            raise self.failure(f"{error.strerror}") from error
        finally:
            self._controlling.release()

    def _hello(self, settings: RemoteSettings, kind: str) -> dict[str, Any]:
        """Begin the session; if that fails, the events of the socket say why."""
        self._control.connect(wire.endpoint(settings.host, settings.port))
        me = {"protocol": wire.PROTOCOL, "labseq": version("labseq")}
        who = f"{platform.node()}, process {os.getpid()}"
        about = self.ask("hello", CONNECT_S, device=settings.device, kind=kind, who=who, **me)
        if not isinstance(about, dict) or about.get("protocol") != wire.PROTOCOL:
            raise self.failure("it is not a server of this version of labseq")
        return about

    def _about(self, context: Context) -> dict[str, Any]:
        """What of the context the server's driver is constructed with."""
        return {
            "name": self._name,
            "grid": context.grid,
            "motion": context.motion,
            "lines": list(context.lines),
            "calibrations": dict(context.calibrations),
        }

    def _await(self, name: str, parts: list[Any], stoppable: bool) -> dict[str, Any]:
        """Send a call and wait for its reply."""
        import zmq

        sent_s = time.monotonic()
        stopped_s, why = math.inf, None
        try:
            self._calls.send_multipart(parts, copy=False)
            while not self._lost and not self._ended.is_set():
                try:
                    frames = self._calls.recv_multipart(copy=False)
                except zmq.Again:  # after POLL_S
                    frames = []
                if frames:
                    if not (reply := _read([frame.buffer for frame in frames])):
                        self._lose(f"the reply to {name}() cannot be read")
                    if reply.get("n") in (self._number, 0):
                        if why is not None:
                            raise why  # the device may have been made safe beside the call, which ended it
                        return reply
                    continue
                if self._is_missing(sent_s):
                    self._lose(f"{name}() got no reply although the server has none under way")
                if why is None and stoppable and (why := self._reason_to_stop()) is not None:
                    stopped_s = time.monotonic()
                    with suppress(DeviceError):  # else the connection is lost, too
                        self.ask("abort", min(GRACE_S, self._lost_s), number=self._number)
                if why is not None and time.monotonic() > stopped_s + GRACE_S:
                    self._given_up = self._number
                    raise why
        except zmq.ZMQError as error:
            self._lose(str(error.strerror))
        raise self.failure(self._lost or "the connection is closed")

    def _reason_to_stop(self) -> LabseqError | None:
        """Why a call is aborted: a request to stop, or another connection of the run that is lost."""
        try:
            self._clock.check()
        except StopRequested as error:
            return error
        others = [one for one in tuple(self._run.lost) if one is not self]
        return others[0].failure() if others else None

    def _is_missing(self, sent_s: float) -> bool:
        """Whether the server has not got the call, or its reply was lost on the way."""
        is_late = time.monotonic() > sent_s + self._lost_s and self._heard_s > sent_s + self._lost_s
        return is_late and not self._beat["running"] and not self._calls.poll(0)

    def _result(self, reply: dict[str, Any]) -> Any:
        """The value of a reply; the time of a frame is on the session's clock."""
        if "error" in reply:
            error = wire.error_of(reply["error"], self._name, self.address)
            if isinstance(error, StopRequested):
                raise self._reason_to_stop() or self.failure("the call was aborted")
            raise error
        self.state |= reply.get("state", {})
        value = reply["value"]
        if isinstance(value, Frame):
            t_start_s = value.t_start_s + self._clock.now() - float(reply["now"])
            value = replace(value, t_start_s=t_start_s)
        return value

    def _beats(self) -> None:
        """Give signs of life, and notice when the server gives none."""
        while not self._ended.wait(wire.BEAT_S):
            asked_s = time.monotonic()
            try:
                self._beat = self.ask("beat")
                self._heard_s = asked_s
            except DeviceError as error:
                text = str(error).removeprefix(f"{self._name}: ").removesuffix(f" (at {self.address})")
                self._lose(text)
                self._ended.wait()
        with self._controlling:
            self._monitor.close()
            self._control.close()
        if self._is_abandoned:
            self._calls.close()

    def _lose(self, why: str) -> None:
        if not self._ended.is_set():
            self._lost = self._lost or f"the connection is lost: {why}; its computer makes the device safe"
            self._run.lost.add(self)
            self._run.was_lost = True

    def failure(self, text: str = "") -> DeviceError:
        """An error of this device, by default that its connection is lost."""
        text = text or self._lost
        return DeviceError(self._name, f"{text} (at {self.address})")


def _read(parts: Any) -> dict[str, Any]:
    """A message; one that cannot be read is as good as none."""
    try:
        message = wire.unpack(parts)
    except wire.MessageError:
        return {}
    return message if isinstance(message, dict) else {}


def _keys(settings: RemoteSettings) -> tuple[Any, bytes | None]:
    """The keys for a connection: this computer's, and the server's public one."""
    if settings.plain:
        return None, None
    root = wire.keys_root()
    name = settings.server_key or settings.host
    return wire.find_keys(root, settings.key or ""), wire.read_public(root / "known" / f"{name}.key")
