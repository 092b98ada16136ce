"""JSON schemas of sequences and profiles, for editors.

The dialect is draft 7, which every editor reads. A schema says what can be said without context: keys,
types, limits of plain numbers, units. ``labseq check`` says the rest.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from inspect import cleandoc
from pathlib import Path
from types import FunctionType
from typing import Any, Final, Literal, TypeAlias, cast

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from labseq.config.profile import DeviceChoice, LinesChoice, MobileTweezersChoice, ProfileSpec
from labseq.config.scan import AdaptiveChoice
from labseq.config.sequence import AnalysisChoice, SequenceSpec, StepPolicySettings
from labseq.files import whole_file
from labseq.registry import Entry, Registry
from labseq.settings import Choice, DefaultIfEmpty, PatternChoice, Quantity, Settings, si_of
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


FileKind = Literal["sequence", "profile"]

_ROLES: Final[dict[str, type[Choice]]] = {
    "camera": Choice,
    "static_tweezers": Choice,
    "mobile_tweezers": MobileTweezersChoice,
    "detector": Choice,
    "lines": LinesChoice,
    "simulation": Choice,
}
_SCANNER: Final = "scanner"
_AIMS: Final = ("maximise", "minimise")
_MAY_BE_EMPTY: Final = frozenset({"lines", "simulation"})


def file_schema(kind: FileKind, registry: Registry) -> JsonSchema:
    """The schema of a kind of file.

    Args:
        kind: "sequence" or "profile".
        registry: What the plugins offer.

    Returns:
        JSON schema, draft 7, JSON-ready.
    """
    return _FileSchema(registry).sequence() if kind == "sequence" else _FileSchema(registry).profile()


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
        self._fill(keys, "shot", {"type": "array", "minItems": 1, "items": self._step()})
        keys["scan"] = {"description": keys["scan"]["description"]}  # more of it below
        # There is a default planner, and a scan says how many shots there are.
        file["required"] = [key for key in file["required"] if key not in ("planner", "shots")]
        file["if"], file["else"] = {"required": ["scan"]}, {"required": ["shots"]}
        whole = or_expression(file)
        self._fill(whole["properties"], "scan", or_empty(self._scan()))  # where no expression may stand
        return self._whole("labseq sequence", whole)

    def profile(self) -> JsonSchema:
        file = self._file(ProfileSpec)
        keys = file["properties"]
        for role, core in _ROLES.items():
            choice = self._choice(role, core)
            self._fill(keys, role, or_empty(choice) if role in _MAY_BE_EMPTY else choice)
        devices = {"type": "object", "additionalProperties": self._choice("device", DeviceChoice)}
        self._fill(keys, "devices", or_empty(devices))
        calibrations = keys["calibrations"]  # just a folder, or `off`, may stand in its place
        keys["calibrations"] = {**calibrations, "anyOf": [*calibrations["anyOf"], {"type": "string"}]}
        return self._whole("labseq hardware profile", or_expression(file))

    def _file(self, model: type[Settings]) -> JsonSchema:
        return model_schema(model, "", self._definitions)

    def _whole(self, title: str, file: JsonSchema) -> JsonSchema:
        used = {name: self._definitions[name] for name in sorted(_reached(file, self._definitions))}
        written = {
            name: one if name.startswith(f"{_SCANNER}.") else or_expression(one) for name, one in used.items()
        }
        return {"$schema": DRAFT, "title": title, **file, DEFINITIONS: written}

    def _fill(self, keys: JsonSchema, key: str, schema: JsonSchema) -> None:
        """Say what stands behind a key; what it is for is told by the file's own model."""
        keys[key] = {"description": keys[key]["description"], **schema}

    def _choice(self, kind: str, core: type[Choice]) -> JsonSchema:
        """A plugin chosen by name, and the settings of just that plugin beside the name."""
        entries = [entry for entry in self._registry.entries() if entry.kind == kind]
        own = model_schema(core, f"{kind}.", self._definitions)
        key = core.key
        name = {
            **own["properties"].pop(key),
            "enum": [entry.name for entry in entries],
            "enumDescriptions": [_file_schema_about(entry) for entry in entries],
        }
        rules: list[JsonSchema] = []
        for entry in entries:
            defined = f"{kind}.{entry.name}"
            self._definitions[defined] = self._settings(entry, {key: {}, **own["properties"]})
            is_meant = {"type": "object", "properties": {key: {"const": entry.name}}, "required": [key]}
            rules.append({"if": is_meant, "then": {"$ref": _reference(defined)}})
        needed: list[str] = own.get("required", [key])
        return {"type": "object", "properties": {key: name}, "required": needed, "allOf": rules}

    def _settings(self, entry: Entry, around: JsonSchema) -> JsonSchema:
        """The settings of an entry, with the core's keys that may stand beside them."""
        mine = model_schema(entry.settings_model, f"{entry.kind}.{entry.name}.", self._definitions)
        required = [key for key in mine.get("required", []) if key not in around]
        merged = {**mine, "properties": {**mine["properties"], **around}, "required": required}
        return {"additionalProperties": False, **merged, "description": _file_schema_about(entry)}

    def _step(self) -> JsonSchema:
        """One kind of step with its settings, and perhaps a name and a policy."""
        kinds: JsonSchema = {}
        for entry in (one for one in self._registry.entries() if one.kind == "step"):
            self._definitions[f"step.{entry.name}"] = self._settings(entry, {})
            settings: JsonSchema = {"$ref": _reference(f"step.{entry.name}")}
            is_needed = self._definitions[f"step.{entry.name}"]["required"]
            about = {"description": _file_schema_about(entry)}
            kinds[entry.name] = {**about, **({"allOf": [settings]} if is_needed else or_empty(settings))}
        name = {"type": "string", "minLength": 1, "description": "name of the step, for addresses"}
        policy = model_schema(StepPolicySettings, "step.", self._definitions)
        failing = "what follows its failures and exceeded budgets, in place of the run's policy"
        return {
            "type": "object",
            "properties": {**kinds, "name": name, "policy": {"description": failing, **or_empty(policy)}},
            "additionalProperties": False,
            **_one_beside("name", "policy"),
        }

    def _scan(self) -> JsonSchema:
        """Values of addresses, or a scanner with its settings and the ranges that it chooses from."""
        scanner = self._choice(_SCANNER, AdaptiveChoice)
        aims = [{"required": [aim], "properties": {aim: {"type": "string"}}} for aim in _AIMS]
        is_adaptive: JsonSchema = {"type": "object", "required": [AdaptiveChoice.key]}
        return {"if": is_adaptive, "then": {**scanner, "oneOf": aims}, "else": _grid_scan()}


