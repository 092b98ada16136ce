"""Nothing is undocumented, and the links of the pages lead to what is there, generated headings included."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest
from labseq_virtual.records import FATES
from pydantic import create_model

import labseq
from labseq import errors, plugin, roles, testing
from labseq.cli import live
from labseq.config.profile import ProfileSpec, load_profile
from labseq.config.sequence import SequenceSpec, load_sequence
from labseq.config.yaml_nodes import compose
from labseq.console.errors import EXIT_CODES, exit_code_of
from labseq.data.fit_models import MODELS as FITS
from labseq.model.policies import StepPolicy
from labseq.plugin import simulation, system
from labseq.registry import Registry
from labseq.roles import ROLES
from labseq.scaffold import python_reference, reference
from labseq.scaffold.reference import Table, settings
from labseq.settings import Choice, PatternChoice, SettingsType, settings_at, settings_of

from .scripts import load_script

ROOT = Path(__file__).parents[2]
IN_PLUGIN = {*plugin.__all__, *simulation.__all__, *system.__all__}
SCRIPT: Any = load_script("make_reference")
WRITTEN = {path: path.read_text("utf-8") for path in sorted((ROOT / "docs").rglob("*.md"))}
TEXTS: dict[Path, str] = {path: SCRIPT.complete(text) for path, text in WRITTEN.items()}
PARTS = {part for text in WRITTEN.values() for part in SCRIPT.PART.findall(text)}
LINK = re.compile(r"(?<!`)\]\((?!https?:|mailto:)([^)#\s]*)#?([^)\s]*)\)")
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


SUBJECTS: dict[str, SettingsType | None] = {
    "step policy": StepPolicy,
    **{f"{entry.kind} {entry.name}": entry.settings_model for entry in SCRIPT.registry().entries()},
}
FILES: dict[str, SettingsType] = {"sequence": SequenceSpec, "profile": ProfileSpec}
MODELS = sorted({m for m in [*SUBJECTS.values(), *FILES.values(), Choice, PatternChoice] if m}, key=str)


def test_every_link_leads_to_a_page_and_a_heading() -> None:
    texts = TEXTS | {path: path.read_text("utf-8") for path in ROOT.glob("*.md")}
    for page, text in texts.items():
        for file, anchor in LINK.findall(text):
            target = (page.parent / file).resolve() if file else page
            assert target.exists(), f"{page.relative_to(ROOT)} links to {file}"
            if anchor and target in texts:
                assert anchor in anchors(texts[target]), f"{page.relative_to(ROOT)} links to {file}#{anchor}"


@cache
def anchors(text: str) -> set[str]:
    """What links may name: the headings, as MyST and GitHub write them."""
    headings = re.findall(r"^#{1,3} (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_everything_is_on_a_page() -> None:
    found = {" ".join(("command", *names)) for names, _ in reference.commands_below(SCRIPT.PROGRAM)}
    found |= {f"role {name}" for name in reference.roles_by_name() if name in IN_PLUGIN}
    found |= {f"contract {kind}" for kind in (*testing.SUITES, "hardware")}
    found |= {f"class {name}" for name in ("Session", "Run", "Shot")}
    found |= {f"plugins {kind}" for kind in ROLES if kind not in ("step", "pattern")}
    registry: Registry = SCRIPT.registry()
    found |= {f"settings {kind} {name}" for kind in ("step", "pattern") for name in registry.names(kind)}
    found |= {f"settings {kind} top" for kind in FILES} | {"settings sequence shot policy", "command"}
    # what takes arguments is there as often as it is needed
    found |= SCRIPT.PARTS.keys() - {"command", "role", "contract", "plugins", "settings", "source", "class"}
    assert sorted(found - PARTS) == []


def test_every_model_of_a_file_is_on_a_page() -> None:
    shown = "".join(TEXTS.values())
    for file in FILES.values():
        for model in models_below(file):
            for one in settings_of(model):
                assert re.search(rf"\| `([\w.]+\.)?{one.key}` \|", shown), f"{model.__name__}.{one.key}"


def test_every_topic_can_be_explained() -> None:
    found = reference.topics(SCRIPT.registry(), SCRIPT.PROGRAM)
    assert {*ROLES, *FILES, "unit", "command", "quantity", "event", "role", "error"} <= found.keys()
    for name, topic in found.items():
        assert topic.about, name
        lines = reference.plain(topic.blocks(), 80)
        assert lines, name
        is_table = [not isinstance(block, reference.Code) for block in topic.blocks()]
        assert all(is_table) <= (max(map(len, lines)) <= 80), name
        assert "`" not in "".join(lines), name


def test_what_code_and_the_shell_name_can_be_explained() -> None:
    topics = reference.topics(SCRIPT.registry(), SCRIPT.PROGRAM)
    for name in ("PlannerContract", "open_run", "Session", "Run", "Shot", "LABSEQ_DATA"):
        assert any(found.endswith(f" {name}") for found in reference.find(topics, name)), name
    suites = {suite.__name__ for suite in testing.SUITES.values()}
    assert suites <= {name.removeprefix("contract ") for name in topics}
    *_, promises = python_reference.contract("PlannerContract")
    *_, shown = SCRIPT.contract("planner")
    assert isinstance(promises, Table)
    assert {row[1] for row in promises.rows} == {row[0] for row in shown.rows}


def printed_words() -> set[str]:
    """Heads of columns and names of rows, as the code that prints them has them."""
    words = {*live.STAGES, *FITS, *(cause.replace("_", " ") for cause in FATES[1:])}
    for file in Path(labseq.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            match node:
                case ast.Call(
                    func=ast.Name("Column") | ast.Attribute(attr="add_column" | "add_row"),
                    args=[ast.Constant(str(word)), *_],
                ):
                    words.add(word)
                case ast.FunctionDef(returns=ast.Name("Facts")):
                    pairs = [one.elts for one in ast.walk(node) if isinstance(one, ast.Tuple)]
                    words |= {str(pair[0].value) for pair in pairs if isinstance(pair[0], ast.Constant)}
                case _:
                    pass
    return words - {""}


def test_every_printed_word_can_be_explained() -> None:
    topics = reference.topics(SCRIPT.registry(), SCRIPT.PROGRAM)
    for word in printed_words():
        names = [name.lower().replace(".", " ") for name in reference.find(topics, word)]
        assert any(name.endswith(word.lower()) for name in names), word


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model.__module__}.{model.__name__}")
def test_every_setting_says_what_it_is(model: SettingsType) -> None:
    assert model.__doc__
    for one in (one for inner in (model, *models_below(model)) for one in settings_of(inner)):
        assert one.description, f"'{one.key}' of {model.__name__} has no description"
        assert re.fullmatch(r"(?s)[a-z0-9\[`'].*[^.\s]", one.description), one.description


def rows_of(found: Any) -> dict[str, Sequence[str]]:
    """Key -> its row in a table of settings."""
    return {row[0].strip("`"): row for row in found.rows} if isinstance(found, Table) else {}


@pytest.mark.parametrize("subject", SUBJECTS)
def test_a_default_may_be_written_as_the_reference_writes_it(subject: str) -> None:
    model = SUBJECTS[subject]
    for key, row in rows_of(settings(model)).items():
        *loc, name = key.replace(".NAME", "").split(".")
        default = row[2].strip("`")
        if model is not None and default not in ("required", "none", "as below"):
            (setting,) = settings_at(model, (*loc, name))
            node = compose(default, "the reference")
            assert node is not None
            read = read_as(setting.annotation, node.plain())
            assert read == (pytest.approx(setting.default) if isinstance(read, float) else setting.default)


def read_as(kind: Any, value: object) -> object:
    """The value of a setting for what stands in a file."""
    one: Any = create_model("One", it=(kind, ...))
    return one.model_validate({"it": value}).it


def test_the_reference_says_which_keys_of_a_sequence_may_be_left_out(tmp_path: Path) -> None:
    for key, row in rows_of(SCRIPT.file_settings("sequence", top=True)).items():
        path = written(tmp_path, SEQUENCE, without=key)
        if row[2].startswith("required"):
            with pytest.raises(labseq.ConfigError, match=f"'{key}' is missing"):
                load_sequence(path)
        if row[2] == "required without `scan`":
            path.write_text(path.read_text() + "scan: {shot.0.image.exposure: [40 ms, 45 ms]}\n")
        if row[2] != "required":
            load_sequence(path)


def test_the_reference_says_which_keys_of_a_profile_may_be_left_out(tmp_path: Path) -> None:
    for key, row in rows_of(SCRIPT.file_settings("profile", top=True)).items():
        path = written(tmp_path, PROFILE, without=key)
        if row[2] == "required":
            with pytest.raises(labseq.ConfigError, match=f"'{key}' is missing"):
                load_profile(path)
        else:
            load_profile(path)


def written(folder: Path, content: Mapping[str, str], *, without: str) -> Path:
    """A file with all keys but one."""
    path = folder / "x.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in content.items() if key != without))
    return path


def test_every_argument_has_its_help() -> None:
    for names, command in [((), SCRIPT.PROGRAM), *reference.commands_below(SCRIPT.PROGRAM)]:
        assert [one.name for one in command.params if not one.help] == [], names


def test_every_method_of_the_registry_is_a_kind() -> None:
    offers = {name for name, one in vars(Registry).items() if isinstance(one, FunctionType)} & {*ROLES}
    assert offers == {*ROLES}
    every = [name for name in reference.roles_by_name() if name in IN_PLUGIN]
    assert {*ROLES} - {"pattern"} <= {snake_case(name) for name in every}


def snake_case(name: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()


def test_every_public_name_says_what_it_is() -> None:
    table: Any = python_reference.names()[0]
    stub = (ROOT / "labseq" / "__init__.pyi").read_text("utf-8")
    names = sorted({*re.findall(r"\b(\w+) as \1\b", stub)} - {"plugin"})  # a module, on a page of its own
    assert [row[0].strip("`") for row in table.rows] == names
    assert [row[0] for row in table.rows if len(row[1].split()) < 3] == []


def models_below(model: SettingsType) -> Iterator[SettingsType]:
    """The models of all keys of a file, at any depth."""
    for setting in settings_of(model):
        for inner in setting.models:
            yield inner
            yield from models_below(inner)


def test_every_promise_and_strategy_says_what_it_is() -> None:
    for kind in (*testing.SUITES, "hardware"):
        *_, table = SCRIPT.contract(kind)
        assert table.rows
        assert all(promise and tried for promise, _, tried in table.rows), kind
    named = {block.term.partition("(")[0] for block in SCRIPT.strategy_list()}
    assert {"occupancies", "targets", "grids", "plans", "tone_programs"} <= named


def test_every_error_exit_code_and_event_is_in_the_reference() -> None:
    classes = [one for one in vars(errors).values() if isinstance(one, type)]
    every = [one for one in classes if issubclass(one, errors.LabseqError)]
    assert {*reference.errors_by_name().values()} == {*every}
    codes = {one.exit_code for one in every} | {exit_code_of(errors.StopRequested(n)) for n in (1, 2, 15)}
    assert {int(code) for text in EXIT_CODES for code in text.split(", ")} == codes | {0}
    emitted = re.findall(r'(?:event|emit|log|_log_event)\(\s*"([a-z_]+)"', sources("labseq"))
    assert {*emitted} <= {*roles.EVENTS}
    assert all(f'"{name}"' in sources("labseq").replace(f'    "{name}": "', "") for name in roles.EVENTS)


def test_every_environment_variable_is_in_the_reference() -> None:
    page = TEXTS[ROOT / "docs" / "reference" / "cli.md"]
    for name in {*re.findall(r'"(LABSEQ_[A-Z_]+)"', sources("labseq", "plugins"))} - {"LABSEQ_API"}:
        assert f"| `{name}` |" in page


def sources(*folders: str) -> str:
    files = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return "".join(path.read_text("utf-8") for path in files)
