"""What an unquoted YAML scalar means: the core schema of YAML 1.2, and nothing else.

Under YAML 1.1, PyYAML's default, ``do: off`` is False, ``10:30`` is 630 and
``2026-01-01`` a date. Here they are text.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from labseq.config.nodes import Scalar

_WORDS: Final[dict[str, Scalar]] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
    **{sign + word: float(sign + "inf") for sign in ("", "+", "-") for word in (".inf", ".Inf", ".INF")},
}
_INT: Final = re.compile(r"[-+]?[0-9]+\Z")
_OCTAL: Final = re.compile(r"0o[0-7]+\Z")
_HEX: Final = re.compile(r"0x[0-9a-fA-F]+\Z")
_FLOAT: Final = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?\Z")

MAX_DIGITS: Final = 100
"""Longest number, in characters; beyond it Python's own conversion may refuse or crawl."""


def resolve(text: str) -> Scalar:
    """Read an unquoted scalar.

    Raises:
        ValueError: A number of more than :data:`MAX_DIGITS` characters.

    Example:
        >>> resolve("0x10"), resolve("1e3"), resolve("on"), resolve("10:30"), resolve("~")
        (16, 1000.0, 'on', '10:30', None)
    """
    if text in _WORDS:
        return _WORDS[text]
    is_int = _INT.match(text) is not None
    if not (is_int or _FLOAT.match(text) or _OCTAL.match(text) or _HEX.match(text)):
        return text
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number of {len(text)} characters is too long")
    if is_int:
        return int(text, 10)
    return int(text, 0) if text[:2] in ("0x", "0o") else float(text)
