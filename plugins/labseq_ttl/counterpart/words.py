"""The arguments of a command, as the model of the box reads them."""

from __future__ import annotations

from labseq_ttl.protocol import OUTPUTS


class RefusedError(Exception):
    """The box refuses a command."""


def numbers(words: list[str], *most: int) -> list[int]:
    """Hexadecimal numbers, each at most so large; of a mask every bit must be an output."""
    if len(words) != len(most):
        raise RefusedError("arguments")
    read: list[int] = []
    for word, limit in zip(words, most, strict=True):
        if not 1 <= len(word) <= 8 or not set(word) <= set("0123456789abcdefABCDEF"):
            raise RefusedError("arguments")
        number = int(word, 16)
        if number > limit or (limit == OUTPUTS and number & ~OUTPUTS):
            raise RefusedError("arguments")
        read.append(number)
    return read
