"""The wheel, installed bare into fresh environments, in an empty folder.

Only when it is asked for, because it fetches all that labseq needs: LABSEQ_WHEEL=1 for the Python of
the tests; LABSEQ_WHEEL=all for every Python that uv finds, and for every extra by itself.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ASKED = os.environ.get("LABSEQ_WHEEL", "")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
PLUGINS = {path.parent.name for path in ROOT.glob("plugins/*/__init__.py")}
UV = shutil.which("uv") or ""

pytestmark = [pytest.mark.system, pytest.mark.needs("downloads")]


def call(*words: str | Path, cwd: Path) -> str:
    """What a command prints; nothing of this environment or the user reaches it but the caches."""
    gone = {"VIRTUAL_ENV", "PYTHONPATH", "LABSEQ_DATA", "LABSEQ_PLUGIN_PATH", "UV_PROJECT_ENVIRONMENT"}
    environment = {key: value for key, value in os.environ.items() if key not in gone}
    done = subprocess.run(
        [str(word) for word in words], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
    return done.stdout


def found(python: str) -> str:
    """The interpreter of a version: uv's, one on the PATH, or pyenv's; "" if there is none here."""
    words = [UV, "python", "find", "--no-python-downloads", "--no-project", python]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return done.stdout.strip()
    return next(map(str, Path.home().glob(f".pyenv/versions/{python}.*/bin/python{python}")), "")


def install(folder: Path, python: str, what: str) -> Path:
    """A fresh environment; gives the folder of its commands."""
    call(UV, "venv", "--quiet", "--python", python, folder / "env", cwd=folder)
    commands = folder / "env" / ("Scripts" if os.name == "nt" else "bin")
    call(UV, "pip", "install", "--quiet", "--python", commands / "python", what, cwd=folder)
    return commands


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    call(UV, "build", "--quiet", "--wheel", "--out-dir", out, ROOT, cwd=out)
    (path,) = out.glob("*.whl")
    return path


def test_the_wheel_holds_what_it_needs_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    for folder in ("sequences", "hardware_profiles"):
        own = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        inside = f"labseq/config/{folder}/"
        assert {name.removeprefix(inside) for name in names if name.startswith(inside)} == own
    tops = {name.split("/")[0] for name in names if ".dist-info" not in name}
    assert tops == {"labseq", "labseq_client.py", *PLUGINS}
    own = {"labseq/testing/pytest_plugin.py"}
    assert not [name for name in names if ("test_" in name and name not in own) or "__pycache__" in name]


@pytest.mark.parametrize("python", [sys.executable, *(PYTHONS if ASKED == "all" else ())])
def test_a_bare_install_runs_the_demonstration(wheel: Path, python: str, tmp_path: Path) -> None:
    interpreter = python if python == sys.executable else found(python)
    if not interpreter:
        pytest.skip(f"there is no Python {python} here")
    commands = install(tmp_path, interpreter, str(wheel))
    here = tmp_path / "an empty folder"
    here.mkdir()
    labseq = commands / "labseq"
    assert "What next:" in call(labseq, "demo", "--shots", "2", cwd=here)
    rows = call(labseq, "plugins", cwd=here).splitlines()
    states = [row.split()[1] for row in rows[1:] if row]
    assert set(states) == {"loaded"}, rows
    registering = [
        name
        for name in PLUGINS
        if "def labseq_register" in (ROOT / "plugins" / name / "__init__.py").read_text()
    ]
    assert len(states) == 1 + len(registering)
    assert "Usage: labseq" in call(labseq, "--help", cwd=here)
    checked = json.loads(call(labseq, "check", "lion_head", "--profile", "paper", "--json", cwd=here))
    assert checked["problems"] == []


@pytest.mark.skipif(ASKED != "all", reason="LABSEQ_WHEEL is not 'all'")
@pytest.mark.parametrize("extra", EXTRAS)
def test_each_extra_installs_by_itself(wheel: Path, extra: str, tmp_path: Path) -> None:
    commands = install(tmp_path, sys.executable, f"{wheel}[{extra}]")
    assert "loaded" in call(commands / "labseq", "plugins", cwd=tmp_path)
