"""``labseq demo``, in a folder in which there is nothing."""

from __future__ import annotations

import importlib.util
import shlex
from pathlib import Path

import pytest

import labseq
from labseq.cli import main, run as demo
from labseq.errors import ConfigError
from labseq.files import packaged_profiles_dir, packaged_sequences_dir
from labseq.messages import install_hint
from labseq.session.session import Session


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "an empty folder"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as leaving:
        main(arguments)
    return int(leaving.value.code or 0)


def suggested(out: str) -> list[list[str]]:
    """The commands below "What next", as a shell would read them."""
    _, _, below = out.partition("What next:\n")
    return [shlex.split(line.split("  ")[1]) for line in below.splitlines()]


def test_first_look(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("hardware_profiles").mkdir()
    Path("hardware_profiles/virtual.yaml").write_text("a profile of this lab, which must not be used")
    assert run("demo", "--shots", "1e0") == 0
    out = capsys.readouterr().out
    (run_dir,) = here.glob("data/*/*")
    assert labseq.open_run(run_dir).record["name"] == "compact-225"
    assert "No device is used" in out
    assert "Each of 1 shot loads atoms at random into 20 x 20 tweezers" in out
    assert "an array of 15 x 15 in up to 10 cycles" in out
    assert f"The data are in {run_dir}" in out
    commands = suggested(out)
    assert [words[1] for words in commands] == ["show", "plot", "check", "run", "demo"]
    assert [Path(words[2]) for words in commands[:2]] == [run_dir, run_dir]
    assert run(*commands[0][1:]) == 0
    (filling,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("filling")]
    assert filling in out


def test_what_to_install_before_plot(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "pip install" not in "".join(demo.ending(Path("r")))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert f"the run as a picture; first: {install_hint('plot')}" in "".join(demo.ending(Path("r")))


def test_copies_can_be_run_and_are_never_replaced(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("demo", "--copy", "lab") == 0
    assert "labseq run sequences/compact_225.yaml" in capsys.readouterr().out
    for original in (packaged_sequences_dir(), packaged_profiles_dir()):
        names = {path.name for path in original.iterdir() if path.is_file()}
        assert {path.name for path in Path("lab", original.name).iterdir()} == names
    session = Session.open("lab/sequences/lion_head.yaml", profile="lab/hardware_profiles/virtual.yaml")
    assert session.assembly.target.fill.sum() == 177
    Path("lab/sequences/kagome.yaml").unlink()
    with pytest.raises(
        ConfigError, match=r"climb_dop_speed\.yaml: this file already exists \(and \d+ more files\)"
    ):
        demo.copy_files(Path("lab"))
    assert not Path("lab/sequences/kagome.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (["--copy", ".", "--shots", "3"], "it only copies files; leave out --shots and --output"),
        (["--copy", ".", "--output", "x"], "it only copies files"),
        (["--shots", "0"], "shots is 0; expected at least 1"),
        (["compact_225"], "unexpected extra argument"),
    ],
)
def test_mistakes(arguments: list[str], printed: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("demo", *arguments) == 2
    assert printed in capsys.readouterr().err
    assert list(Path().iterdir()) == []
