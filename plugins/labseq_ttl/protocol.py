"""The protocol of the box, as in ``firmware/PROTOCOL.md``, and its limits."""

from __future__ import annotations

import binascii
from typing import Final, TypeAlias

NAME: Final = "labseq-ttl"
"""Name that the box reports."""

VERSION: Final = 2
"""Version of the protocol."""

STOP: Final = b"!"
"""The byte that turns all lines off at once, whatever the box is doing."""

CHANNELS: Final = (2, 3, 4, 5, 6, 7, 9, 10, 11, 12)
"""Outputs, by the number of the pin on an Arduino."""

OUTPUTS: Final = sum(1 << channel for channel in CHANNELS)
SLOTS: Final = 8
EDGES: Final = 24
"""Edges of a slot."""

TICK_S: Final = 0.5e-6
SHORTEST: Final = 10
"""Ticks between two edges, at least."""

SHORTEST_S: Final = 5e-6
"""The same in seconds."""

LONGEST: Final = 2**32 - 1
"""Ticks between two edges, at most."""

MAX_MS: Final = 0xFFFFF
"""Longest deadline of a leader, in ms."""

LINE: Final = 96
"""Longest line in bytes, checksum included."""

PER_LINE: Final = 5
"""Edges that fit on a line, however long their numbers are."""

DEAF: Final = 0
"""State of the box towards a leader in which it ignores the start input."""

IDLE: Final = 1
"""It waits for `go`."""

OWED: Final = 2
"""`go` came, and needs an answer."""

LATE: Final = 3
"""The deadline of the answer has passed, so the leader received `failed`."""

Edge: TypeAlias = tuple[int, int]
"""Ticks since the edge before, and the channels that are on from then on, bit n for channel n."""


def checksum(text: bytes) -> int:
    """CRC-16/IBM-3740 (also known as CCITT-FALSE), with polynomial 0x1021, begun with 0xFFFF.

    Example:
        >>> hex(checksum(b"123456789"))
        '0x29b1'
    """
    return binascii.crc_hqx(text, 0xFFFF)


def framed(text: str) -> bytes:
    r"""Add checksum and line end to a text.

    Example:
        >>> framed("a id")
        b'a id*b0f0\n'
    """
    return f"{text}*{checksum(text.encode()):04x}\n".encode()


def unframed(line: bytes) -> str | None:
    """The text of a line, None if it is damaged.

    Args:
        line: Without its end.

    Example:
        >>> unframed(b"a id*b0f0"), unframed(b"a ie*b0f0")
        ('a id', None)
    """
    text, star, given = line.rpartition(b"*")
    if not star or len(given) != 4 or not text.isascii():
        return None
    try:
        return text.decode() if int(given, 16) == checksum(text) else None
    except ValueError:
        return None
