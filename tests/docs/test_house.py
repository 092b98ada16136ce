"""The page on the house says what is so; files at the top level are those it names."""

from __future__ import annotations

import ast
import re
import subprocess
import tomllib
from typing import Any

import pytest
import yaml

from labseq import hookspecs, model, roles
from labseq.registry import KINDS

from .blocks import PLUGINS, ROOT

PAGE = (ROOT / "docs" / "explanation" / "architecture.md").read_text("utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
CONTRACT = PROJECT["tool"]["importlinter"]["contracts"][0]
HIDDEN = {".ci", ".gitignore", ".pre-commit-config.yaml"}
"""At the top level, for tools only."""


def section(title: str) -> str:
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]


def named(text: str) -> set[str]:
    """What stands in code in a text."""
    return set(re.findall(r"`([^`]+)`", text))


def classes_of(module: Any) -> set[str]:
    return {name for name, one in vars(module).items() if isinstance(one, type) and not name.startswith("_")}


def test_the_floors_are_those_of_the_contract() -> None:
    first_cells = [
        row.split(" | ")[0] for row in re.findall(r"^\| (`.+) \|$", section("Floors"), re.MULTILINE)
    ]
    floors = [cell.replace("`", "").replace("\\|", "|") for cell in first_cells]
    assert floors == CONTRACT["layers"]
    rooms = {room for layer in CONTRACT["layers"] for room in re.split(r" [|:] ", layer)}
    there = {
        path.stem
        for path in (ROOT / "labseq").iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert there == rooms | {"testing", "__main__", "__init__"}


def test_every_plugin_is_there_and_no_other() -> None:
    rows = named("\n".join(re.findall(r"^\| (`labseq_.*?) \|", section("Plugins"), re.MULTILINE)))
    assert rows == set(PLUGINS) == {path.name for path in (ROOT / "plugins").glob("labseq_*")}


@pytest.mark.parametrize("name", PLUGINS)
def test_every_plugin_has_a_page_and_its_registration_is_short(name: str) -> None:
    folder = ROOT / "plugins" / name
    assert (folder / "README.md").is_file()
    assert (folder / "py.typed").is_file()
    assert len((folder / "__init__.py").read_text("utf-8").splitlines()) <= 30


@pytest.mark.parametrize("name", PLUGINS)
def test_no_plugin_imports_another(name: str) -> None:
    text = "".join(path.read_text("utf-8") for path in (ROOT / "plugins" / name).rglob("*.py"))
    others = set(re.findall(r"^\s*(?:from|import) (labseq_\w+)", text, re.MULTILINE)) - {name}
    assert others == set()


def test_every_role_capability_hook_and_type_is_there() -> None:
    assert named(section("Roles")) >= classes_of(roles)
    assert named(section("Domain types")) == classes_of(model)
    assert {name for name in vars(hookspecs) if name.startswith("labseq_")} <= named(section("Hooks"))


def test_only_the_rooms_that_say_so_import_a_library() -> None:
    owners = {
        "typer": {"cli"},
        "rich": {"cli"},
        "h5py": {"recording"},
        "numba": {"kernels"},
        "pydantic": {"config"},
        "yaml": {"config"},
        "pluggy": {"plugins", "_markers"},
    }
    for library, rooms in owners.items():
        pattern = re.compile(rf"^\s*(?:from|import) {library}\b", re.MULTILINE)
        found = {
            path.relative_to(ROOT / "labseq").parts[0].removesuffix(".py")
            for path in (ROOT / "labseq").rglob("*.py")
            if pattern.search(path.read_text("utf-8"))
        }
        assert found - {"testing"} == rooms, library


def test_every_profile_and_sequence_is_spoken_of() -> None:
    pages = "".join(path.read_text("utf-8") for path in (ROOT / "docs").rglob("*.md"))
    profiles = {path.stem for path in (ROOT / "hardware_profiles").glob("*.yaml")}
    listed = (ROOT / "docs" / "reference" / "profile.md").read_text("utf-8")
    assert set(re.findall(r"^\| `(\w+)` \|", listed, re.MULTILINE)) == profiles
    patterns = {path.name for path in (ROOT / "sequences").glob("*.yaml")}
    assert {name for name in patterns if f"sequences/{name}" not in pages} == set()


def test_the_top_level_is_as_the_page_says() -> None:
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip("not in a checkout")
    there = {line.partition("/")[0] for line in done.stdout.splitlines()}
    assert there - HIDDEN == {
        name.rstrip("/") for name in named(section("Top level")) if "/" not in name.rstrip("/")
    }


def test_files_stay_small() -> None:
    files = [path for folder in ("labseq", "plugins") for path in (ROOT / folder).rglob("*.py")]
    assert [str(path) for path in files if len(path.read_text("utf-8").splitlines()) > 300] == []


def code_lines(function: ast.FunctionDef) -> int:
    """Lines of a function without its signature and docstring."""
    first = function.body[0]
    has_docstring = ast.get_docstring(function) is not None
    start = first.end_lineno if has_docstring else first.lineno - 1
    assert start is not None
    assert function.end_lineno is not None
    return function.end_lineno - start


def test_functions_stay_small() -> None:
    found = {
        f"{path.name} {one.name}": code_lines(one)
        for folder in ("labseq", "plugins")
        for path in (ROOT / folder).rglob("*.py")
        for one in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(one, ast.FunctionDef)
    }
    assert {name: n for name, n in found.items() if n > 55} == {}


def test_a_release_is_cited_as_it_is() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= citation.keys()
    assert citation["version"] == PROJECT["project"]["version"]
    assert citation["license"] == PROJECT["project"]["license"]
    (paper,) = citation["references"]
    assert {"type", "title", "authors"} <= paper.keys()
    for page in ("explanation/planners.md", "explanation/virtual-lab.md"):
        assert paper["title"] in " ".join((ROOT / "docs" / page).read_text("utf-8").split())
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert re.search(r"^## (\S+)", changes, re.MULTILINE)[1] == citation["version"]  # type: ignore[index]


def test_decisions_are_numbered_without_a_gap() -> None:
    pages = sorted((ROOT / "docs" / "explanation" / "decisions").glob("0*.md"))
    for number, page in enumerate(pages, start=1):
        lines = page.read_text("utf-8").splitlines()
        assert page.name.startswith(f"{number:04}-")
        assert lines[0].startswith(f"# {number}. ")
        assert re.fullmatch(r"Date: \d{4}-\d\d-\d\d\. Status: (accepted|superseded by \d+)\.", lines[2])
        assert [line for line in lines if line.startswith("## ")][:3] == [
            "## Context",
            "## Decision",
            "## Consequences",
        ]


def test_every_kind_that_plugins_offer_has_a_place_in_the_reference() -> None:
    pages = "".join(path.read_text("utf-8") for path in (ROOT / "docs" / "reference").glob("*.md"))
    assert [kind for kind in KINDS if not re.search(rf"{{(registered|settings)}} {kind}\b", pages)] == []
