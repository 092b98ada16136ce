"""Converts pydantic's errors to problems, in words that a physicist understands."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, cast

from pydantic import ValidationError

from labseq.config.validation import Finding, ValidationContext, is_list_for_tuple
from labseq.config.yaml_nodes import Node, comma_hint, resolve
from labseq.errors import Loc, Problem
from labseq.messages import clean, closest, did_you_mean, listing, shown
from labseq.settings import Setting, SettingsType, settings_at
from labseq.units import expected as expected_quantity, with_units

MAX_HINTS: Final = 50
"""Maximum number of unknown keys of a mapping that are compared with known keys, which takes time. A file
with more unknown keys is probably of another kind."""


def _is_long_enough(error: Mapping[str, Any]) -> bool:
    """Whether a list is only "too short" because items with errors are not counted."""
    return error["type"] == "too_short" and len(error["input"]) >= error["ctx"]["min_length"]


@dataclass(frozen=True, slots=True)
class _Placed:
    """An error of pydantic with its location in the file.

    Attributes:
        error: pydantic's error.
        loc: Location below the mapping. It may end with a missing key.
        union: Location of the union type in which it occurred, or None.
        branch: The branch of the union.
    """

    error: Mapping[str, Any]
    loc: Loc
    union: Loc | None
    branch: str

    @property
    def kind(self) -> str:
        """The error's name in pydantic."""
        return str(self.error["type"])

    @property
    def is_wrong_type(self) -> bool:
        """Whether the error only means that the value is of another type."""
        return self.kind in _TYPES and self.loc == self.union


def find_problems(
    error: ValidationError, model: SettingsType, top: Node, context: ValidationContext
) -> list[Finding]:
    """Pydantic's errors without their consequences. A misspelt key, for example, is not missing as well."""
    raised = cast("list[Mapping[str, Any]]", error.errors(include_url=False))
    errors = [
        _place(details, top)
        for details in raised
        if not (is_list_for_tuple(details) or _is_long_enough(details))
    ]
    # If a value fits none of several types, only the errors of one type are reported.
    reported = [placed for placed in errors if placed.union is None]
    unions: dict[Loc, list[_Placed]] = {}
    for placed in errors:
        if placed.union is not None:
            unions.setdefault(placed.union, []).append(placed)
    findings: list[Finding] = []
    for union in unions.values():
        if all(placed.is_wrong_type for placed in union):
            findings.append(_no_type_fits(union, top, context))
        else:
            reported += _best_branch(union)
    missing = {placed.loc for placed in reported if placed.kind == "missing"}
    unknown = [placed.loc for placed in reported if placed.kind in _UNKNOWN][:MAX_HINTS]
    meant = {loc: closest(str(loc[-1]), context.known_keys(model, loc[:-1])) for loc in unknown}
    misspelt = {(*loc[:-1], key) for loc, key in meant.items()}
    for placed in reported:
        loc = placed.loc
        if placed.kind in _UNKNOWN:
            findings.append(_unknown_key(loc, meant.get(loc, ""), model, top, context))
        elif placed.kind != "missing":
            findings.append(_wrong_value(placed, top, context))
        elif isinstance(index := loc[-1], int):
            # The last missing item says how many entries are needed.
            if (*loc[:-1], index + 1) not in missing:
                findings.append(_missing_item(loc[:-1], index, top, context))
        elif loc not in misspelt:  # a misspelt key is not also missing
            findings.append(_missing_key(loc, model, top, context))
    return findings


def _place(error: Mapping[str, Any], top: Node) -> _Placed:
    """Follow pydantic's location through the file. Parts that are neither key nor index name a branch."""
    steps: tuple[str | int, ...] = error["loc"]
    loc: Loc = ()
    union: Loc | None = None
    branch = ""
    node = top
    for i, step in enumerate(steps):
        child = node.child(step)
        if child is not None:
            loc, node = (*loc, step), child
        elif error["type"] == "missing" and i == len(steps) - 1:
            loc = (*loc, step)
        elif union is None and step != "[key]":
            union, branch = loc, str(step)
    return _Placed(error, loc, union, branch)


