"""The tutorials do what they say."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import labseq

ROOT = Path(__file__).parents[2]


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)


@pytest.fixture
def planner_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The files that the reader of the second tutorial has at its end."""
    plugin, test = blocks("docs/tutorials/planner.md", "python")
    (tmp_path / "my_plugins").mkdir()
    (tmp_path / "my_plugins" / "mine.py").write_text(plugin)
    (tmp_path / "mine.yaml").write_text(blocks("docs/tutorials/planner.md", "yaml")[0])
    (tmp_path / "test_mine.py").write_text(test)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_first_run_can_be_read_back_as_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with labseq.Session.open(ROOT / "sequences" / "compact_225.yaml", shots=1, seed=1, output=tmp_path) as it:
        run = it.run()
    (code,) = blocks("docs/tutorials/first-run.md", "python")
    (shown,) = re.findall(r'open_run\("(.*?)"\)', code)
    exec(code.replace(shown, str(run.path)), {})
    shot = run.shots[0]
    shown = (shot.success, shot.filling_fraction, shot.frames.shape, shot.plans[0].n_batches)
    assert capsys.readouterr().out == " ".join(map(str, shown)) + "\n"
    text = (ROOT / "docs/tutorials/first-run.md").read_text()
    for path in run.path.rglob("*"):
        assert path.relative_to(run.path).as_posix() in text


@pytest.mark.usefixtures("planner_folder")
def test_the_planner_of_the_tutorial_runs(tmp_path: Path) -> None:
    with labseq.Session.open("mine.yaml", seed=1, output=tmp_path) as session:
        run = session.run()
    assert len(run.shots) == 3
    assert json.loads((run.path / "run.json").read_text())["name"] == "my-planner"
    assert run.filling_fraction > 0.9


def test_the_planner_of_the_tutorial_keeps_its_promises(planner_folder: Path) -> None:
    some = "returns_a_plan or fills_the_target or refuses_wrong_input"  # the others take long
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", some, "test_mine.py"]
    done = subprocess.run(command, cwd=planner_folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_readme_shows_the_planner_of_the_tutorial() -> None:
    assert blocks("README.md", "python") == blocks("docs/tutorials/planner.md", "python")[:1]
