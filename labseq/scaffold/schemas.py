"""JSON schemas of sequences and profiles, for editors.

The dialect is draft 7, which every editor reads. A schema contains everything that needs no context: keys,
types, limits of plain numbers, units. ``labseq check`` checks the rest.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias, cast

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from labseq.config.profile import DeviceChoice, LinesChoice, MobileTweezersChoice, ProfileSpec
from labseq.config.scan import FORMS, AdaptiveChoice
from labseq.config.sequence import AnalysisChoice, SequenceSpec
from labseq.files import whole_file
from labseq.model.policies import StepPolicy
from labseq.registry import Entry, Registry
from labseq.scaffold.words import summary
from labseq.settings import Choice, DefaultIfEmpty, PatternChoice, Quantity, Settings, SettingsType, si_of
from labseq.units import EXAMPLES, UNITS, expected, format_quantity, parse_quantity

JsonSchema: TypeAlias = dict[str, Any]
FileKind = Literal["sequence", "profile"]

KINDS: Final[tuple[FileKind, ...]] = ("sequence", "profile")
SCHEMA_FOLDER: Final = ".labseq"
"""Folder of the schemas, next to the sequences and profiles that name them."""
DRAFT: Final = "http://json-schema.org/draft-07/schema#"
DEFINITIONS: Final = "definitions"

_DIMENSION: Final = "x-dimension"  # dimension of a quantity, until its default is written with a unit
_SIGN: Final = "[+-]?"
_NUMBER: Final = r"(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"
_EXPRESSION: Final = "^=(?!=)"
_VALUES: Final = frozenset({"default", "const", "enum", "examples"})
_MAPS: Final = frozenset({"properties", "patternProperties"})
_DROPPED: Final = frozenset({"title", "discriminator", "$defs", _DIMENSION})
_LIMITS: Final = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}
"""Pydantic's names for limits that are checked after a validator -> the names of JSON schema."""


def schema_text(kind: FileKind, registry: Registry) -> str:
    """The JSON schema of a kind of file, as text."""
    return json.dumps(file_schema(kind, registry), indent=1, ensure_ascii=False) + "\n"


def schema_path(kind: FileKind, folder: Path) -> Path:
    """Path of the schema for the files of a folder."""
    return folder / SCHEMA_FOLDER / f"{kind}.schema.json"


def write_schema(kind: FileKind, folder: Path, registry: Registry) -> Path:
    """Write the schema that files of this kind in a folder name in their first line.

    Raises:
        OSError: The schema cannot be written.
    """
    path = schema_path(kind, folder)
    path.parent.mkdir(exist_ok=True)
    with whole_file(path) as file:
        file.write(schema_text(kind, registry).encode())
    return path


def file_schema(kind: FileKind, registry: Registry) -> JsonSchema:
    """The schema of a kind of file."""
    return _FileSchema(registry).sequence() if kind == "sequence" else _FileSchema(registry).profile()


class _Generator(GenerateJsonSchema):
    """Pydantic's schema, extended by quantities and expressions. Unknown types accept everything."""

    expressions = False
    """Whether a number may also be an expression."""

    def function_before_schema(self, schema: core_schema.BeforeValidatorFunctionSchema) -> JsonSchema:
        """A number or text for quantities, and null for values that may be left empty."""
        function: object = schema["function"]["function"]
        if isinstance(function, Quantity):
            return quantity_schema(function.dimension, expressions=self.expressions)
        if function is si_of:
            return _variable_schema()
        inner = super().function_before_schema(schema)
        return or_empty(inner) if isinstance(function, DefaultIfEmpty) else inner

    def int_schema(self, schema: core_schema.IntSchema) -> JsonSchema:
        """A whole number, or an expression."""
        return self._or_expression(super().int_schema(schema))

    def float_schema(self, schema: core_schema.FloatSchema) -> JsonSchema:
        """A number, or an expression."""
        return self._or_expression(super().float_schema(schema))

    def literal_schema(self, schema: core_schema.LiteralSchema) -> JsonSchema:
        """One of the values, or an expression if they are numbers."""
        literal = super().literal_schema(schema)
        is_number = self.expressions and "enum" in literal and literal.get("type") in ("number", "integer")
        text = {"type": "string", "pattern": _EXPRESSION}
        return {"anyOf": [literal, text]} if is_number else literal

    def function_plain_schema(self, schema: core_schema.PlainValidatorFunctionSchema) -> JsonSchema:
        """Any value, because a validator does not say what it accepts."""
        del schema
        return {}

    def handle_invalid_for_json_schema(self, schema: Any, error_info: str) -> JsonSchema:
        """Any value, because JSON schema cannot express the type."""
        del schema, error_info
        return {}

    def emit_warning(self, kind: Any, detail: str) -> None:
        """Leave out a default that JSON cannot hold."""

    def _or_expression(self, number: JsonSchema) -> JsonSchema:
        if not self.expressions:
            return number
        message = "expected a number, or an expression such as '= 2 * variables.x'"
        text = {"pattern": _EXPRESSION, "patternErrorMessage": message}  # the message is for VS Code
        return {**number, "type": [number["type"], "string"], **text}


