"""What a settings model says about its keys, at any depth."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from labseq.config.nodes import Loc


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
