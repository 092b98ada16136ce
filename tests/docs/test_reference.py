"""Nothing is undocumented: settings, plugins, commands, roles and errors are in the built reference."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FunctionType
from typing import Any, get_args, get_origin
from xml.etree.ElementTree import Element

import pytest
import typer
from pydantic import BaseModel, create_model
from pydantic.fields import FieldInfo

import labseq
from labseq import errors, hookspecs, plugin, roles, testing
from labseq.builtin import labseq_register
from labseq.cli.app import app
from labseq.config.profile import (
    BudgetSettings,
    CalibrationSettings,
    GridSettings,
    MobileTweezersChoice,
    ProfileSpec,
    TimeoutSettings,
    load_profile,
)
from labseq.config.sequence import PolicySettings, SequenceSpec, StepPolicySettings, load_sequence
from labseq.config.yaml_nodes import compose
from labseq.console.errors import exit_code_of
from labseq.registry import KINDS, Entry, Registry
from labseq.settings import Choice, PatternChoice
from labseq.testing.contracts import HardwareContract

Pages = Mapping[str, Element]
Tables = Mapping[str, Element]

ROOT = Path(__file__).parents[2]
STRATEGIES = "labseq.testing.strategies"
SEQUENCE = {
    "labseq": "1",
    "name": "x",
    "profile": "virtual",
    "shots": "1",
    "seed": "1",
    "target": "{pattern: compact, rows: 5, cols: 5}",
    "planner": "{use: psca}",
    "record_frames": "all",
    "attempts": "1",
    "policy": "{}",
    "plugin_folders": "[]",
    "shot": "[{image: {}}]",
}
PROFILE = {
    "labseq": "1",
    "name": "x",
    "grid": "{rows: 5, cols: 5, spacing: 5 um}",
    "camera": "{use: virtual}",
    "static_tweezers": "{use: virtual}",
    "mobile_tweezers": "{use: virtual}",
    "detector": "{use: threshold}",
    "devices": "{}",
    "simulation": "{use: virtual}",
    "calibrations": "off",
    "plugin_folders": "[]",
    "timeouts": "{}",
    "budgets": "{}",
}


def own_entries() -> list[Entry]:
    """What labseq and the plugins that it ships register."""
    registry = Registry()
    labseq_register(registry)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    for module in project["project"]["entry-points"]["labseq"].values():
        __import__(module, fromlist=["labseq_register"]).labseq_register(registry)
    return registry.entries()


SUBJECTS: dict[str, type[BaseModel] | None] = {
    "profile-grid": GridSettings,
    "profile-mobile_tweezers": MobileTweezersChoice,
    "profile-calibrations": CalibrationSettings,
    "profile-timeouts": TimeoutSettings,
    "profile-budgets": BudgetSettings,
    "sequence-policy": PolicySettings,
    "step_policy": StepPolicySettings,
    **{f"{entry.kind}-{entry.name}": entry.settings_model for entry in own_entries()},
}
"""Class of a table in the reference -> the model whose keys it lists, at any depth."""
FILES: dict[str, type[BaseModel]] = {"sequence": SequenceSpec, "profile": ProfileSpec}
MODELS = sorted({m for m in [*SUBJECTS.values(), *FILES.values(), Choice, PatternChoice] if m}, key=str)


def settings_of(model: type[BaseModel] | None, prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Every key of a model and of the mappings in it, with its field."""
    for name, field in (model.model_fields if model is not None else {}).items():
        key = prefix + (field.alias or name)
        yield key, field
        optional = get_args(field.annotation) if type(None) in get_args(field.annotation) else ()
        by_name = get_args(field.annotation)[1:] if get_origin(field.annotation) is dict else ()
        for inner in by_name:
            if isinstance(inner, type) and issubclass(inner, BaseModel):
                yield from settings_of(inner, f"{key}.NAME.")
        listed = get_args(field.annotation) if get_origin(field.annotation) is tuple else ()
        for inner in (field.annotation, *optional, *listed):
            if isinstance(inner, type) and issubclass(inner, BaseModel) and not issubclass(inner, Choice):
                yield from settings_of(inner, f"{key}.")


@pytest.fixture(scope="session")
def tables(pages: Pages) -> Tables:
    """Everything that a directive of the reference shows, by the classes that it gave it."""
    found: dict[str, Element] = {}
    for page in (tree for name, tree in pages.items() if name.startswith("reference/")):
        for element in [*page.iter("table"), *page.iter("paragraph")]:
            classes = element.get("classes", "").removeprefix("colwidths-auto ")
            found[f"{classes} {text(element.find('.//thead//entry'))}".strip()] = element
    return found


