"""Turns any value into plain JSON for run.json, the index, the event log and other JSON texts."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Mapping, Set as AbstractSet
from datetime import UTC, date, datetime, time as time_of_day
from enum import Enum
from pathlib import PurePath
from typing import Any, Final, cast

_MAX_DEPTH: Final = 32
_MAX_PARTS: Final = 500_000


def to_plain(value: Any) -> Any:
    """Turn any value into a value that JSON can hold. Never raises.

    nan and infinities become None, numpy scalars and arrays plain numbers and lists, keys text. A dataclass
    becomes the result of its ``as_json()``, or a mapping of its fields. Anything else becomes its ``repr``.

    Example:
        >>> import numpy as np
        >>> to_plain({1: np.float32(0.5), "b": (float("nan"), np.arange(2))})
        {'1': 0.5, 'b': [None, [0, 1]]}
    """
    return _plain(value, ())


def now() -> datetime:
    """The computer's clock. It may be set at any time, so durations need a monotonic clock."""
    return datetime.fromtimestamp(time.time(), UTC)


def now_utc(timespec: str = "microseconds") -> str:
    """The computer's clock as text for time stamps, ISO 8601, UTC."""
    return now().isoformat(timespec=timespec)


def dumps(value: Any, *, indent: int | None = None) -> str:
    """Any value as JSON, by way of :func:`to_plain`, on one line unless indented.

    Example:
        >>> dumps({"t_s": float("inf")})
        '{"t_s": null}'
    """
    text = json.dumps(to_plain(value), ensure_ascii=False, allow_nan=False, indent=indent)
    # Lone surrogates, left over from undecodable bytes, have no UTF-8; "\udc80" is its JSON escape.
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def plain_text(text: str) -> str:
    r"""Text that every file format accepts, without NUL characters and lone surrogates.

    Example:
        >>> print(plain_text("a\0b"))
        a\x00b
    """
    return text.replace("\0", r"\x00").encode("utf-8", "backslashreplace").decode("utf-8")


def _plain(value: Any, parents: tuple[int, ...]) -> Any:
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, int) and not isinstance(value, Enum):
        # Python refuses to write much longer integers in decimal
        return int(value) if value.bit_length() <= 4096 else hex(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, PurePath):
        return str(value)
    if id(value) in parents or len(parents) >= _MAX_DEPTH:
        return _repr(value)
    try:
        return _plain_container(value, (*parents, id(value)))
    except Exception:  # noqa: BLE001 - a plugin's container may raise anything
        return _repr(value)


def _plain_container(value: Any, parents: tuple[int, ...]) -> Any:
    if isinstance(value, Enum):
        return _plain(value.value, parents)
    if hasattr(value, "tolist"):  # arrays and scalars of numpy
        return _plain(value.tolist(), parents)
    if isinstance(value, Mapping):
        items = cast("Mapping[Any, Any]", value).items()
        return {_key(key): _plain(item, parents) for key, item in items}
    if isinstance(value, (list, tuple)):
        return [_plain(item, parents) for item in cast("list[Any]", value)]
    if isinstance(value, AbstractSet):
        return [_plain(item, parents) for item in sorted(cast("AbstractSet[Any]", value), key=_repr)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        as_json: Any = getattr(value, "as_json", None)
        if as_json is not None:
            return _plain(as_json(), parents)
        return {item.name: _plain(getattr(value, item.name), parents) for item in dataclasses.fields(value)}
    if isinstance(value, date | time_of_day):
        return value.isoformat()
    return _repr(value)


def _key(key: Any) -> str:
    return key if isinstance(key, str) else str(_plain(key, ()))


def _repr(value: Any) -> str:
    try:
        return repr(value)
    except Exception:  # noqa: BLE001 - a plugin's repr may raise anything
        return f"<{type(value).__name__}>"


def parse_object(data: bytes) -> dict[str, Any] | None:
    """Read a JSON object. None if it is anything else, is nested too deep, or has too many parts."""
    if data[:1].isalnum():  # a million of such lines would take 10 s
        return None
    try:
        value = parse_value(data)
    except ValueError:
        return None
    return cast("dict[str, Any]", value) if isinstance(value, dict) else None


def parse_value(data: bytes | str) -> Any:
    """Read JSON with at most 32 levels and 500,000 lists and objects.

    Raises:
        ValueError: It is not JSON, is nested deeper, or has more parts.
    """
    text = data if isinstance(data, str) else data.decode("latin-1")
    n_parts = text.count("[") + text.count("{")
    if n_parts > _MAX_PARTS:
        raise ValueError(f"it has more than {_MAX_PARTS:,} lists and objects")
    try:
        value = json.loads(data)
    except RecursionError:
        raise ValueError("it is nested too deep") from None
    if n_parts > _MAX_DEPTH and _is_too_deep(value):
        raise ValueError("it is nested too deep")
    return value


def _is_too_deep(value: Any) -> bool:
    level: list[Any] = [value]
    for _ in range(_MAX_DEPTH):
        level = [item for item in level if isinstance(item, dict | list)]
        if not level:
            return False
        inner = [item.values() if isinstance(item, dict) else item for item in level]
        level = [item for several in inner for item in several]
    return any(isinstance(item, dict | list) for item in level)