def _best_branch(union: list[_Placed]) -> list[_Placed]:
    """The errors of the most likely branch, in which the longest part is valid."""
    branches: dict[str, list[_Placed]] = {}
    for placed in union:
        branches.setdefault(placed.branch, []).append(placed)

    def fit(errors: list[_Placed]) -> tuple[int, bool, int]:
        is_about_value = not any(placed.is_wrong_type for placed in errors)
        return max(len(placed.loc) for placed in errors), is_about_value, -len(errors)

    return max(branches.values(), key=fit)


def _no_type_fits(union: list[_Placed], top: Node, context: ValidationContext) -> Finding:
    loc = union[0].loc
    node = top.at(loc) or top
    *others, last = dict.fromkeys(_TYPES[placed.kind] for placed in union)
    expected = f"{', '.join(others)} or {last}" if others else last
    return Finding(
        loc, Problem(f"{context.value(loc)} is {shown(node.plain(), node.raw)}", expected=expected)
    )


def _wrong_value(placed: _Placed, top: Node, context: ValidationContext) -> Finding:
    details = placed.error.get("ctx", {})
    at = (details["discriminator"].strip("'"),) if placed.kind == "union_tag_invalid" else ()
    loc = placed.loc + tuple(details.get("at", at))
    if "[key]" in placed.error["loc"]:
        name = f"the key '{clean(str(placed.loc[-1]))}'"
        return Finding(loc, explain(placed.error, name, placed.loc[-1], ""), key=True)
    node = top.at(placed.loc) or top
    problem = explain(placed.error, context.value(placed.loc), node.plain(), node.raw)
    return Finding(loc, problem, bool(details.get("key")))


def _unknown_key(loc: Loc, meant: str, model: SettingsType, top: Node, context: ValidationContext) -> Finding:
    key, node = clean(str(loc[-1])), top.at(loc)
    comma = comma_hint(key, node.value) if node is not None else ""
    known, owner = context.known_keys(model, loc[:-1]), context.mapping(loc[:-1])
    if not known:
        what = f"{owner} takes no settings, but '{key}' is given"
        return Finding(loc, Problem(what, hint=comma or "remove it"), key=True)
    hint = "put a space after the ':'" if ":" in key else f"did you mean '{meant}'?" if meant else ""
    what = f"'{key}' is not a setting of {owner}"
    return Finding(loc, Problem(what, expected=listing(known), hint=comma or hint), key=True)


def _missing_key(loc: Loc, model: SettingsType, top: Node, context: ValidationContext) -> Finding:
    parent, key, around = top.at(loc[:-1]), str(loc[-1]), loc[:-1]
    about = _description(settings_at(model, loc))
    where = f" from {context.mapping(around)}" if context.name or around else ""
    what = f"'{key}' is missing{where}" + (f" ({about})" if about else "")
    known = context.known_keys(model, around)
    others = [k for k in parent.value if k not in known] if parent and isinstance(parent.value, dict) else []
    alike = closest(key, others)
    return Finding(loc, Problem(what, hint=f"did you write '{clean(alike)}' for it?" if alike else ""))


def _missing_item(loc: Loc, index: int, top: Node, context: ValidationContext) -> Finding:
    node = top.at(loc)
    n = len(node.value) if node and isinstance(node.value, list) else 0
    what = f"{context.value(loc)} has {n} {'entry' if n == 1 else 'entries'}"
    return Finding(loc, Problem(what, expected=f"at least {index + 1}"))


def _description(settings: Sequence[Setting]) -> str:
    """First sentence of the description of a setting, or ""."""
    for setting in settings:
        if setting.description:
            sentence = setting.description.split(". ")[0].rstrip(".")
            return sentence[0].lower() + sentence[1:] if sentence[1:2].islower() else sentence
    return ""


_UNKNOWN: Final = ("extra_forbidden", "unexpected_keyword_argument")
"""pydantic's errors for an unknown key of a model and of a dataclass."""
_MAPPING: Final = "a mapping (key: value)"
_LIST: Final = "a list ([a, b], or lines that begin with '- ')"
_TYPES: Final[Mapping[str, str]] = {
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float", "int_parsing_size"), "a whole number"),
    **dict.fromkeys(("float_type", "float_parsing", "decimal_type", "decimal_parsing"), "a number"),
    **dict.fromkeys(("string_type", "string_sub_type", "path_type"), "text"),
    **dict.fromkeys(("list_type", "tuple_type", "set_type", "frozen_set_type", "iterable_type"), _LIST),
    **dict.fromkeys(("dict_type", "mapping_type", "model_type", "dataclass_type"), _MAPPING),
    "model_attributes_type": _MAPPING,
    "none_required": "nothing",
}
"""pydantic's errors that mean "this is the wrong type" -> the right type."""