def rows_of(tables: Tables, subject: str) -> dict[str, list[str]]:
    """Key -> the texts of its row, in the table of a subject."""
    shown = tables.get(f"settings {subject} key") or tables.get(f"settings {subject}")
    assert shown is not None, f"no {{settings}} or {{registered}} directive shows '{subject}'"
    rows = [[text(cell) for cell in row.iter("entry")] for row in shown.iter("row")]
    return {row[0]: row for row in rows[1:]}


def text(element: Element | None) -> str:
    return "" if element is None else "".join(element.itertext()).strip()


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model.__module__}.{model.__name__}")
def test_every_setting_says_what_it_is(model: type[BaseModel]) -> None:
    assert model.__doc__
    for key, field in settings_of(model):
        assert field.description, f"'{key}' of {model.__name__} has no description"
        assert re.fullmatch(r"(?s)[a-z0-9\[].*[^.\s]", field.description), field.description


@pytest.mark.parametrize("subject", SUBJECTS)
def test_every_setting_is_in_the_reference(tables: Tables, subject: str) -> None:
    assert [*rows_of(tables, subject)] == [key for key, _ in settings_of(SUBJECTS[subject])]


@pytest.mark.parametrize("kind", FILES)
def test_every_key_of_a_file_is_in_the_reference(tables: Tables, kind: str) -> None:
    assert [*rows_of(tables, kind)] == [*FILES[kind].model_fields]


@pytest.mark.parametrize("subject", SUBJECTS)
def test_a_default_may_be_written_as_the_reference_writes_it(tables: Tables, subject: str) -> None:
    rows = rows_of(tables, subject)
    for key, field in settings_of(SUBJECTS[subject]):
        default = rows[key][2]
        assert (default == "required") == field.is_required(), key
        if default not in ("required", "none", "as below"):
            node = compose(default, "the reference")
            assert node is not None
            read = read_as(field, node.plain())
            assert read == (pytest.approx(field.default) if isinstance(read, float) else field.default), key


def read_as(field: FieldInfo, value: object) -> object:
    """The value of a field for what stands in a file."""
    kind: Any = field.annotation
    one: Any = create_model("One", it=(kind, field))
    return one.model_validate({"it": value}, by_name=True).it


def test_the_reference_says_which_keys_of_a_sequence_may_be_left_out(tables: Tables, tmp_path: Path) -> None:
    for key, row in rows_of(tables, "sequence").items():
        path = written(tmp_path, SEQUENCE, without=key)
        if row[2] == "required":
            with pytest.raises(labseq.ConfigError, match=f"'{key}' is missing"):
                load_sequence(path)
        else:
            load_sequence(path)


def test_the_reference_says_which_keys_of_a_profile_may_be_left_out(tables: Tables, tmp_path: Path) -> None:
    for key, row in rows_of(tables, "profile").items():
        path = written(tmp_path, PROFILE, without=key)
        if row[2] == "required":
            with pytest.raises(labseq.ConfigError, match=f"'{key}' is missing"):
                load_profile(path, beside=tmp_path)
        else:
            load_profile(path, beside=tmp_path)


def written(folder: Path, content: Mapping[str, str], *, without: str) -> Path:
    """A file with all keys but one."""
    path = folder / "x.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in content.items() if key != without))
    return path


def test_every_command_and_option_is_in_the_reference(tables: Tables) -> None:
    for name, command in commands_in(typer.main.get_command(app)):
        for parameter in command.params:
            kind = parameter.param_type_name
            shown = tables.get(f"{f'command {name}'.strip()} {kind}")
            assert shown is not None, f"the reference has no {{command}} {name}"
            words = {word for code in shown.iter("literal") for word in re.split(r"[\s,\[\]=]+", text(code))}
            assert {*(parameter.opts if kind == "option" else [parameter.metavar])} <= words, parameter.name
            assert parameter.help, f"{name}: {parameter.name} has no help"


