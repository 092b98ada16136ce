"""The tutorials do what they say."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import labseq
from labseq.cli import main
from tests.nested import run_pytest

ROOT = Path(__file__).parents[2]
PLANNER, CAMERA = "docs/tutorials/planner.md", "docs/tutorials/camera-driver.md"

Install = Callable[[Path], None]


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)


def commands(page: str, n: int) -> list[str]:
    """The lines of one console block of a page."""
    return blocks(page, "console")[n].splitlines()


def run(lines: list[str]) -> None:
    """Run the commands of labseq; those of pytest and pip must only name what is there."""
    for line in lines:
        program, *words = shlex.split(line)
        if program == "labseq":
            with pytest.raises(SystemExit) as leaving:
                main(words)
            assert leaving.value.code == 0, line
        else:
            assert program in ("pytest", "pip")
            assert Path(words[-1]).is_dir(), line


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


def test_the_planners_of_the_tutorial(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    pretend_installed: Install,
) -> None:
    monkeypatch.chdir(tmp_path)
    plugin, test = blocks(PLANNER, "python")
    run(commands(PLANNER, 0))
    Path("plugins/mine.py").write_text(plugin)
    Path("test_mine.py").write_text(test)
    for n in (1, 2, 3):
        run(commands(PLANNER, n))
    listed = re.findall(r"^\| `([\w.]+)` \|", (ROOT / PLANNER).read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(path.name for path in Path("plugins/spiral").glob("*.*"))
    first, *rest = commands(PLANNER, 4)
    run([first])
    pretend_installed(Path("labseq-helix"))
    run(rest)
    warned = capsys.readouterr().err  # `mine` leaves much unfilled, as the page says
    assert re.fullmatch(
        r"warning: .*: the planner 'mine' fills the target for only .* enough atoms;.*\n", warned
    )
    some = (
        "returns_a_plan or refuses_wrong_input or order or (fills_the_target and not OneByOne)"  # are quick
    )
    code, out = run_pytest(capsys, "-k", some, "plugins/spiral", "test_mine.py", "labseq-helix/tests")
    assert code == 0, out
    assert "12 passed" in out


def test_the_promise_that_the_tutorial_breaks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run(["labseq new planner spiral"])
    lines, said = blocks(PLANNER, "text")
    planner = Path("plugins/spiral/planner.py")
    text = planner.read_text()
    assert lines in text
    planner.write_text(text.replace(lines, ""))
    code, out = run_pytest(capsys, "-k", "fills_the_target", "plugins/spiral")
    assert code == 1
    assert said in out


def test_the_readme_shows_the_planner_of_the_tutorial() -> None:
    assert blocks("README.md", "python") == blocks(PLANNER, "python")[:1]


def test_the_camera_driver_of_the_tutorial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run(commands(CAMERA, 0))
    plugin = Path("plugins/mycam")
    shown = re.findall(r"<!-- reference: source docs/tutorials/mycam/(.*) -->", (ROOT / CAMERA).read_text())
    assert {"acme.py", *(path.name for path in plugin.glob("*.py"))} == {*shown}
    for name in shown:
        shutil.copy(ROOT / "docs" / "tutorials" / "mycam" / name, plugin)
    code, out = run_pytest(capsys, commands(CAMERA, 1)[0].removeprefix("pytest "))
    assert code == 0, out
    (camera,) = blocks(CAMERA, "text")
    profile = Path("mylab.yaml")
    text = profile.read_text()
    assert "camera:\n  use: virtual\n" in text
    profile.write_text(text.replace("camera:\n  use: virtual\n", camera))
    capsys.readouterr()
    run(commands(CAMERA, 2))
    out = capsys.readouterr().out
    assert re.search(r"camera +mycam +Acme +A-17 +2\.1 +.* ok\n", out)
    real, dry = sorted(Path("data").glob("*/*"))[-2:]
    assert labseq.open_run(real).shots[0].frames.max() < 510  # noise
    assert labseq.open_run(dry).shots[0].frames.max() > 510
