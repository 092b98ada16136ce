"""Messages between computers, their keys and sockets."""

from __future__ import annotations

from labseq.wire import (
    BEAT_S,
    LOST_S,
    PROTOCOL,
    MessageError,
    client_socket,
    endpoint,
    error_of,
    find_keys,
    is_loopback,
    keys_root,
    pack,
    parse_address,
    read_public,
    report_error,
    require_packages,
    unpack,
)

__all__ = [
    "BEAT_S",
    "LOST_S",
    "PROTOCOL",
    "MessageError",
    "client_socket",
    "endpoint",
    "error_of",
    "find_keys",
    "is_loopback",
    "keys_root",
    "pack",
    "parse_address",
    "read_public",
    "report_error",
    "require_packages",
    "unpack",
]
