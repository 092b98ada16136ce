"""The code of a run: its plugins, their sources and commits."""

from __future__ import annotations

import hashlib
import io
import os
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import ConfigError
from labseq.session.provenance import code_of
from labseq.session.sources import repositories

from .small_runs import PROFILE, interrupted, resumed

PLUGIN = """
import labseq
from .core import Blink, Brightness

LABSEQ_API = 1


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.step("blink", Blink)
    registry.analysis("brightness", Brightness)
"""
CORE = """
import labseq.plugin


class Blink(labseq.plugin.Step):
    takes_time = False
    def __init__(self, settings): pass
    def plan_timeline(self, context): return []
    def run(self, shot):
        brightness = 1


class Brightness:
    def __init__(self, settings, context): pass
    def shot(self, shot): return {"mean": float(shot.frames[0].mean())}
"""
OBSERVER = """
import labseq

LABSEQ_API = 1


@labseq.plugin.hookimpl
def labseq_run_finished(run): pass
"""
SEQUENCE = """
labseq: 1
name: blinks
profile: p.yaml
plugin_folders: [my]
shots: 3
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: repair, after: {use: grid}}
analysis: [{use: brightness}]
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - blink: {}
  - rearrange: {cycles: 1, window: 60 ms, exposure: 45 ms}
"""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A repository with a profile, a sequence, and the plugins 'blinking' (a package) and 'diary'."""
    (tmp_path / "my/blinking").mkdir(parents=True)
    files = {"p.yaml": PROFILE, "s.yaml": SEQUENCE, "my/diary.py": OBSERVER}
    files |= {"my/blinking/__init__.py": PLUGIN, "my/blinking/core.py": CORE}
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    who = [f"GIT_{role}_{key}=x" for role in ("AUTHOR", "COMMITTER") for key in ("NAME", "EMAIL")]
    for command in (["init", "-q"], ["add", "p.yaml", "s.yaml", "my/blinking"], ["commit", "-q", "-m", "x"]):
        environment = {**os.environ, **dict(one.split("=", 1) for one in who)}
        subprocess.run(["git", *command], cwd=tmp_path, check=True, env=environment)
    return tmp_path


def test_a_run_names_and_keeps_all_code_that_made_it(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lab)  # relative paths are recorded as absolute ones
    with labseq.Session.open("s.yaml") as session:
        session.build_lab()  # only then the planner takes another plugin's
        code = code_of(session.assembly, Path.cwd())
    plugins: dict[str, Any] = {plugin["name"]: plugin for plugin in code.plugins}
    assert {name: plugin["used"] for name, plugin in plugins.items()} == {
        "labseq.builtin": [
            "detector threshold",
            "pattern compact",
            "step image",
            "step load",
            "step rearrange",
        ],
        "labseq_grid": ["planner grid"],
        "labseq_psca": ["planner repair"],
        "labseq_virtual": [
            f"{r} virtual" for r in ("camera", "mobile_tweezers", "simulation", "static_tweezers")
        ],
        "blinking": ["analysis brightness", "step blink"],
        "diary": ["observer"],
    }
    blinking, diary = plugins["blinking"], plugins["diary"]
    assert (blinking["origin"], blinking["path"]) == (
        str(lab / "my/blinking/__init__.py"),
        str(lab / "my/blinking"),
    )
    assert diary["sha256"] == hashlib.sha256(OBSERVER.encode()).hexdigest()
    assert (blinking["git"]["dirty"], diary["git"]) == (False, None)  # the latter was never added
    with zipfile.ZipFile(io.BytesIO(code.archive)) as archive:
        assert archive.read("blinking/core.py").decode() == CORE
        assert archive.read("diary/diary.py").decode() == OBSERVER


def test_a_difference_can_be_applied(lab: Path) -> None:
    file = lab / "my/blinking/core.py"
    file.write_text(CORE.rstrip() + "\n\n\n", "utf-8")
    git = ["git", "-C", str(lab), "-c", "user.name=x", "-c", "user.email=x"]
    subprocess.run([*git, "commit", "-qam", "y"], check=True)
    changed = file.read_text("utf-8").replace("float(", "2 * float(")
    file.write_text(changed, "utf-8")
    diff = repositories([file])[file].diff
    subprocess.run([*git, "checkout", "-q", "."], check=True)
    subprocess.run([*git, "apply"], input=diff.encode(), check=True)
    assert file.read_text("utf-8") == changed


def test_an_edited_step_is_in_the_record_and_resume_shows_the_line(lab: Path) -> None:
    quick: Any = {"overrides": ["planner={use: psca}", "analysis=[]"]}
    before = labseq.open_run(interrupted(lab / "s.yaml", "shot_started", 2, **quick))
    (lab / "my/blinking/core.py").write_text(
        CORE.replace("brightness = 1", "brightness = 2"), encoding="utf-8"
    )
    with pytest.raises(ConfigError) as caught:
        resumed(before.path)
    change = "plugin blinking: core.py, line 10 was 'brightness = 1' and is now 'brightness = 2'"
    assert [problem.what for problem in caught.value.problems][:-1] == [change]
    after = labseq.open_run(interrupted(lab / "s.yaml", "shot_started", 1, **quick))
    (old, new) = (
        next(plugin for plugin in run.record["plugins"] if plugin["name"] == "blinking")
        for run in (before, after)
    )
    assert old["sha256"] != new["sha256"]
    assert (old["git"]["dirty"], new["git"]["dirty"]) == (False, True)
    (resumption,) = resumed(before.path, accept_changes=True).record["resumed"]
    assert (
        next(plugin for plugin in resumption["plugins"] if plugin["name"] == "blinking")["sha256"]
        == new["sha256"]
    )
    with zipfile.ZipFile(before.path / "sources_1.zip") as archive:
        assert b"brightness = 2" in archive.read("blinking/core.py")