class _ExpressionGenerator(_Generator):
    expressions = True


def quantity_schema(dimension: str, *, expressions: bool = False) -> JsonSchema:
    """Text with one of the units, or a number that needs no unit.

    Example:
        >>> quantity_schema("time")["type"]
        ['number', 'string']
    """
    pattern = _quantity_pattern(_units(dimension))
    return {
        "type": ["number", "string"],
        "pattern": f"{_EXPRESSION}|{pattern}" if expressions else pattern,
        "patternErrorMessage": f"expected {expected(dimension)}",
        "examples": [EXAMPLES[dimension]],
        _DIMENSION: dimension,
    }


def _variable_schema() -> JsonSchema:
    """A plain number, a quantity of any kind, or an expression."""
    pattern = _quantity_pattern([unit for dimension in UNITS for unit in _units(dimension)])
    return {
        "type": ["number", "string"],
        "pattern": f"{_EXPRESSION}|{pattern}",
        "patternErrorMessage": "expected a number, or a number with a unit such as '20 ms'",
    }


def _units(dimension: str) -> list[str]:
    return [*UNITS[dimension], *(["degC"] if dimension == "temperature" else [])]


def _quantity_pattern(units: Sequence[str]) -> str:
    alternatives = "|".join(re.escape(unit) for unit in units)
    return rf"^\s*{_SIGN}{_NUMBER}\s*({alternatives})\s*$"


def or_empty(schema: JsonSchema) -> JsonSchema:
    """The schema, or nothing at all after the key."""
    return {"anyOf": [schema, {"type": "null"}]}


def model_schema(
    model: SettingsType | None, prefix: str, definitions: JsonSchema, *, expressions: bool = True
) -> JsonSchema:
    """The schema of a mapping of settings.

    Args:
        prefix: Prefix of the names of its definitions, so that definitions of two models do not clash.
    """
    if model is None:
        return {"type": "object", "properties": {}, "additionalProperties": False}
    generator = _ExpressionGenerator if expressions else _Generator
    reference = f"#/{DEFINITIONS}/{prefix}{{model}}"
    made = TypeAdapter(model).json_schema(schema_generator=generator, ref_template=reference)
    inner = {f"{prefix}{name}": _tidy(one) for name, one in made.get("$defs", {}).items()}
    definitions.update(inner)
    found = _tidy(made)
    if "properties" not in found and "$ref" in found:  # a model that refers to itself
        found = dict(cast("JsonSchema", inner[found["$ref"].rpartition("/")[2]]))
    return {"type": "object", "properties": {}, **found}


def _tidy(schema: Any) -> Any:
    """A schema of draft 7 without titles, and with defaults as people write them."""
    if isinstance(schema, list):
        return [_tidy(one) for one in cast("list[Any]", schema)]
    if not isinstance(schema, dict):
        return schema
    node = cast("JsonSchema", schema)
    tidy: JsonSchema = {}
    for key, value in node.items():
        if key in _MAPS:
            tidy[key] = {name: _tidy(one) for name, one in value.items()}
        elif key == "prefixItems":
            tidy["items"] = _tidy(value)
        elif key in _VALUES:
            tidy[key] = value
        elif key not in _DROPPED:
            tidy[_LIMITS.get(key, key)] = _tidy(value)
    if "default" in tidy:
        tidy["default"] = _with_unit(tidy["default"], node)
        if tidy["default"] is None or isinstance(tidy["default"], dict):  # an editor would insert it
            del tidy["default"]
    if _DIMENSION in node:
        _limit_numbers(tidy, node[_DIMENSION])
    if "$ref" in tidy and len(tidy) > 1:  # draft 7 ignores everything next to a reference
        tidy = {"allOf": [{"$ref": tidy.pop("$ref")}], **tidy}
    return tidy


