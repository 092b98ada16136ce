"""Text for buffers of C."""

from __future__ import annotations

import ctypes

from labseq_andor.codes import Code


def put_text(address: int, text: str, length: int = 256) -> int:
    """Write text with its closing zero to an address; ``length`` bytes at most."""
    encoded = text.encode()[: length - 1] + b"\0"
    ctypes.memmove(address, encoded, len(encoded))
    return Code.SUCCESS
