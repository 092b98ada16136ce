"""Answers at a socket, and why there are none, from the events of its connection."""

from __future__ import annotations

import time
from typing import Any


class Monitor:
    """Waits for messages at a socket, from before it connects.

    Args:
        socket: The socket.
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

    def _read_events(self) -> None:
        from zmq.utils.monitor import recv_monitor_message

        while self._events.poll(0):
            self._seen.add(int(recv_monitor_message(self._events)["event"]))

    def close(self) -> None:
        """End it, before the socket is closed."""
        self._socket.disable_monitor()
        self._events.close()

    @property
    def _has_ended(self) -> bool:
        import zmq

        return bool(self._seen & {zmq.EVENT_CLOSED, zmq.EVENT_DISCONNECTED})

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