_LIMITS: Final[Mapping[str, tuple[str, str]]] = {
    "greater_than": ("more than", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("less than", "lt"),
    "less_than_equal": ("at most", "le"),
    "multiple_of": ("a multiple of", "multiple_of"),
}
_LENGTHS: Final[Mapping[str, tuple[str, str, str, str]]] = {
    "too_short": ("at least", "min_length", "entry", "entries"),
    "too_long": ("at most", "max_length", "entry", "entries"),
    "string_too_short": ("at least", "min_length", "character", "characters"),
    "string_too_long": ("at most", "max_length", "character", "characters"),
}


def explain(error: Mapping[str, Any], name: str, value: Any, raw: str) -> Problem:
    """Translate an error of pydantic for a physicist.

    Args:
        error: One of ``ValidationError.errors()``, neither "missing" nor "extra_forbidden".
        value: Its value in the file.
        raw: Its value as it is written, or "".
    """
    kind, details = str(error["type"]), error.get("ctx", {})
    what = f"{name} is {shown(value, raw)}" if name else f"this is {shown(value, raw)}"
    if kind == "setting_error":
        return Problem(details["what"], expected=details["expected"], hint=details["hint"])
    if kind == "unit_missing":
        dimension, number = details["dimension"], raw or f"{value:.12g}"
        what = f"{what}, without a unit"
        return Problem(what, "", 0, 0, expected_quantity(dimension), f"write {with_units(number, dimension)}")
    if kind in ("value_error", "assertion_error"):
        return _of_validator(str(details.get("error", error["msg"])), name, what)
    if kind in _TYPES:
        return Problem(what, expected=_TYPES[kind], hint=_type_hint(kind, value))
    if kind in _LIMITS:
        comparison, key = _LIMITS[kind]
        limit = f"{details[key]:g}" if isinstance(details[key], float) else str(details[key])
        si = " (in SI units)" if isinstance(value, str) and details[key] != 0 else ""
        return Problem(what, expected=f"{comparison} {limit}{si}")
    if kind in _LENGTHS:
        comparison, key, singular, plural = _LENGTHS[kind]
        n = len(value)
        return Problem(
            f"{name} has {n} {singular if n == 1 else plural}", expected=f"{comparison} {details[key]}"
        )
    if kind == "finite_number":
        return Problem(what, expected="a finite number")
    if kind in ("literal_error", "enum"):
        choices = re.findall(r"'([^']*)'", details["expected"])
        hint = did_you_mean(str(value), choices) if len(choices) > 1 else ""
        return Problem(what, expected=details["expected"], hint=hint)
    if kind == "union_tag_invalid":
        tags = details["expected_tags"]
        hint = did_you_mean(str(details["tag"]), re.findall(r"'([^']*)'", tags))
        setting = details["discriminator"].strip("'")
        return Problem(f"{setting} is {shown(details['tag'])}", expected=tags, hint=hint)
    if kind == "union_tag_not_found":
        return Problem(f"{details['discriminator']} is missing from '{name}'")
    message = str(error["msg"])
    expected = message.removeprefix("Input should be ")
    return Problem(what, expected=expected) if expected != message else Problem(f"{name}: {message}")


def _of_validator(text: str, name: str, plain: str) -> Problem:
    """The message of a validator's ValueError, on one line, with the value before "expected ..."."""
    text = " ".join(text.split())
    if text.startswith("expected "):
        return Problem(plain, expected=text.removeprefix("expected "))
    return Problem(f"{name}: {text}" if name else text)


def _type_hint(kind: str, value: Any) -> str:
    """A hint for a text instead of a number or a switch, or vice versa."""
    if kind.startswith("int") and isinstance(value, float) and value.is_integer():
        return f"write {value:.0f}"
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
        is_other = str(number) != value  # 1_000, or 1e3
        hint = f"did you mean {number}?" if is_other else f"write {number} without quotes"
        return hint if is_right else ""
    return ""
