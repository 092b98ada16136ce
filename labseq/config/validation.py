"""Values checked against a settings model; each error names its place."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path, PurePath
from typing import Any, Final, TypeVar, cast, get_args, overload

import numpy as np
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from labseq.config.messages import EXPECTED_TYPES, ErrorText, explain_validation_error
from labseq.config.yaml_nodes import Mark, Node, comma_hint
from labseq.errors import ConfigError, Loc
from labseq.messages import clean, closest, listing, shown
from labseq.settings import FOLDER, NoSettings


def models_at(model: type[BaseModel], loc: Loc) -> list[type[BaseModel]]:
    """The settings models that can stand at a location below a model: several in a union."""
    models = [model]
    for step in loc:
        # A step that is no field is a list index or the key of a dict of models.
        fields = [found for one in models if (found := field_of(one, step)) is not None]
        if fields:
            models = [inner for found in fields for inner in _models_in(found.annotation)]
    return models


def field_of(model: type[BaseModel], key: str | int) -> FieldInfo | None:
    """The field that a key of the file sets."""
    return next((field for name, field in model.model_fields.items() if key == _key(name, field)), None)


def keys_of(models: list[type[BaseModel]]) -> list[str]:
    """The keys that the models know, in order."""
    keys = [_key(name, field) for model in models for name, field in model.model_fields.items()]
    return list(dict.fromkeys(keys))


def description_of(models: list[type[BaseModel]], key: str) -> str:
    """First sentence of what a key's field says about itself, or ""."""
    for model in models:
        field = field_of(model, key)
        if field is not None and field.description:
            sentence = field.description.split(". ")[0].rstrip(".")
            return sentence[0].lower() + sentence[1:] if sentence[1:2].islower() else sentence
    return ""


def _key(name: str, field: FieldInfo) -> str:
    """What a field is called in the file."""
    return field.validation_alias if isinstance(field.validation_alias, str) else name


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models that an annotation names, inside of unions, lists, dicts and Annotated."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        return
    for inner in get_args(annotation):
        yield from _models_in(inner)


M = TypeVar("M", bound=BaseModel)

MAX_HINTS: Final = 50
"""Unknown keys of a mapping that known ones are compared with: a file with more is not what it was
taken for, and comparing takes time."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something wrong at a location below the mapping, or (``key``) with the key there."""

    loc: Loc
    words: ErrorText
    key: bool = False


@dataclass(frozen=True, slots=True)
class _Placed:
    """An error of pydantic with the location in the file that it is about.

    Attributes:
        error: pydantic's error.
        loc: Location below the mapping; it may end with a missing key.
        union: Location of the union that it comes out of, or None.
        branch: Which branch of the union.
    """

    error: Mapping[str, Any]
    loc: Loc
    union: Loc | None
    branch: str

    @property
    def is_wrong_type(self) -> bool:
        """Whether it only says that the value is of another type."""
        return self.error["type"] in EXPECTED_TYPES and self.loc == self.union


@dataclass(frozen=True, slots=True)
class ValidationContext:
    """What a mapping is validated for.

    Attributes:
        name: Name of the mapping in messages; "" at the top of a file.
        called: What to call it in messages; "" for its name.
        drop: Keys that are left out.
        other_keys: Keys that belong to somebody else: named, but not validated.
        folder: Folder that the paths in it are relative to.
    """

    name: str
    called: str = ""
    drop: Collection[str] = ()
    other_keys: Collection[str] = ()
    folder: Path = Path()


def validate(model: type[M], node: Node | None, asked: ValidationContext) -> M | list[Finding]:
    """Make settings of a mapping, or say everything that is wrong with it."""
    data = {} if node is None or node.value is None else node.plain()
    if not isinstance(data, dict):
        raw = node.raw if node else ""
        words = ErrorText(f"{asked.name} is {shown(data, raw)}", "a mapping of settings such as {key: value}")
        return [Finding((), words)]
    kept = {key: value for key, value in cast("dict[str, Any]", data).items() if key not in asked.drop}
    try:
        return _validated(model, json.dumps(kept), {FOLDER: asked.folder})
    except ValidationError as error:
        return _findings(error, model, node or Node({}, Mark(1, 1)), asked)
    except Exception as error:  # noqa: BLE001 - a plugin's own validator may raise anything
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return [Finding((), ErrorText(f"these settings make the plugin's check fail: {reason}"))]