def commands_in(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The group itself, and all commands in it at any depth: "bench-planners"."""
    yield prefix.rstrip("-"), group
    for name, command in getattr(group, "commands", {}).items():
        yield from commands_in(command, f"{prefix}{name}-")


def test_every_hook_is_in_the_reference(pages: Pages) -> None:
    hooks = [name for name in vars(hookspecs) if name.startswith("labseq_")]
    assert [term.partition("(")[0] for term in terms_of(pages, "plugin-api") if "labseq_" in term] == hooks


def test_every_role_and_method_is_in_the_reference(pages: Pages) -> None:
    every = [one for name, one in vars(roles).items() if name in plugin.__all__ and isinstance(one, type)]
    assert {*KINDS} - {"pattern"} <= {snake_case(role.__name__) for role in every}
    shown = {re.split(r"[(:]", term)[0] for term in terms_of(pages, "plugin-api")}
    for role in every:
        members = {name for name, one in vars(role).items() if isinstance(one, FunctionType | property)}
        about = (role.__doc__ or "?").partition("\n")[0].replace("`", "")
        assert about in text_of(pages, "plugin-api"), role
        assert {name for name in members if not name.startswith("_")} <= shown, role


def snake_case(name: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()


def test_every_method_of_the_registry_is_in_the_reference(pages: Pages) -> None:
    offers = {name for name, one in vars(Registry).items() if isinstance(one, FunctionType)} & {*KINDS}
    shown = {term.partition("(")[0] for term in terms_of(pages, "plugin-api")}
    assert offers == {*KINDS}
    assert {f"registry.{name}" for name in offers} <= shown


def test_every_public_name_is_in_the_reference(pages: Pages) -> None:
    (table,) = (
        one for one in pages["reference/python"].iter("table") if "namespace" in one.get("classes", "")
    )
    rows = [[text(cell) for cell in row.iter("entry")] for row in table.iter("row")][1:]
    stub = (ROOT / "labseq" / "__init__.pyi").read_text("utf-8")
    assert [name for name, _ in rows] == sorted(re.findall(r"^    (\w+) as \1,$", stub, re.MULTILINE))
    assert [name for name, summary in rows if len(summary.split()) < 3] == []


def test_every_model_of_a_file_has_a_table(tables: Tables) -> None:
    shown = {row for subject in tables for row in keys_in(tables[subject])}
    for file in FILES.values():
        for model in models_below(file):
            for key in model.model_fields:
                assert any(row.split(".")[-1] == key for row in shown), f"{model.__name__}.{key}"


def keys_in(table: Element) -> list[str]:
    return [text(row.find("entry")) for row in table.iter("row")]


def models_below(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    """The models of all keys of a file, at any depth."""
    for field in model.model_fields.values():
        for inner in models_in(field.annotation):
            yield inner
            yield from models_below(inner)


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)


def test_every_promise_strategy_and_fake_is_in_the_reference(pages: Pages) -> None:
    shown = text_of(pages, "testing")
    for suite in (*testing.SUITES.values(), HardwareContract):
        assert suite.__name__ in shown
        tests = [getattr(suite, name) for name in dir(suite) if name.startswith("test_")]
        assert tests
        for test in tests:
            assert test.promise.replace("`", "") in shown, f"{suite.__name__}.{test.__name__}"
            assert test.__name__ in shown
    names = [name for name in vars(testing.strategies) if name.islower() and not name.startswith("_")]
    own = [name for name in names if getattr(vars(testing.strategies)[name], "__module__", "") == STRATEGIES]
    assert {"occupancies", "targets", "grids", "plans", "tone_programs"} <= {*own}
    assert {*own} <= {re.split(r"[(:]", term)[0] for term in terms_of(pages, "testing")}
    for name in testing.fakes.__all__:
        assert name in shown


def test_every_error_and_exit_code_is_in_the_reference(pages: Pages) -> None:
    classes = [one for one in vars(errors).values() if isinstance(one, type)]
    every = [one for one in classes if issubclass(one, errors.LabseqError)]
    assert {*terms_of(pages, "errors")} == {*(one.__name__ for one in every), "Problem"}
    codes = {one.exit_code for one in every} | {exit_code_of(errors.StopRequested(n)) for n in (2, 15)}
    table = next(pages["reference/errors"].iter("tbody"))
    shown = {int(code) for row in table.iter("row") for code in re.findall(r"\d+", text(row[0]))}
    assert shown == codes | {0}


def test_every_environment_variable_is_in_the_reference(pages: Pages) -> None:
    files = [path for folder in ("labseq", "plugins") for path in (ROOT / folder).rglob("*.py")]
    sources = "".join(path.read_text("utf-8") for path in files)
    for name in {*re.findall(r'"(LABSEQ_[A-Z_]+)"', sources)} - {"LABSEQ_API"}:
        assert name in terms_of(pages, "cli")


def terms_of(pages: Pages, page: str) -> list[str]:
    """What the definition lists of a page define."""
    return [text(term) for term in pages[f"reference/{page}"].iter("term")]


def text_of(pages: Pages, page: str) -> str:
    return text(pages[f"reference/{page}"])
