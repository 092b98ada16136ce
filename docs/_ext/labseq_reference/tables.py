"""Settings models as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from labseq import builtin as builtins
from labseq.config.sequence import DEFAULT_PLANNER, SequenceSpec
from labseq.registry import Entry
from labseq.settings import Choice
from labseq.units import EXAMPLES, UNITS, unit_names
from labseq_reference import prose
from labseq_reference.known import entries, settings_of
from labseq_reference.words import default_of, value_of

_ADDED_BY_LOADER: Final[Mapping[tuple[type[BaseModel], str], str]] = {
    (SequenceSpec, "planner"): f"`{{use: {DEFAULT_PLANNER}}}`"
}
"""Keys that the model needs and the loader adds, with their defaults."""


def table(header: Sequence[str], rows: Sequence[Sequence[str]], classes: Sequence[str] = ()) -> list[str]:
    """Lay out a Markdown table.

    Args:
        header: The titles of the columns.
        rows: The cells, Markdown of one line each.
        classes: What style sheets and tests know it by.
    """
    lines = [header, ["---"] * len(header), *rows]
    cells = [[cell.replace("|", r"\|") for cell in line] for line in lines]
    return [*_attributes(classes), *(f"| {' | '.join(line)} |" for line in cells)]


def settings_table(*subject: str, top: bool = False) -> list[str]:
    """A row per key; the keys of a mapping follow it as ``mapping.key``.

    Args:
        *subject: "sequence"; "profile", "grid"; "pattern", "kagome".
        top: Leave out the keys of mappings.

    Raises:
        UnknownNameError: There is no such thing.
    """
    model, classes = settings_of(*subject), ("settings", "-".join(subject))
    if model is None or not model.model_fields:
        return [*_attributes(classes), "It takes no settings."]
    rows = [
        (f"`{key}`", value_of(field), _default(owner, name, field), field.description or "")
        for key, owner, name, field in keys_of(model, top=top)
    ]
    return table(("key", "value", "default", "meaning"), rows, classes)


def registered(kind: str) -> list[str]:
    """A section with a table for everything that is registered for a role.

    Raises:
        UnknownNameError: There is no such role.
    """
    lines: list[str] = []
    for entry in entries(kind):
        lines += [f"### {kind.replace('_', ' ').capitalize()} `{entry.name}`", "", _about(entry), ""]
        lines += [*settings_table(kind, entry.name), ""]
    return lines or [f"labseq itself brings no {kind}."]


def _about(entry: Entry) -> str:
    """What it says of itself, and which plugin it comes from."""
    text = prose.summary(entry.factory)
    return text if entry.origin == builtins.__name__ else f"{text} From the plugin `{entry.origin}`."


def keys_of(
    model: type[BaseModel], *, top: bool = False, prefix: str = ""
) -> Iterator[tuple[str, type[BaseModel], str, FieldInfo]]:
    """Every key of a model: how a file spells it, whose it is, its field's name, its field."""
    for name, field in model.model_fields.items():
        key = prefix + (field.validation_alias if isinstance(field.validation_alias, str) else name)
        yield key, model, name, field
        inner = inner_model(field)
        if inner is not None and not top:
            named = ".NAME" if is_by_name(field) else ""
            yield from keys_of(inner, prefix=f"{key}{named}.")


def inner_model(field: FieldInfo) -> type[BaseModel] | None:
    """The model of a mapping, unless it is a plugin's choice, whose settings are its own."""
    found = [field.annotation, *get_args(field.annotation)]
    models = [one for one in found if isinstance(one, type) and issubclass(one, BaseModel)]
    return next((one for one in models if not issubclass(one, Choice)), None)


def is_by_name(field: FieldInfo) -> bool:
    """Whether it is a mapping of names that the user chooses, to models."""
    return any(get_origin(one) is dict for one in (field.annotation, *get_args(field.annotation)))


def quantities_table() -> list[str]:
    """A row per dimension, with its units."""
    rows = [
        (dimension, f"`{EXAMPLES[dimension]}`", ", ".join(f"`{u}`" for u in unit_names(dimension)))
        for dimension in UNITS
    ]
    return table(("quantity", "example", "units"), rows)


def _attributes(classes: Sequence[str]) -> list[str]:
    return [f"{{{' '.join(f'.{name}' for name in classes)}}}"] if classes else []


def _default(owner: type[BaseModel], name: str, field: FieldInfo) -> str:
    if inner_model(field) is not None and not field.is_required() and field.default is not None:
        return "as below"
    return _ADDED_BY_LOADER.get((owner, name)) or default_of(field)
