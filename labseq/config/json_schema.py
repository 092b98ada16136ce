"""Settings models as JSON schema: what an editor needs to complete, explain and check a file.

The dialect is draft 7, which every editor reads. A schema says what can be said without context: keys,
types, limits of plain numbers, units. ``labseq check`` says the rest.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final, TypeAlias, cast

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from labseq.config.fields import DefaultIfEmpty
from labseq.config.settings import Quantity
from labseq.config.variables import si_of
from labseq.units import EXAMPLES, UNITS, expected, format_quantity, parse_quantity

JsonSchema: TypeAlias = dict[str, Any]

DRAFT: Final = "http://json-schema.org/draft-07/schema#"
DEFINITIONS: Final = "definitions"

_DIMENSION: Final = "x-dimension"  # of a quantity, until its default is written with a unit
_SIGN: Final = "[+-]?"
_NUMBER: Final = r"(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"
_EXPRESSION: Final = "^=(?!=)"
_NUMBERS: Final = ("number", "integer")
_VALUES: Final = ("default", "const", "enum", "examples")
_MAPS: Final = frozenset({"properties", "patternProperties", "$defs"})
_DROPPED: Final = frozenset({"title", "discriminator", "$defs", _DIMENSION})
_LIMITS: Final = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}
"""pydantic's names for limits that are checked after a validator, and those of JSON schema."""


class _Generator(GenerateJsonSchema):
    """pydantic's schema, with what labseq's own validators take, and without giving up on others'."""

    def function_before_schema(self, schema: core_schema.BeforeValidatorFunctionSchema) -> JsonSchema:
        """Quantities are numbers or text; what may be left empty may be null."""
        function: object = schema["function"]["function"]
        if isinstance(function, Quantity):
            return quantity_schema(function.dimension)
        if function is si_of:
            return _variable_schema()
        inner = super().function_before_schema(schema)
        return or_empty(inner) if isinstance(function, DefaultIfEmpty) else inner

    def function_plain_schema(self, schema: core_schema.PlainValidatorFunctionSchema) -> JsonSchema:
        """Whatever a validator takes that tells nothing of itself."""
        del schema
        return {}

    def handle_invalid_for_json_schema(self, schema: Any, error_info: str) -> JsonSchema:
        """Likewise for a type that JSON schema has no words for."""
        del schema, error_info
        return {}

    def emit_warning(self, kind: Any, detail: str) -> None:
        """A default that JSON cannot hold is left out, silently."""


def quantity_schema(dimension: str) -> JsonSchema:
    """A number in SI, or text with one of the units.

    Example:
        >>> quantity_schema("time")["type"]
        ['number', 'string']
    """
    return {
        "type": ["number", "string"],
        "pattern": _quantity_pattern(_units(dimension)),
        "patternErrorMessage": f"expected {expected(dimension)}",  # known to VS Code only
        "examples": [EXAMPLES[dimension]],
        _DIMENSION: dimension,
    }


def _variable_schema() -> JsonSchema:
    """A plain number, or a quantity of any kind."""
    return {
        "type": ["number", "string"],
        "pattern": _quantity_pattern([unit for dimension in UNITS for unit in _units(dimension)]),
        "patternErrorMessage": "expected a number, or a number with a unit such as '20 ms'",
    }


def _units(dimension: str) -> list[str]:
    return [*UNITS[dimension], *(["degC"] if dimension == "temperature" else [])]


def _quantity_pattern(units: Sequence[str]) -> str:
    alternatives = "|".join(re.escape(unit) for unit in units)
    return rf"^\s*{_SIGN}{_NUMBER}\s*({alternatives})\s*$"