def _limit_numbers(tidy: JsonSchema, dimension: str) -> None:
    """Allow only positive text if a quantity's limits say so, and a number only if it needs no unit."""
    if tidy.get("minimum", tidy.get("exclusiveMinimum", -1)) >= 0:
        tidy["pattern"] = tidy["pattern"].replace(_SIGN, r"\+?", 1)
    if dimension == "fraction":
        return
    takes_zero = dimension != "temperature" and tidy.get("minimum", 0) <= 0 and "exclusiveMinimum" not in tidy
    for limit in ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum"):
        tidy.pop(limit, None)
    tidy |= {"minimum": 0, "maximum": 0} if takes_zero else {"type": "string"}


def _with_unit(default: Any, node: Mapping[str, Any]) -> Any:
    """A default with its unit, if that is exact."""
    dimension = next((one[_DIMENSION] for one in [node, *node.get("anyOf", [])] if _DIMENSION in one), None)
    if dimension is None or isinstance(default, bool) or not isinstance(default, int | float):
        return default
    text = format_quantity(default, dimension)
    return text if parse_quantity(text, dimension) == default else default


_ROLES: Final[dict[str, type[Choice]]] = {
    "camera": Choice,
    "static_tweezers": Choice,
    "mobile_tweezers": MobileTweezersChoice,
    "detector": Choice,
    "lines": LinesChoice,
    "simulation": Choice,
}
_SCANNER: Final = "scanner"


