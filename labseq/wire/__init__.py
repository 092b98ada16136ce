"""Messages between computers, with their values, keys and sockets, for remote devices and their server."""

from labseq.processes import is_loopback
from labseq.wire.keys import find_keys, keys_root, known_keys, new_keys, read_public
from labseq.wire.messages import MessageError, error_of, pack, report_error, unpack
from labseq.wire.sockets import (
    BEAT_S,
    HANDSHAKE_S,
    LOST_S,
    PROTOCOL,
    Connections,
    client_socket,
    endpoint,
    parse_address,
    require_packages,
    server_socket,
)

__all__ = [
    "BEAT_S",
    "HANDSHAKE_S",
    "LOST_S",
    "PROTOCOL",
    "Connections",
    "MessageError",
    "client_socket",
    "endpoint",
    "error_of",
    "find_keys",
    "is_loopback",
    "keys_root",
    "known_keys",
    "new_keys",
    "pack",
    "parse_address",
    "read_public",
    "report_error",
    "require_packages",
    "server_socket",
    "unpack",
]
