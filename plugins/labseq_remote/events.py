"""Why a connection could not be made, from the events of its socket."""

from __future__ import annotations

from typing import Any


def reason_of(monitor: Any) -> str:
    """The reason in words; "" if the socket was connected.

    Args:
        monitor: Its monitor socket.
    """
    import zmq
    from zmq.utils.monitor import recv_monitor_message

    seen: set[int] = set()
    while monitor.poll(0):
        seen.add(int(recv_monitor_message(monitor)["event"]))
    if zmq.EVENT_HANDSHAKE_SUCCEEDED in seen:
        return ""
    if zmq.EVENT_HANDSHAKE_FAILED_AUTH in seen:
        what = "the server does not know the key of this computer, or no longer"
        return f"{what}: its public key must be in the folder `known` there"
    if zmq.EVENT_CONNECTED in seen:
        what = "it is no server of devices, or the keys do not fit"
        return f"{what}: both need keys, and each the public key of the other"
    return "nothing answers there; is `labseq serve-devices` running, and its port open in the firewall?"