def or_expression(schema: Any) -> Any:
    """The same schema, but that an expression may stand wherever a number or a quantity may.

    Example:
        >>> or_expression({"type": "integer", "minimum": 1})["type"]
        ['integer', 'string']
    """
    if isinstance(schema, list):
        return [or_expression(one) for one in cast("list[Any]", schema)]
    if not isinstance(schema, dict):
        return schema
    node = cast("JsonSchema", schema)
    if "const" in node:
        return node
    if "enum" in node:
        is_number = node.get("type") in _NUMBERS
        text = {"type": "string", "pattern": _EXPRESSION}
        return {"anyOf": [node, text], **_about(node)} if is_number else node
    changed: JsonSchema = {}
    for key, value in node.items():
        if key in _MAPS:
            changed[key] = {name: or_expression(one) for name, one in value.items()}
        else:
            changed[key] = value if key in _VALUES else or_expression(value)
    kind = node.get("type")
    if kind in _NUMBERS:
        changed |= {"type": [kind, "string"], "pattern": _EXPRESSION}
        changed["patternErrorMessage"] = "expected a number, or an expression such as '= 2 * variables.x'"
    elif kind == ["number", "string"] and "pattern" in node:
        changed["pattern"] = f"{_EXPRESSION}|{node['pattern']}"
    return changed


def _about(node: JsonSchema) -> JsonSchema:
    return {key: node[key] for key in ("description", "default") if key in node}


def or_empty(schema: JsonSchema) -> JsonSchema:
    """What a schema takes, or nothing at all behind the key."""
    return {"anyOf": [schema, {"type": "null"}]}


def model_schema(model: type[BaseModel] | None, prefix: str, definitions: JsonSchema) -> JsonSchema:
    """The schema of a mapping of settings.

    Args:
        model: The settings model; None for what takes no settings.
        prefix: What the names of its definitions begin with, so that no two models' clash.
        definitions: Where its definitions go.
    """
    if model is None:
        return {"type": "object", "properties": {}, "additionalProperties": False}
    reference = f"#/{DEFINITIONS}/{prefix}{{model}}"
    made = model.model_json_schema(schema_generator=_Generator, ref_template=reference)
    inner = {f"{prefix}{name}": _tidy(one) for name, one in made.get("$defs", {}).items()}
    definitions.update(inner)
    found = _tidy(made)
    if "properties" not in found and "$ref" in found:  # a model that refers to itself
        found = dict(cast("JsonSchema", inner[found["$ref"].rpartition("/")[2]]))
    return {"type": "object", "properties": {}, **found}


def _tidy(schema: Any) -> Any:
    """A schema of draft 7, without titles, and with defaults as people write them."""
    if isinstance(schema, list):
        return [_tidy(one) for one in cast("list[Any]", schema)]
    if not isinstance(schema, dict):
        return schema
    node = cast("JsonSchema", schema)
    tidy: JsonSchema = {}
    for key, value in node.items():
        if key in _MAPS and key != "$defs":
            tidy[key] = {name: _tidy(one) for name, one in value.items()}
        elif key == "prefixItems":
            tidy["items"] = _tidy(value)
        elif key in _VALUES:
            tidy[key] = value
        elif key not in _DROPPED:
            tidy[_LIMITS.get(key, key)] = _tidy(value)
    if "default" in tidy:
        tidy["default"] = _written(tidy["default"], node)
        if tidy["default"] is None or isinstance(tidy["default"], dict):  # an editor would write it out
            del tidy["default"]
    if _DIMENSION in node and tidy.get("minimum", tidy.get("exclusiveMinimum", -1)) >= 0:
        tidy["pattern"] = tidy["pattern"].replace(_SIGN, r"\+?", 1)  # a limit holds for plain numbers only
    if "$ref" in tidy and len(tidy) > 1:  # draft 7 reads nothing beside a reference
        tidy = {"allOf": [{"$ref": tidy.pop("$ref")}], **tidy}
    return tidy


def _written(default: Any, node: Mapping[str, Any]) -> Any:
    """A default with its unit, if nothing is lost by that."""
    dimension = next((one[_DIMENSION] for one in [node, *node.get("anyOf", [])] if _DIMENSION in one), None)
    if dimension is None or isinstance(default, bool) or not isinstance(default, int | float):
        return default
    text = format_quantity(default, dimension)
    return text if parse_quantity(text, dimension) == default else default