def _validated(model: type[M], text: str, context: Mapping[str, Any]) -> M:
    """Validate JSON, because there strict means: no number out of a text, but a tuple out of a list."""
    try:
        return model.model_validate_json(text, strict=True, context=context)
    except ValidationError as error:
        # Behind a validator of the model's own, strict wants a tuple from the start.
        if all(_is_list_for_tuple(one) for one in error.errors(include_url=False)):
            return model.model_validate_json(text, context=context)
        raise


def _is_list_for_tuple(error: Mapping[str, Any]) -> bool:
    return error["type"] in ("tuple_type", "set_type", "frozen_set_type") and isinstance(error["input"], list)


def _is_long_enough(error: Mapping[str, Any]) -> bool:
    """Whether a list is only "too short" because items with errors of their own are not counted."""
    return error["type"] == "too_short" and len(error["input"]) >= error["ctx"]["min_length"]


def _findings(
    error: ValidationError, model: type[BaseModel], top: Node, asked: ValidationContext
) -> list[Finding]:
    found = cast("list[Mapping[str, Any]]", error.errors(include_url=False))
    errors = [_place(one, top) for one in found if not (_is_list_for_tuple(one) or _is_long_enough(one))]
    chosen = [one for one in errors if one.union is None]
    unions: dict[Loc, list[_Placed]] = {}
    for one in errors:
        if one.union is not None:
            unions.setdefault(one.union, []).append(one)
    findings: list[Finding] = []
    for union in unions.values():
        if all(one.is_wrong_type for one in union):
            findings.append(_no_type_fits(union, top, asked))
        else:
            chosen += _best_branch(union)
    missing = {one.loc for one in chosen if one.error["type"] == "missing"}
    unknown = [one for one in chosen if one.error["type"] == "extra_forbidden"]
    meant = {one.loc: _meant_key(one, model, asked) for one in unknown[:MAX_HINTS]}
    misspelt = {(*loc[:-1], key) for loc, key in meant.items()}
    for one in chosen:
        if one.error["type"] == "extra_forbidden":
            findings.append(_unknown_key(one, meant.get(one.loc, ""), model, top, asked))
        elif one.error["type"] != "missing":
            findings.append(_wrong_value(one, top, asked))
        elif isinstance(index := one.loc[-1], int):
            if (*one.loc[:-1], index + 1) not in missing:
                findings.append(_missing_item(one, index, top, asked))
        elif one.loc not in misspelt:  # a misspelt key is not missing as well
            findings.append(_missing_key(one, model, top, asked))
    return findings


def _place(error: Mapping[str, Any], top: Node) -> _Placed:
    """Follow pydantic's location through the file; what is no key or index names a union's branch."""
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
    """The errors of the branch that the writer most likely meant: the one that fits furthest."""
    branches: dict[str, list[_Placed]] = {}
    for one in union:
        branches.setdefault(one.branch, []).append(one)

    def fit(errors: list[_Placed]) -> tuple[int, bool, int]:
        is_about_value = not any(one.is_wrong_type for one in errors)
        return max(len(one.loc) for one in errors), is_about_value, -len(errors)

    return max(branches.values(), key=fit)


def _no_type_fits(union: list[_Placed], top: Node, asked: ValidationContext) -> Finding:
    loc = union[0].loc
    expected = dict.fromkeys(EXPECTED_TYPES[one.error["type"]] for one in union)
    node = top.at(loc) or top
    *others, last = expected
    either = f"{', '.join(others)} or {last}" if others else last
    return Finding(loc, ErrorText(f"{_name(loc, asked)} is {shown(node.plain(), node.raw)}", either))


def _wrong_value(one: _Placed, top: Node, asked: ValidationContext) -> Finding:
    context = one.error.get("ctx", {})
    at = (context["discriminator"].strip("'"),) if one.error["type"] == "union_tag_invalid" else ()
    loc = one.loc + tuple(context.get("at", at))
    node = top.at(one.loc) or top
    name = _name(one.loc, asked)
    if "[key]" in one.error["loc"]:
        words = explain_validation_error(one.error, f"the key '{clean(str(one.loc[-1]))}'", one.loc[-1], "")
        return Finding(loc, words, key=True)
    return Finding(
        loc, explain_validation_error(one.error, name, node.plain(), node.raw), bool(context.get("key"))
    )


def _unknown_key(
    one: _Placed, meant: str, model: type[BaseModel], top: Node, asked: ValidationContext
) -> Finding:
    loc, key = one.loc, clean(str(one.loc[-1]))
    node = top.at(loc)
    comma = comma_hint(key, node.value) if node is not None else ""
    known = _known_keys(loc[:-1], model, asked)
    owner = _called(loc[:-1], asked)
    if not known:
        words = ErrorText(f"{owner} takes no settings, but '{key}' is given", "", comma or "remove it")
        return Finding(loc, words, key=True)
    hint = "put a space after the ':'" if ":" in key else f"did you mean '{meant}'?" if meant else ""
    words = ErrorText(f"'{key}' is not a setting of {owner}", listing(known), comma or hint)
    return Finding(loc, words, key=True)


