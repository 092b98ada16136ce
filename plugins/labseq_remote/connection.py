"""A connection to one served device: calls on one socket; heartbeats, questions and aborts on another."""

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
"""How long a server may take to answer the end of a connection that is lost."""
SAFE_S: Final = 4.0
"""How long making a device safe beside a call that hangs may take."""


class Connection:
    """A session with a served device.

    Attributes:
        about: What the server says about itself and its driver.
        life: Whether the connection is lost.
        control: Answers questions, also while a call is out.

    Args:
        settings: Where the device is.
        context: The driver's context, which the server constructs its driver with.
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
            LabseqError: What the method raised there; or ``DeviceError``: the connection is lost.
            StopRequested: The run was asked to stop; the call was aborted.
        """
        return self._calls.call(self.about["session"], name, list(args), named, stoppable)

    @property
    def is_hanging(self) -> bool:
        """Whether the server is still carrying out a call, which others would have to wait for."""
        return self._calls.is_hanging

    def make_safe(self) -> None:
        """Make the device safe, also while another call hangs.

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
                raise self.life.failure(f"a call hangs, and safe_state() beside it failed: {rescue}")
            if time.monotonic() > deadline_s:
                raise self.life.failure("a call hangs, and the device could not be made safe")
            self.life.ended.wait(POLL_S)
        self.call("safe_state", stoppable=False)

    def close(self) -> None:
        """End the connection; the server makes the device safe if that was not done."""
        if not self.life.ended.is_set():
            with suppress(LabseqError):
                self.control.ask("bye", BYE_S if self.life.run_lost_one else None)
            self.life.end()

    def abandon(self) -> None:
        """End the heartbeats of a driver that is no longer used; the collector of garbage may not wait."""
        self.life.ended.set()

    def _close_sockets(self) -> None:
        """Called by the thread of the heartbeat, which uses a socket, after the connection was closed."""
        self.control.close()
        self._calls.close()


def served_context(name: str, context: Context) -> dict[str, Any]:
    """What of the context the server's driver is constructed with."""
    return {
        "name": name,
        "grid": context.grid,
        "motion": context.motion,
        "lines": list(context.lines),
        "calibrations": dict(context.calibrations),
    }


def _keys(settings: RemoteSettings) -> tuple[Any, bytes | None]:
    """The keys for a connection: this computer's, and the server's public one."""
    if settings.plain:
        return None, None
    root = wire.keys_root()
    name = settings.server_key or settings.host
    return wire.find_keys(root), wire.read_public(root / "known" / f"{name}.key")
