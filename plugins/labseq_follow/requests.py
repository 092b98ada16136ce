"""Reads the requests in the lines of a control system."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, cast

VALUE: Final = re.compile(r"""(?:^|\s)([A-Za-z_][\w.-]*)=("[^"]*"|'[^']*'|\S*)(?=\s|$)""")
"""An address and its value. A value with spaces is in quotation marks."""
TAKES_VALUES: Final = ("go", "set")


@dataclass(frozen=True, slots=True)
class Request:
    """A line of a control system.

    Attributes:
        word: Kind of request, such as "go".
        text: The rest of the line, without the values.
        values: Address -> value as for ``--set``.
        problem: Why the values cannot be read, or "".
    """

    word: str
    text: str = ""
    values: Mapping[str, str] = field(default_factory=dict[str, str])
    problem: str = ""


def read_request(line: str, *, with_values: bool) -> Request:
    """Read a line of words, or a JSON object like ``{"go": "run 17", "values": {"shot.hold.duration": 2}}``.

    Args:
        with_values: Whether "key=value" in a line of words is a value. In version 2 it is text.

    Example:
        >>> read_request('go run 17 shot.hold.duration="5 ms"', with_values=True).values
        {'shot.hold.duration': '5 ms'}
    """
    line = line.strip()
    if line.startswith("{"):
        return _read_object(line)
    word, _, text = line.partition(" ")
    if word not in TAKES_VALUES or not with_values:
        return Request(word, text.strip())
    pairs = [(key, value[1:-1] if value[:1] in ("'", '"') else value) for key, value in VALUE.findall(text)]
    return Request(word, " ".join(VALUE.sub(" ", text).split()), dict(pairs), _twice(key for key, _ in pairs))


def _read_object(line: str) -> Request:
    """Read a JSON object. If it begins like a `go`, it is a `go`, because it may be answered already."""
    begins = re.match(r'\{\s*"(\w+)"', line)
    word = begins[1] if begins else ""
    if word not in TAKES_VALUES:
        return Request(line)
    pairs: list[tuple[str, Any]] = []

    def keep(members: list[tuple[str, Any]]) -> dict[str, Any]:
        pairs.append(("", _twice(key for key, _ in members)))
        return dict(members)

    try:
        asked = cast("dict[str, Any]", json.loads(line, object_pairs_hook=keep))
    except ValueError as error:
        return Request(word, problem=f"this is not JSON: {error}")
    values = asked.get("values", {}) if word == "go" else asked.get(word)
    extra = {*asked} - {word, *(["values"] if word == "go" else [])}
    problem = next((text for _, text in pairs if text), "")
    if extra or not isinstance(values, dict):
        problem = 'expected {"go": TEXT, "values": {ADDRESS: VALUE}} or {"set": {ADDRESS: VALUE}}'
        return Request(word, problem=problem)
    texts = {
        address: value if isinstance(value, str) else json.dumps(value)
        for address, value in cast("dict[str, Any]", values).items()
    }
    return Request(word, str(asked["go"]) if word == "go" else "", texts, problem)


def _twice(keys: Iterable[str]) -> str:
    seen = set[str]()
    for key in keys:
        if key in seen:
            return f"'{key}' is given twice"
        seen.add(key)
    return ""
