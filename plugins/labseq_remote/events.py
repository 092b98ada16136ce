"""Why a connection could not be made, from the events of its socket."""

from __future__ import annotations

from typing import Any


class Monitor:
    """The events of a socket, from before it connects.

    Args:
        socket: The socket.
    """

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._events = socket.get_monitor_socket()
        self._seen: set[int] = set()

    def has_failed(self, timeout_s: float) -> bool:
        """Whether the connection cannot be made, or has ended; waits for an event."""
        import zmq
        from zmq.utils.monitor import recv_monitor_message

        if self._events.poll(int(1e3 * timeout_s)):
            self._seen.add(int(recv_monitor_message(self._events)["event"]))
        return bool(self._seen & {zmq.EVENT_CLOSED, zmq.EVENT_DISCONNECTED})

    def close(self) -> None:
        """End it."""
        self._socket.disable_monitor()
        self._events.close()

    @property
    def reason(self) -> str:
        """Why the connection could not be made; "" if it was."""
        import zmq

        if zmq.EVENT_HANDSHAKE_SUCCEEDED in self._seen:
            return ""
        if zmq.EVENT_HANDSHAKE_FAILED_AUTH in self._seen:
            what = "the server does not know the key of this computer, or no longer"
            return f"{what}: its public key must be in the folder `known` there"
        if zmq.EVENT_CONNECTED in self._seen:
            what = "it is no server of devices, or the keys do not fit"
            return f"{what}: both need keys, and each the public key of the other"
        return "nothing answers there; is `labseq serve-devices` running, and its port open in the firewall?"