def _file_schema_about(entry: Entry) -> str:
    """The first paragraph of what the plugin says of itself, in one line."""
    speaks = isinstance(entry.factory, type | FunctionType)
    for text in (
        entry.factory.__doc__ if speaks else "",
        entry.settings_model and entry.settings_model.__doc__,
    ):
        if text:
            return " ".join(cleandoc(text).split("\n\n")[0].replace("``", "`").split())
    return f"{entry.kind.replace('_', ' ')} of {entry.origin}"


def _one_beside(*keys: str, n_given: int = 0) -> JsonSchema:
    """That one key stands in a mapping, beside those of the given keys that are there."""
    if not keys:
        return {"minProperties": n_given + 1, "maxProperties": n_given + 1}
    first, *others = keys
    return {
        "if": {"required": [first]},
        "then": _one_beside(*others, n_given=n_given + 1),
        "else": _one_beside(*others, n_given=n_given),
    }


def _grid_scan() -> JsonSchema:
    """Addresses and the values that each takes, or a list of such mappings."""
    three = {"type": "array", "minItems": 3, "maxItems": 3}
    forms: list[JsonSchema] = [{"type": "array", "minItems": 1}]
    for form in ("linspace", "range"):
        one = {"type": "object", "required": [form], "properties": {form: three}}
        forms.append({**one, "additionalProperties": False})
    mapping = {"type": "object", "additionalProperties": {"anyOf": forms}}
    return {"anyOf": [mapping, {"type": "array", "items": mapping}]}


def _reference(name: str) -> str:
    return f"#/{DEFINITIONS}/{name}"


def _reached(schema: JsonSchema, definitions: JsonSchema) -> set[str]:
    """Names of the definitions that a schema refers to, also by way of others."""
    reached: set[str] = set()
    left: list[object] = [schema]
    while left:
        node = left.pop()
        if isinstance(node, list):
            left += cast("list[object]", node)
        elif isinstance(node, dict):
            inner = cast("dict[str, object]", node)
            reference = inner.get("$ref")
            name = reference.rpartition("/")[2] if isinstance(reference, str) else ""
            if name and name not in reached:
                reached.add(name)
                left.append(definitions[name])
            left += inner.values()
    return reached


SCHEMA_FOLDER: Final = ".labseq"
"""Folder of the schemas, beside the sequences and profiles that name them."""

KINDS: Final[tuple[FileKind, ...]] = ("sequence", "profile")


def schema_text(kind: FileKind, registry: Registry) -> str:
    """The JSON schema of a kind of file, as text."""
    return json.dumps(file_schema(kind, registry), indent=1, ensure_ascii=False) + "\n"


def schema_path(kind: FileKind, folder: Path) -> Path:
    """Where the files of a folder look for their schema."""
    return folder / SCHEMA_FOLDER / f"{kind}.schema.json"


def write_schema(kind: FileKind, folder: Path, registry: Registry) -> Path:
    """Write the schema that files of this kind in a folder name in their first line.

    Raises:
        OSError: It cannot be written.
    """
    path = schema_path(kind, folder)
    path.parent.mkdir(exist_ok=True)
    with whole_file(path) as file:
        file.write(schema_text(kind, registry).encode())
    return path


def refresh_schemas(folder: Path, registry: Registry) -> list[Path]:
    """Write those schemas anew that a folder has, because there are other plugins now.

    Raises:
        OSError: One cannot be written.
    """
    return [write_schema(kind, folder, registry) for kind in KINDS if schema_path(kind, folder).is_file()]