class _FileSchema:
    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._definitions: JsonSchema = {}

    def sequence(self) -> JsonSchema:
        file = self._file(SequenceSpec)
        keys = file["properties"]
        analyses = {"type": "array", "items": self._choice("analysis", AnalysisChoice)}
        self._fill(keys, "target", self._choice("pattern", PatternChoice))
        self._fill(keys, "planner", or_empty(self._choice("planner", Choice)))
        self._fill(keys, "analysis", or_empty(analyses))
        listed: JsonSchema = keys["measure"]["anyOf"][0]  # an item may be just the name
        item: JsonSchema = {"anyOf": [listed["items"], {"type": "string"}]}
        self._fill(keys, "measure", or_empty({"anyOf": [{**listed, "items": item}, *item["anyOf"]]}))
        self._fill(keys, "shot", {"type": "array", "minItems": 1, "items": self._step()})
        self._fill(keys, "scan", or_empty(self._scan()))
        # there is a default planner, and a scan sets the number of shots
        file["required"] = [key for key in file["required"] if key not in ("planner", "shots")]
        file["if"], file["else"] = {"required": ["scan"]}, {"required": ["shots"]}
        return self._whole("labseq sequence", file)

    def profile(self) -> JsonSchema:
        file = self._file(ProfileSpec)
        keys = file["properties"]
        for role, core in _ROLES.items():
            choice = self._choice(role, core)
            self._fill(keys, role, or_empty(choice) if role in ("lines", "simulation") else choice)
        is_camera = {"type": "object", "properties": {"role": {"const": "camera"}}, "required": ["role"]}
        camera, device = self._choice("camera", DeviceChoice, "devices"), self._choice("device", DeviceChoice)
        either = {"if": is_camera, "then": camera, "else": device}
        self._fill(keys, "devices", or_empty({"type": "object", "additionalProperties": either}))
        calibrations = keys["calibrations"]  # may also be a folder, or `off`
        keys["calibrations"] = {**calibrations, "anyOf": [*calibrations["anyOf"], {"type": "string"}]}
        return self._whole("labseq hardware profile", file)

    def _file(self, model: type[Settings]) -> JsonSchema:
        return model_schema(model, "", self._definitions)

    def _whole(self, title: str, file: JsonSchema) -> JsonSchema:
        return {
            "$schema": DRAFT,
            "title": title,
            **file,
            DEFINITIONS: dict(sorted(self._definitions.items())),
        }

    def _fill(self, keys: JsonSchema, key: str, schema: JsonSchema) -> None:
        """Replace the schema of a key, but keep the description that the file's model gives it."""
        keys[key] = {"description": keys[key]["description"], **schema}

    def _choice(self, kind: str, core: type[Choice], group: str = "") -> JsonSchema:
        """A plugin chosen by name, and the settings of this plugin next to the name.

        Args:
            kind: Kind of plugin.
            core: The core's keys next to them.
            group: First part of the names of their definitions, by default the kind.
        """
        group = group or kind
        entries = [entry for entry in self._registry.entries() if entry.kind == kind]
        own = model_schema(core, f"{group}.", self._definitions, expressions=kind != _SCANNER)
        key = core.key
        name = {
            **own["properties"].pop(key),
            "enum": [entry.name for entry in entries],
            "enumDescriptions": [_about(entry) for entry in entries],
        }
        rules: list[JsonSchema] = []
        for entry in entries:
            defined = f"{group}.{entry.name}"
            self._definitions[defined] = self._settings(entry, {key: {}, **own["properties"]})
            is_chosen = {"type": "object", "properties": {key: {"const": entry.name}}, "required": [key]}
            rules.append({"if": is_chosen, "then": {"$ref": _reference(defined)}})
        needed: list[str] = own.get("required", [key])
        return {"type": "object", "properties": {key: name}, "required": needed, "allOf": rules}

    def _settings(self, entry: Entry, around: JsonSchema) -> JsonSchema:
        """The settings of an entry, with the core's keys that are allowed next to them."""
        prefix, expressions = f"{entry.kind}.{entry.name}.", entry.kind != _SCANNER
        mine = model_schema(entry.settings_model, prefix, self._definitions, expressions=expressions)
        required = [key for key in mine.get("required", []) if key not in around]
        merged = {**mine, "properties": {**mine["properties"], **around}, "required": required}
        return {"additionalProperties": False, **merged, "description": _about(entry)}

    def _step(self) -> JsonSchema:
        """Exactly one kind of step with its settings, and optionally a name and a policy."""
        kinds: JsonSchema = {}
        for entry in (one for one in self._registry.entries() if one.kind == "step"):
            self._definitions[f"step.{entry.name}"] = self._settings(entry, {})
            settings: JsonSchema = {"$ref": _reference(f"step.{entry.name}")}
            is_needed = self._definitions[f"step.{entry.name}"]["required"]
            about = {"description": _about(entry)}
            kinds[entry.name] = {**about, **({"allOf": [settings]} if is_needed else or_empty(settings))}
        name = {"type": "string", "minLength": 1, "description": "name of the step, for addresses"}
        policy = model_schema(StepPolicy, "step.", self._definitions)
        failing = "reactions to its failures and exceeded budgets, instead of the run's policy"
        return {
            "type": "object",
            "properties": {**kinds, "name": name, "policy": {"description": failing, **or_empty(policy)}},
            "additionalProperties": False,
            "oneOf": [{"required": [kind]} for kind in kinds],
        }

    def _scan(self) -> JsonSchema:
        """Values of addresses, or a scanner with its settings and ranges. Neither has expressions."""
        scanner = self._choice(_SCANNER, AdaptiveChoice)
        aims = [
            {"required": [aim], "properties": {aim: {"type": "string"}}} for aim in ("maximise", "minimise")
        ]
        is_adaptive: JsonSchema = {"type": "object", "required": [AdaptiveChoice.key]}
        return {"if": is_adaptive, "then": {**scanner, "oneOf": aims}, "else": _grid_scan()}


def _about(entry: Entry) -> str:
    """The first paragraph of the docstring of a plugin, on one line."""
    return summary(entry.factory, entry.settings_model) or f"{entry.kind.replace('_', ' ')} of {entry.origin}"


def _grid_scan() -> JsonSchema:
    """Addresses with the values of each, or a list of such mappings."""
    three = {"type": "array", "minItems": 3, "maxItems": 3}
    forms: list[JsonSchema] = [{"type": "array", "minItems": 1}]
    for form in FORMS:
        one = {"type": "object", "required": [form], "properties": {form: three}}
        forms.append({**one, "additionalProperties": False})
    mapping = {"type": "object", "additionalProperties": {"anyOf": forms}}
    return {"anyOf": [mapping, {"type": "array", "items": mapping}]}


def _reference(name: str) -> str:
    return f"#/{DEFINITIONS}/{name}"
