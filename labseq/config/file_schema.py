"""JSON schema of sequence and profile files, with the settings of every plugin that is there."""

from __future__ import annotations

from inspect import cleandoc
from types import FunctionType
from typing import Final, Literal, cast

from labseq.config.adaptive import AdaptiveChoice
from labseq.config.analyses import AnalysisChoice
from labseq.config.devices import DeviceChoice
from labseq.config.fields import Choice, PatternChoice
from labseq.config.json_schema import (
    DEFINITIONS,
    DRAFT,
    JsonSchema,
    model_schema,
    or_empty,
    or_expression,
)
from labseq.config.lines import LinesChoice
from labseq.config.policies import StepPolicySettings
from labseq.config.profile import MobileTweezersChoice, ProfileSpec
from labseq.config.sequence import SequenceSpec
from labseq.config.settings import Settings
from labseq.registry import Entry, Registry

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
            "enumDescriptions": [_about(entry) for entry in entries],
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
        return {"additionalProperties": False, **merged, "description": _about(entry)}

    def _step(self) -> JsonSchema:
        """One kind of step with its settings, and perhaps a name and a policy."""
        kinds: JsonSchema = {}
        for entry in (one for one in self._registry.entries() if one.kind == "step"):
            self._definitions[f"step.{entry.name}"] = self._settings(entry, {})
            settings: JsonSchema = {"$ref": _reference(f"step.{entry.name}")}
            is_needed = self._definitions[f"step.{entry.name}"]["required"]
            about = {"description": _about(entry)}
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


def _about(entry: Entry) -> str:
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
