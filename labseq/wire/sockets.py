"""Sockets of ZeroMQ, encrypted by CURVE for known keys, or without encryption only on this computer."""

from __future__ import annotations

import re
from collections import Counter
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

from labseq.errors import ConfigError, Problem
from labseq.messages import clean, install_hint
from labseq.wire.messages import MAX_PART

if TYPE_CHECKING:
    import zmq

    from labseq.wire.keys import Keys

PROTOCOL: Final = 2
"""Version of the messages. Both computers need the same."""
BEAT_S: Final = 0.15
"""Interval of the heartbeats of a connection, in seconds."""
LOST_S: Final = 0.75
"""A connection without a heartbeat for this long is lost, in seconds."""
HANDSHAKE_S: Final = 2.0
"""Longest time for a client to show its key, in seconds."""
MAX_WAITING: Final = 4
"""Messages of a connection that wait to be read. Few, because a client waits for each reply."""
MAX_REPLIES: Final = 8
"""Replies to a connection that wait to be sent. A client that does not read loses further ones."""

_ADDRESS: Final = re.compile(r"tcp://(\[[0-9A-Fa-f:.]+\]|[^\s:/\[\]@]+):(\d{1,5})")


def require_packages() -> None:
    """Check that the extra is installed.

    Raises:
        ConfigError: A package is missing.
    """
    for name, package in (("zmq", "pyzmq"), ("msgpack", "msgpack")):
        if find_spec(name) is None:
            what = f"devices on other computers need {package}, which is not installed"
            raise ConfigError(Problem(what, hint=install_hint("remote")))


def parse_address(address: str) -> tuple[str, int]:
    """Host and port of an address.

    Raises:
        ValueError: It is not an address.

    Example:
        >>> parse_address("tcp://camera-pc:5760")
        ('camera-pc', 5760)
    """
    match = _ADDRESS.fullmatch(address)
    if match is None or not 0 < int(match[2]) < 65_536:
        raise ValueError(
            f"'{clean(address)}' is not an address; expected tcp://HOST:PORT, such as tcp://camera-pc:5760"
        )
    return match[1].strip("[]"), int(match[2])


def client_socket(keys: Keys | None, server: bytes | None, timeout_s: float = -1e-3) -> zmq.Socket[Any]:
    """A DEALER socket, not connected yet. It never reconnects, because a broken connection ends the session.

    Args:
        keys: The keys of this computer. None for a server on this computer.
        server: The public key of the server. None for a server on this computer.
        timeout_s: Longest time to wait for a message, in seconds. Default unlimited.
    """
    import zmq

    socket = zmq.Context.instance().socket(zmq.DEALER)
    _limit(socket)
    socket.set(zmq.RECONNECT_IVL, -1)
    socket.set(zmq.RCVTIMEO, round(1e3 * timeout_s))
    if keys is not None and server is not None:
        socket.curve_publickey, socket.curve_secretkey, socket.curve_serverkey = (
            keys.public,
            keys.secret,
            server,
        )
    return socket


def endpoint(host: str, port: int) -> str:
    """The address of a port, for ZeroMQ."""
    host = "127.0.0.1" if host == "localhost" else host
    return f"tcp://{f'[{host}]' if ':' in host else host}:{port}"


def server_socket(context: zmq.Context[Any], address: str, keys: Keys | None) -> zmq.Socket[Any]:
    """A ROUTER socket that listens only at an address of this computer, in ZeroMQ's notation."""
    import zmq

    socket = context.socket(zmq.ROUTER)
    _limit(socket)
    socket.set(zmq.HANDSHAKE_IVL, round(1e3 * HANDSHAKE_S))
    socket.set(zmq.RCVHWM, MAX_WAITING)
    socket.set(zmq.SNDHWM, MAX_REPLIES)
    # A ROUTER that always has a message to read seldom checks which replies were sent, and would drop a reply
    # to a client that reads all of them. With these options it checks before it gives up.
    socket.set(zmq.ROUTER_MANDATORY, 1)
    socket.set(zmq.SNDTIMEO, 1)
    if keys is not None:
        socket.zap_domain = b"labseq"
        socket.curve_server, socket.curve_secretkey = True, keys.secret
    socket.bind(address)
    return socket


class Connections:
    """The connections at a server's socket, which end as soon as the client's process dies.

    The operating system reuses the number of an ended connection. So a connection is named by two
    numbers, which are that number and how many connections had it before.

    Args:
        socket: The listening socket. Used in the thread of the socket.
    """

    def __init__(self, socket: zmq.Socket[Any]) -> None:
        import zmq
        from zmq.utils.monitor import recv_monitor_message  # now, as later it may be impossible to open files

        self._receive_event = recv_monitor_message
        self._socket = socket
        self._events = socket.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        self._n_before: Counter[int] = Counter()
        self._ended: set[tuple[int, int]] = set()

    def named(self, number: int) -> tuple[int, int]:
        """The connection that now has a number."""
        self._read()
        return number, self._n_before[number]

    def ended(self) -> set[tuple[int, int]]:
        """The connections that have ended since the last call."""
        self._read()
        ended, self._ended = self._ended, set()
        return ended

    def _read(self) -> None:
        import zmq

        while self._events.poll(0):
            event = self._receive_event(self._events)
            number = int(event["value"])
            if event["event"] == zmq.EVENT_DISCONNECTED:
                self._ended.add((number, self._n_before[number]))
            else:
                self._n_before[number] += 1

    def close(self) -> None:
        """Stop watching. Call it before the socket is closed."""
        self._socket.disable_monitor()
        self._events.close()


def _limit(socket: zmq.Socket[Any]) -> None:
    import zmq

    for option, value in ((zmq.LINGER, 0), (zmq.MAXMSGSIZE, MAX_PART), (zmq.SNDTIMEO, 1000), (zmq.IPV6, 1)):
        socket.set(option, value)
