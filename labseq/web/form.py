"""The form for queueing a sequence: its values, with what the schema of sequences says of each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, cast

from labseq.web.runs import text_of

_SKIPPED: Final = frozenset({"labseq", "name", "profile", "plugin_folders", "use", "pattern"})
"""Keys that say what the sequence is, rather than how it runs."""
_MAX_FIELDS: Final = 300
_LIMITS: Final = {"minimum": "min", "maximum": "max"}

Schema = Mapping[str, Any]


def form_fields(data: Mapping[str, Any], schema: Schema) -> list[dict[str, Any]]:
    """The values of a sequence that `--set` can change, JSON-ready.

    Args:
        data: The content of the sequence's file, as plain values.
        schema: The JSON schema of sequences.

    Returns:
        For each value its ``address``, ``value`` ("" if the file does not give one), ``default``,
        ``about``, ``choices``, ``min`` and ``max``.
    """
    definitions: Schema = schema.get("definitions") or {}
    return list(_of_mapping(data, schema, definitions, ""))[:_MAX_FIELDS]


def _of_mapping(
    data: Mapping[str, Any], schema: Schema, definitions: Schema, prefix: str
) -> Iterator[dict[str, Any]]:
    properties = _properties(schema, definitions, data)
    for key in dict.fromkeys((*data, *properties)):
        known, value = _resolved(properties.get(key) or {}, definitions), data.get(key)
        if key in _SKIPPED or key == "scan":
            continue
        address = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _of_mapping(cast("dict[str, Any]", value), known, definitions, f"{address}.")
        elif key == "shot" and isinstance(value, list):
            yield from _of_steps(cast("list[Any]", value), known, definitions)
        elif isinstance(value, list) or (value is None and not _is_scalar(known)):
            continue
        else:
            yield _field(address, value, known)


def _of_steps(steps: list[Any], schema: Schema, definitions: Schema) -> Iterator[dict[str, Any]]:
    kinds = _properties(schema.get("items") or {}, definitions, {})
    for i, step in enumerate(steps):
        for kind, settings in cast("dict[str, Any]", step).items() if isinstance(step, dict) else ():
            if kind not in ("name", "policy"):
                known = _resolved(kinds.get(kind) or {}, definitions)
                yield from _of_mapping(settings or {}, known, definitions, f"shot.{i}.{kind}.")


def _properties(schema: Schema, definitions: Schema, data: Mapping[str, Any]) -> dict[str, Any]:
    """The properties of a mapping, with those of the plugin that it chooses."""
    found = dict(schema.get("properties") or {})
    for rule in schema.get("allOf") or ():
        if "$ref" in rule:
            found |= _properties(_resolved(rule, definitions), definitions, data)
        chosen: Mapping[str, Any] = rule.get("if", {}).get("properties", {})
        if chosen and all(data.get(key) == one.get("const") for key, one in chosen.items()):
            found |= _properties(_resolved(rule.get("then") or {}, definitions), definitions, data)
    return found


def _resolved(schema: Schema, definitions: Schema) -> Schema:
    """A schema with what it refers to; of alternatives, the first that says most."""
    if "$ref" in schema:
        return {**(definitions.get(str(schema["$ref"]).rpartition("/")[2]) or {}), **schema}
    alternatives = [one for one in schema.get("anyOf") or () if one.get("type") != "null"]
    if alternatives:
        return {
            **_resolved(alternatives[0], definitions),
            **{k: v for k, v in schema.items() if k != "anyOf"},
        }
    return schema


def _is_scalar(schema: Schema) -> bool:
    kinds = schema.get("type")
    return "enum" in schema or not {"object", "array"} & (
        {kinds} if isinstance(kinds, str) else {*(kinds or ())}
    )


def _field(address: str, value: Any, schema: Schema) -> dict[str, Any]:
    kinds: Any = schema.get("type")
    choices = [text_of(one, 80) for one in schema.get("enum") or ()]
    if kinds == "boolean" or isinstance(value, bool):
        choices = ["true", "false"]
    limits = {
        name: schema[key]
        for key, name in _LIMITS.items()
        if isinstance(schema.get(key), int | float) and schema.get("maximum") != 0
    }
    return {
        "address": address,
        "value": _written(value),
        "default": _written(schema.get("default")),
        "about": text_of(schema.get("description") or "", 400),
        "choices": choices,
        **limits,
    }


def _written(value: Any) -> str:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else text_of(value, 400)
