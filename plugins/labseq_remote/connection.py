"""A connection to one served device, with a socket for calls and another for heartbeats and control."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any, Final

from labseq.plugin import Context, LabseqError, wire
from labseq_remote.calls import POLL_S, Calls
from labseq_remote.control import Control, Heartbeat
from labseq_remote.life import Life
from labseq_remote.settings import RemoteSettings

BYE_S: Final = 0.1
"""Longest time for a server to answer the end of a lost connection, in seconds."""
SAFE_S: Final = 4.0
"""Longest time to make a device safe while a call hangs, in seconds."""


class Connection:
    """A session with a served device.

    Attributes:
        about: Facts about the server and its driver.
        life: Whether the connection is lost.
        control: The control, which answers even during a call.

    Args:
        settings: Address and name of the device, and key of its server.
        context: The driver's context, from which the server constructs its driver.
        kind: Kind of the device, "camera".
        state: Updated with the properties of the device that come with the replies.

    Raises:
        DeviceError: The server does not answer, refuses, or has another version.
        ConfigError: Keys are missing, or the served driver refuses its settings.
    """

    def __init__(self, settings: RemoteSettings, context: Context, kind: str, state: dict[str, Any]) -> None:
        wire.require_packages()
        self.life = Life(context.name or kind, settings.address, context.clock)
        keys, server = _keys(settings)
        self.control = Control(self.life, wire.client_socket(keys, server))
        try:
            self.about = self.control.hello(settings, kind)
            calls = wire.client_socket(keys, server, timeout_s=POLL_S)
            calls.connect(wire.endpoint(settings.host, int(self.about["port"])))
        except BaseException:
            self.control.close()
            raise
        heartbeat = Heartbeat(self.life, self.control, self._close_sockets)
        self._calls = Calls(self.life, self.control, heartbeat, context.clock, calls, state)
        try:
            self.about |= self.call("attach", served_context(self.life.device, context))
        except BaseException:
            self.close()
            raise

    def call(self, name: str, *args: Any, stoppable: bool = True, **named: Any) -> Any:
        """Have the server call a method of the device, and wait for its end.

        Raises:
            LabseqError: The error of the method, or a ``DeviceError`` because the connection is lost.
            StopRequested: The run was asked to stop, and the call was aborted.
        """
        return self._calls.call(self.about["session"], name, list(args), named, stoppable)

    @property
    def is_hanging(self) -> bool:
        """Whether the server is still carrying out a call, so that others would have to wait."""
        return self._calls.is_hanging

    def make_safe(self) -> None:
        """Make the device safe, even while another call hangs.

        Raises:
            DeviceError: It could not be made safe, or the connection is lost.
        """
        if self.is_hanging:
            self._calls.abort()
        deadline_s = time.monotonic() + SAFE_S
        while self.is_hanging:
            rescue = self.control.ask("beat")["rescue"]
            if rescue == "safe":
                return
            if rescue not in ("", "under way"):
                raise self.life.failure(f"a call hangs, and safe_state() in parallel failed: {rescue}")
            if time.monotonic() > deadline_s:
                raise self.life.failure("a call hangs, and the device could not be made safe")
            self.life.ended.wait(POLL_S)
        self.call("safe_state", stoppable=False)

    def close(self) -> None:
        """End the connection. The server makes the device safe if that was not done."""
        if not self.life.ended.is_set():
            with suppress(LabseqError):
                self.control.ask("bye", BYE_S if self.life.run_lost_one else None)
            self.life.end()

    def abandon(self) -> None:
        """End the heartbeats of an unused driver, without waiting, because the garbage collector calls it."""
        self.life.ended.set()

    def _close_sockets(self) -> None:
        """Close the sockets. Called by the heartbeat's thread after the connection was closed."""
        self.control.close()
        self._calls.close()


def served_context(name: str, context: Context) -> dict[str, Any]:
    """The parts of the context that the server's driver needs."""
    return {
        "name": name,
        "grid": context.grid,
        "motion": context.motion,
        "lines": list(context.lines),
        "calibrations": dict(context.calibrations),
    }


def _keys(settings: RemoteSettings) -> tuple[Any, bytes | None]:
    """The keys for a connection, which are this computer's keys and the server's public key."""
    if settings.plain:
        return None, None
    root = wire.keys_root()
    name = settings.server_key or settings.host
    return wire.find_keys(root), wire.read_public(root / "known" / f"{name}.key")