def _missing_key(one: _Placed, model: type[BaseModel], top: Node, asked: ValidationContext) -> Finding:
    loc, key = one.loc, str(one.loc[-1])
    parent = top.at(loc[:-1])
    about = description_of(models_at(model, loc[:-1]), key)
    where = f" from {_called(loc[:-1], asked)}" if asked.name or len(loc) > 1 else ""
    what = f"'{key}' is missing{where}" + (f" ({about})" if about else "")
    known = _known_keys(loc[:-1], model, asked)
    others = [k for k in parent.value if k not in known] if parent and isinstance(parent.value, dict) else []
    alike = closest(key, others)
    return Finding(loc, ErrorText(what, "", f"did you write '{clean(alike)}' for it?" if alike else ""))


def _missing_item(one: _Placed, index: int, top: Node, asked: ValidationContext) -> Finding:
    loc = one.loc[:-1]
    node = top.at(loc)
    n = len(node.value) if node and isinstance(node.value, list) else 0
    what = f"{_name(loc, asked)} has {n} {'entry' if n == 1 else 'entries'}"
    return Finding(loc, ErrorText(what, f"at least {index + 1}"))


def _known_keys(loc: Loc, model: type[BaseModel], asked: ValidationContext) -> list[str]:
    known = [key for key in keys_of(models_at(model, loc)) if loc or key not in asked.drop]
    return known if loc else [*known, *(key for key in asked.other_keys if key not in known)]


def _meant_key(one: _Placed, model: type[BaseModel], asked: ValidationContext) -> str:
    return closest(str(one.loc[-1]), _known_keys(one.loc[:-1], model, asked))


def _called(loc: Loc, asked: ValidationContext) -> str:
    """What to call a mapping."""
    if loc:
        return f"'{_name(loc, asked)}'"
    return asked.called or (f"'{asked.name}'" if asked.name else "this file")


def _name(loc: Loc, asked: ValidationContext) -> str:
    """Name of a value: its key, and the indices of the lists within."""
    last = next((i for i in reversed(range(len(loc))) if isinstance(loc[i], str)), 0)
    return ".".join(str(step) for step in loc[last:]) if loc else asked.name


@overload
def validate_values(model: type[M], values: Mapping[str, Any], called: str) -> M: ...
@overload
def validate_values(model: None, values: Mapping[str, Any], called: str) -> None: ...
def validate_values(model: type[M] | None, values: Mapping[str, Any], called: str) -> M | None:
    """Make settings of Python values, by the same rules as those of a file.

    Args:
        model: The settings model; None for what takes no settings.
        values: Setting -> value; numpy's numbers and arrays count as plain ones.
        called: What the settings belong to, for messages: "planner 'psca'".

    Raises:
        ConfigError: Everything that is wrong with them.
    """
    root = node_of(dict(values), Mark(0, 0, called))
    result = validate(model or NoSettings, root, ValidationContext("", "it"))
    if isinstance(result, list):
        raise ConfigError(
            [root.mark.problem("", w.what, w.expected, w.hint) for w in (found.words for found in result)]
        )
    return None if model is None else cast("M", result)


def node_of(value: Any, mark: Mark) -> Node:
    """Plain values as nodes that all stand at one place.

    Raises:
        ConfigError: A value that no file could hold.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        nodes = {str(key): node_of(inner, mark) for key, inner in cast("Mapping[Any, Any]", value).items()}
        return Node(nodes, mark, dict.fromkeys(nodes, mark))
    if isinstance(value, list | tuple | set | frozenset):
        return Node([node_of(inner, mark) for inner in cast("list[Any]", value)], mark)
    if isinstance(value, Enum):
        return node_of(value.value, mark)
    if isinstance(value, PurePath):
        return Node(str(value), mark)
    if isinstance(value, str) and any("\ud800" <= char <= "\udfff" for char in value):
        raise ConfigError(mark.problem("", f"half of a character stands in '{clean(value)}'", "text"))
    if value is None or isinstance(value, str | int | float):
        return Node(value, mark)
    kind = type(cast("object", value)).__name__
    raise ConfigError(
        mark.problem("", f"a value of type {kind} is no setting", "a number, text, list or dict")
    )
