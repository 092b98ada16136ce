"""Types, limits and defaults of settings as written in YAML, and docstrings as Markdown."""

from __future__ import annotations

import inspect
import math
import re
import textwrap
import types
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from labseq.config.yaml_nodes import compose
from labseq.errors import ConfigError
from labseq.settings import Choice, Setting, dimension_read_by, has_settings
from labseq.units import EXAMPLES, format_quantity, parse_quantity

_NOUNS: Final[dict[Any, str]] = {
    bool: "true or false",
    int: "whole number",
    float: "number",
    str: "text",
    Path: "path of a file",
    Any: "any value",
}


@dataclass(frozen=True, slots=True)
class Words:
    """The allowed values of a setting.

    Attributes:
        noun: Type such as "whole number" or "list of times".
        limits: Limits such as "at least 1", or "".
    """

    noun: str
    limits: str = ""

    def __str__(self) -> str:
        return f"{self.noun}; {self.limits}" if self.limits else self.noun


def value_of(setting: Setting) -> str:
    """The allowed values of a setting: its type, an example if no default shows one, and its limits."""
    words = _words(setting.annotation, ())
    if setting.dimension and setting.is_required:
        words = Words(f"{words.noun} such as `{EXAMPLES[setting.dimension]}`", words.limits)
    return str(words)


def default_of(setting: Setting) -> str:
    """The default as it would be written in a file, or "required", or "none"."""
    if setting.is_required:
        return "required"
    return "none" if setting.default is None else f"`{_written(setting.default, setting.dimension)}`"


def _words(annotation: Any, metadata: Sequence[Any]) -> Words:
    if get_origin(annotation) is Annotated:
        plain, *more = get_args(annotation)
        return _words(plain, [*more, *metadata])
    flat = [part for item in metadata for part in (item.metadata if isinstance(item, FieldInfo) else [item])]
    dimension = next(filter(None, map(dimension_read_by, flat)), "")
    value = Words(dimension) if dimension else _noun(annotation)
    limits = [value.limits, _limits(flat, dimension), _lengths(flat, annotation)]
    return Words(value.noun, ", ".join(filter(None, limits)))


def _noun(annotation: Any) -> Words:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        return _union([_words(kind, ()) for kind in inner if kind is not type(None)])
    if origin is Literal:
        return Words(_either([f"`{_written(value, '')}`" for value in inner]))
    if origin is dict:
        return Words(f"mapping of names to {_plural(_words(inner[1], ()).noun)}")
    if origin is list or (origin is tuple and inner[-1] is Ellipsis):
        return _list("", _words(inner[0], ()))
    if origin is tuple:
        return _list(f"{len(inner)} ", _words(inner[0], ()))
    if isinstance(annotation, type) and issubclass(annotation, Choice):
        return Words(f"mapping with `{annotation.key}`")
    if has_settings(annotation):
        return Words("mapping")
    return Words(_NOUNS.get(annotation) or annotation.__name__.removesuffix("Spec").lower())


def _list(length: str, item: Words) -> Words:
    return Words(f"list of {length}{_plural(item.noun)}", f"each {item.limits}" if item.limits else "")


def _union(members: Sequence[Words]) -> Words:
    nouns = sorted(dict.fromkeys(words.noun for words in members), key=lambda noun: " or " not in noun)
    if "number" in nouns and "whole number" in nouns:
        nouns.remove("whole number")
    limits = dict.fromkeys(words.limits.removeprefix("each ") for words in members if words.limits)
    return Words(_either(nouns), "; ".join(limits))


def _either(nouns: Sequence[str]) -> str:
    return " or ".join(filter(None, (", ".join(nouns[:-1]), nouns[-1])))


def _plural(noun: str) -> str:
    if noun.startswith(("list ", "mapping ")):
        return re.sub(r"^\w+", lambda word: f"{word[0]}s", noun)
    if " or " in noun:
        return noun
    return f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"


