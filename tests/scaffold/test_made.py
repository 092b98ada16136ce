"""What is made works at once: its own tests pass, it is clean, and a run with it goes through."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest

import labseq
from labseq.assembly.plugin_choice import load_plugins
from labseq.config.document import Document
from labseq.roles import ROLES
from tests.nested import run_pytest


def run(*command: str, cwd: Path) -> None:
    command = (sys.executable, "-m", *command)
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def options_of(command: str) -> list[str]:
    """What the shown command sets."""
    words = shlex.split(command)
    assert words[:3] == ["labseq", "run", "first.yaml"]
    assert set(words[3::2]) == {"--set"}
    return words[4::2]


def test_their_own_tests_pass(
    made: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(made.path)
    monkeypatch.syspath_prepend(made.package.path / "src")
    monkeypatch.setattr("labseq.testing.PlannerContract.n_examples", 5)  # of two planners, which are the same
    code, out = run_pytest(capsys, "plugins", str(made.package.path / "tests"))
    assert code == 0, out
    passed = re.search(r"(\d+) passed", out)
    assert passed is not None
    assert int(passed[1]) > 100  # promises of seven roles and more: none was left out


@pytest.mark.needs("ruff")
def test_they_are_clean(made: Any) -> None:
    for folder, cwd in (("plugins", made.path), (".", made.package.path)):
        run("ruff", "check", "--isolated", "--extend-select=I,B,UP,RUF,N,SIM", folder, cwd=cwd)
        run("ruff", "format", "--isolated", "--check", folder, cwd=cwd)


@pytest.mark.skipif("LABSEQ_TYPES" not in os.environ, reason="takes long: poe scaffolds")
def test_their_types_are_right(made: Any) -> None:
    settings = {
        "typeCheckingMode": "strict",
        "pythonVersion": "3.11",
        "include": ["plugins", "labseq-packed"],
        "executionEnvironments": [{"root": "labseq-packed", "extraPaths": ["labseq-packed/src"]}],
        "reportMissingTypeStubs": False,
        "reportUnknownMemberType": False,
    }
    (made.path / "pyrightconfig.json").write_text(json.dumps(settings))
    run("pyright", "--pythonpath", sys.executable, cwd=made.path)


@pytest.mark.parametrize("kind", ROLES)
def test_a_run_goes_through_with_each(kind: str, made: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(made.path)
    overrides = options_of(made.plugins[kind].commands[-1])
    with labseq.Session.open("first.yaml", shots=1, seed=1, overrides=overrides) as session:
        result = session.run()
    assert len(result.shots) == 1
    assert result.status == "complete"


@pytest.mark.parametrize("kind", ROLES)
def test_the_readme_says_how(kind: str, made: Any) -> None:
    plugin = made.plugins[kind]
    text = (plugin.path / "README.md").read_text(encoding="utf-8")
    assert all(command in text for command in plugin.commands)
    assert all(f"`{path.name}`" in text for path in plugin.path.glob("*.py"))


def test_nothing_is_left_to_fill_in(made: Any) -> None:
    files = [
        path for path in made.path.rglob("*") if path.is_file() and path.suffix in (".py", ".md", ".toml")
    ]
    assert files
    assert not [path for path in files if "${" in path.read_text(encoding="utf-8")]


def test_a_sequence_runs_on_the_profile(made: Any, tmp_path: Path) -> None:
    overrides = ["profile=mine"]
    path = made.path / "first.yaml"
    with labseq.Session.open(path, shots=2, seed=1, overrides=overrides, output=tmp_path) as session:
        assert session.run().filling_fraction > 0.9


@pytest.mark.parametrize(("kind", "name"), [("sequence", "first"), ("profile", "mine")])
def test_the_editor_finds_a_schema_that_accepts_the_file(kind: str, name: str, made: Any) -> None:
    document = Document.read(made.path / f"{name}.yaml")
    first = document.text.splitlines()[0]
    place = first.removeprefix("# yaml-language-server: $schema=")
    assert place == f".labseq/{kind}.schema.json"
    schema = json.loads((made.path / place).read_text(encoding="utf-8"))
    validator = jsonschema.Draft7Validator(schema)
    assert validator.is_valid(document.root.plain())
    assert {"sequence": "planner.ownpla", "profile": "camera.owncam"}[kind] in schema["definitions"]


def test_a_package_is_found_as_an_installed_plugin(
    made: Any, pretend_installed: Callable[[Path], None]
) -> None:
    project = tomllib.loads((made.package.path / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["name"] == made.package.path.name == "labseq-packed"
    assert (made.package.path / project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"][0]).is_dir()
    pretend_installed(made.package.path)
    assert load_plugins().get("planner", "packed").origin == "labseq_packed"
