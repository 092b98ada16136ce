"""Words for error messages: values as the user wrote them, lists, the nearest name.

Under YAML 1.1, PyYAML's default, ``do: off`` is False, ``10:30`` is 630 and
``2026-01-01`` a date. Here they are text.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sized
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, cast

from labseq.config.yaml_nodes import resolve
from labseq.errors import ConfigError, Problem
from labseq.messages import did_you_mean, shown

_MAPPING: Final = "a mapping (key: value)"
_LIST: Final = "a list ([a, b], or lines that begin with '- ')"
EXPECTED_TYPES: Final[Mapping[str, str]] = {
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float", "int_parsing_size"), "a whole number"),
    **dict.fromkeys(("float_type", "float_parsing", "decimal_type", "decimal_parsing"), "a number"),
    **dict.fromkeys(("string_type", "string_sub_type", "path_type"), "text"),
    **dict.fromkeys(("list_type", "tuple_type", "set_type", "frozen_set_type", "iterable_type"), _LIST),
    **dict.fromkeys(("dict_type", "mapping_type", "model_type", "dataclass_type"), _MAPPING),
    "model_attributes_type": _MAPPING,
    "none_required": "nothing",
}
"""pydantic's error types that say "this is a wrong type", and the right one in words."""

_LIMITS: Final[Mapping[str, tuple[str, str]]] = {
    "greater_than": ("more than", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("less than", "lt"),
    "less_than_equal": ("at most", "le"),
    "multiple_of": ("a multiple of", "multiple_of"),
}
_LENGTHS: Final[Mapping[str, tuple[str, str, str]]] = {
    "too_short": ("at least", "min_length", "entries"),
    "too_long": ("at most", "max_length", "entries"),
    "string_too_short": ("at least", "min_length", "characters"),
    "string_too_long": ("at most", "max_length", "characters"),
}
_ONE: Final = {"entries": "entry", "characters": "character"}


@dataclass(frozen=True, slots=True)
class ErrorText:
    """What is wrong, what was expected, what to do."""

    what: str
    expected: str = ""
    hint: str = ""


def explain_validation_error(error: Mapping[str, Any], name: str, value: Any, raw: str) -> ErrorText:
    """Put an error of pydantic into a physicist's words.

    Args:
        error: One of ``ValidationError.errors()``, neither "missing" nor "extra_forbidden".
        name: Name of the setting.
        value: Its value in the file.
        raw: Its value as it is written, or "".
    """
    kind, context = str(error["type"]), error.get("ctx", {})
    what = f"{name} is {shown(value, raw)}" if name else f"this is {shown(value, raw)}"
    if kind == "setting_error":
        return ErrorText(context["what"], context["expected"], context["hint"])
    if kind in ("value_error", "assertion_error"):
        return _own_words(str(context.get("error", error["msg"])), name, what)
    if kind in EXPECTED_TYPES:
        return ErrorText(what, EXPECTED_TYPES[kind], _meant(kind, value))
    if kind in _LIMITS:
        words, key = _LIMITS[kind]
        return ErrorText(what, f"{words} {_limit(context[key], isinstance(value, str))}")
    if kind in _LENGTHS:
        words, key, unit = _LENGTHS[kind]
        n = len(cast("Sized", value))
        return ErrorText(f"{name} has {n} {_ONE[unit] if n == 1 else unit}", f"{words} {context[key]}")
    if kind == "finite_number":
        return ErrorText(what, "a finite number")
    if kind in ("literal_error", "enum"):
        choices = re.findall(r"'([^']*)'", context["expected"])
        hint = did_you_mean(str(value), choices) if len(choices) > 1 else ""
        return ErrorText(what, context["expected"], hint)
    if kind == "union_tag_invalid":
        tags = context["expected_tags"]
        hint = did_you_mean(str(context["tag"]), re.findall(r"'([^']*)'", tags))
        setting = context["discriminator"].strip("'")
        return ErrorText(f"{setting} is {shown(context['tag'])}", tags, hint)
    if kind == "union_tag_not_found":
        return ErrorText(f"{context['discriminator']} is missing from '{name}'")
    message = str(error["msg"])
    expected = message.removeprefix("Input should be ")
    return ErrorText(what, expected) if expected != message else ErrorText(f"{name}: {message}")


def _own_words(text: str, name: str, plain: str) -> ErrorText:
    """The text of a validator, on one line and parted at "; expected"."""
    text = " ".join(text.split())
    if text.startswith("expected "):
        return ErrorText(plain, text.removeprefix("expected "))
    what, _, rest = text.partition("; expected ")
    expected, _, hint = rest.partition("; ")
    return ErrorText(f"{name}: {what}" if name else what, expected, hint)


def _limit(limit: Any, is_text: bool) -> str:
    text = f"{limit:g}" if isinstance(limit, float) else str(limit)
    return f"{text} (in SI units)" if is_text and limit != 0 else text


def _meant(kind: str, value: Any) -> str:
    """What the writer of a text probably meant, where a number or a switch was expected."""
    if not isinstance(value, str):
        is_word = isinstance(value, bool | int | float) and kind == "string_type"
        return "put it in quotes" if is_word else ""
    if kind.startswith("bool"):
        word = value.lower()
        meant = "true" if word in ("yes", "on") else "false" if word in ("no", "off") else ""
        return f"did you mean {meant}?" if meant else ""
    if kind.startswith(("int", "float")):
        try:
            number = resolve(value.replace("_", ""))
        except ValueError:
            return ""
        is_right = type(number) is int or (type(number) is float and kind.startswith("float"))
        hint = f"did you mean {number}?" if "_" in value else f"write {number} without quotes"
        return hint if is_right else ""
    return ""


class ProblemCollector:
    """Problems of several checks, so that the user sees them all at once.

    Example:
        >>> found = Collected()
        >>> with found:
        ...     raise ConfigError("shots is 0")
        >>> with found:
        ...     raise ConfigError("name is missing")
        >>> found.raise_any()
        Traceback (most recent call last):
        ...
        labseq.errors.ConfigError: shots is 0
        name is missing
    """

    def __init__(self) -> None:
        self.problems: list[Problem] = []

    def __enter__(self) -> ProblemCollector:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, ConfigError):
            return False
        self.add(error)
        return True

    def add(self, error: ConfigError) -> None:
        """Gather what an error says."""
        self.problems += error.problems

    def stop(self, error: ConfigError) -> ConfigError:
        """An error after which nothing else can be checked, together with what was gathered."""
        self.add(error)
        return self._joined()

    def raise_any(self) -> None:
        """Raise what was gathered, each file's problems in its order.

        Raises:
            ConfigError: Anything was gathered.
        """
        if self.problems:
            raise self._joined()

    def _joined(self) -> ConfigError:
        sources = list(dict.fromkeys(problem.source for problem in self.problems))
        return ConfigError(sorted(self.problems, key=lambda p: (sources.index(p.source), p.line, p.column)))