def _limits(metadata: Sequence[Any], dimension: str) -> str:
    """The tightest lower and upper limit in words."""
    low = max(
        [(i.ge, False) for i in metadata if isinstance(i, Ge)]
        + [(i.gt, True) for i in metadata if isinstance(i, Gt)],
        default=None,
    )
    high = min(
        [(i.le, True) for i in metadata if isinstance(i, Le)]
        + [(i.lt, False) for i in metadata if isinstance(i, Lt)],
        default=None,
    )
    if low and high and not low[1] and high[1]:
        return f"{_limit(low[0], dimension)} to {_limit(high[0], dimension)}"
    texts: list[str] = []
    if low:
        texts.append(f"{'more than' if low[1] else 'at least'} {_limit(low[0], dimension)}")
    if high:
        texts.append(f"{'at most' if high[1] else 'less than'} {_limit(high[0], dimension)}")
    return ", ".join(texts)


def _limit(value: Any, dimension: str) -> str:
    if dimension and value:
        return format_quantity(value, dimension)
    power = value.bit_length() - 1 if isinstance(value, int) else 0
    return f"2^{power}" if power > 30 and value == 2**power else f"{value:,}"


def _lengths(metadata: Sequence[Any], annotation: Any) -> str:
    unit = "characters" if annotation is str else "entries"
    least = max((i.min_length for i in metadata if isinstance(i, MinLen)), default=0)
    most = min((i.max_length for i in metadata if isinstance(i, MaxLen)), default=0)
    if most:
        return f"{least} to {most} {unit}"
    return "not empty" if least == 1 else f"at least {least} {unit}" if least else ""


def _written(value: Any, dimension: str) -> str:
    """A value as YAML, a quantity with its unit."""
    if value is PydanticUndefined or value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(_written(item, dimension) for item in value)}]"
    if isinstance(value, int | float) and dimension:
        return _quantity(value, dimension)
    if isinstance(value, str):
        return _text(value)
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _text(value: str) -> str:
    """Text as YAML, in quotes if YAML would otherwise read something else."""
    try:
        read = compose(f"[{value}]", "")
    except ConfigError:
        read = None
    return value if read is not None and read.plain() == [value] else f'"{value}"'


def _quantity(value: float, dimension: str) -> str:
    """A quantity as YAML, with enough digits to be read back unchanged."""
    texts = (format_quantity(value, dimension, digits) for digits in range(3, 16))
    return next((t for t in texts if math.isclose(parse_quantity(t, dimension), value)), str(value))


_ITEM: Final = re.compile(r"^(\*{0,2}\w+): ", re.MULTILINE)


def summary(*documented: object) -> str:
    """The first paragraph of the first available docstring, on one line."""
    # Other objects have the docstring of their class, which says nothing about the object.
    objects = (item for item in documented if inspect.isroutine(item) or isinstance(item, type))
    texts = (" ".join(_sections(item)[""].partition("\n\n")[0].split()) for item in objects)
    return next(filter(None, texts), "")


def docstring(documented: object) -> str:
    """A docstring as Markdown without its examples, with a list for each section."""
    texts: list[str] = []
    for title, text in _sections(documented).items():
        if not title:
            texts.append(text)
        elif title != "Example":
            shown_title = {"Args": "Arguments", "Attributes": "Fields"}.get(title, title)
            texts.append(f"{shown_title}:\n\n{_items(text)}")
    return "\n\n".join(texts)


def _sections(documented: object) -> dict[str, str]:
    """The text of a Google-style docstring by section. The key of the text before them is ""."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", inspect.getdoc(documented) or "").replace("``", "`")
    before, *sections = re.split(r"^(Args|Attributes|Example|Raises|Returns):$", text, flags=re.MULTILINE)
    bodies = [textwrap.dedent(body.strip("\n")) for body in sections[1::2]]
    return {"": before.strip(), **dict(zip(sections[::2], bodies, strict=True))}


def _items(text: str) -> str:
    items = [" ".join(item.split()) for item in re.split(r"\n(?=\S)", text.strip())]
    if not all(_ITEM.match(item) for item in items):
        return text
    return "\n".join(_ITEM.sub(r"- `\1`: ", item, count=1) for item in items)
