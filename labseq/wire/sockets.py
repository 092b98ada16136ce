"""Sockets of ZeroMQ: encrypted by CURVE for known keys, without it on this computer only."""

from __future__ import annotations

import re
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

from labseq.errors import ConfigError, Problem
from labseq.messages import clean, install_hint
from labseq.wire.messages import MAX_PART

if TYPE_CHECKING:
    import zmq

    from labseq.wire.keys import Keys

PROTOCOL: Final = 1
"""Version of the messages; both computers need the same."""
BEAT_S: Final = 0.15
"""Interval of the heartbeats of a connection."""
LOST_S: Final = 0.75
"""A connection without a heartbeat for so long is lost."""
PATIENT_S: Final = 5.0
"""The same for a simulation, which has no outputs that could stay on."""

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
        ValueError: It is no address.

    Example:
        >>> parse_address("tcp://camera-pc:5760")
        ('camera-pc', 5760)
    """
    found = _ADDRESS.fullmatch(address)
    if found is None or not 0 < int(found[2]) < 65_536:
        raise ValueError(
            f"'{clean(address)}' is no address; expected tcp://HOST:PORT, as tcp://camera-pc:5760"
        )
    return found[1].strip("[]"), int(found[2])


def client_socket(keys: Keys | None, server: bytes | None, timeout_s: float = -1e-3) -> zmq.Socket[Any]:
    """A DEALER, not connected yet, that connects once: a connection that breaks stays broken.

    Args:
        keys: The keys of this computer; None on this computer only.
        server: The public key of the server; None likewise.
        timeout_s: Longest time that receiving may take; without it, for ever.
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


def server_socket(context: zmq.Context[Any], host: str, port: int, keys: Keys | None) -> zmq.Socket[Any]:
    """A ROUTER that listens.

    Raises:
        ConfigError: The address cannot be used.
    """
    import zmq

    socket = context.socket(zmq.ROUTER)
    _limit(socket)
    if keys is not None:
        socket.zap_domain = b"labseq"
        socket.curve_server, socket.curve_secretkey = True, keys.secret
    try:
        socket.bind(endpoint(host, port))
    except zmq.ZMQError as error:
        socket.close()
        hint = "choose another one with --bind; perhaps the server is already running"
        raise ConfigError(Problem(f"{host}:{port} cannot be used: {error.strerror}", hint=hint)) from error
    return socket


def _limit(socket: zmq.Socket[Any]) -> None:
    import zmq

    for option, value in ((zmq.LINGER, 0), (zmq.MAXMSGSIZE, MAX_PART), (zmq.SNDTIMEO, 1000), (zmq.IPV6, 1)):
        socket.set(option, value)
