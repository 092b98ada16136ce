"""``labseq new`` and ``labseq schema``: what they say and what they leave behind."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from labseq.cli import main


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def code_of(*arguments: str) -> Any:
    with pytest.raises(SystemExit) as leaving:
        main(arguments)
    return leaving.value.code


def test_a_planner_from_an_empty_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("new", "planner", "spiral") == 0
    out = capsys.readouterr().out.replace("\\", "/")
    assert out == (
        "made the planner spiral:\n"
        "  plugins/spiral/README.md\n"
        "  plugins/spiral/__init__.py\n"
        "  plugins/spiral/planner.py\n"
        "  plugins/spiral/test_spiral.py\n"
        "\n"
        "next:\n"
        "  pytest plugins/spiral\n"
        "  labseq new sequence first\n"
        "  labseq run first.yaml --set planner.use=spiral\n"
    )
    assert code_of("new", "sequence", "first") == 0
    assert code_of("run", "first.yaml", "--set", "planner.use=spiral", "--shots", "1", "--seed", "1") == 0
    capsys.readouterr()
    assert code_of("new", "detector", "mean_counts") == 0
    assert "labseq new sequence" not in capsys.readouterr().out  # there is one


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["planer", "x"],
            "there is no kind 'planer'; expected one of planner, camera, .*did you mean 'planner'",
        ),
        (["sequence", "a", "--package"], "--package does not apply to a sequence; leave it out"),
        (["static_tweezers", "a", "--profile", "lab"], "--profile does not apply to a static tweezers"),
    ],
)
def test_mistakes(arguments: list[str], said: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("new", *arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert re.search(said, err), err
    assert [*here.iterdir()] == []


def test_schema_knows_the_plugins_of_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("schema", "sequence", "-o", "s.json") == 0
    assert capsys.readouterr().out == "wrote s.json\n"
    assert json.loads(Path("s.json").read_text(encoding="utf-8"))["$schema"].endswith("draft-07/schema#")
    code_of("new", "planner", "spiral")
    Path("empty").mkdir()
    capsys.readouterr()
    for arguments, is_there in (
        ([], True),
        (["--plugins", "empty"], False),
        (["--plugins", "plugins"], True),
    ):
        assert code_of("schema", "sequence", *arguments) == 0
        assert ("planner.spiral" in json.loads(capsys.readouterr().out)["definitions"]) is is_there


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sequenze"], "there is no schema of a 'sequenze'; expected one of sequence, profile; did you mean"),
        (["profile", "-o", "nowhere/p.json"], "it cannot be written"),
    ],
)
def test_mistakes_with_schemas(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("schema", *arguments) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ([], r"  step  +check_overlay.*  command  +the commands"),
        (["step", "image"], r"^step image\n\nTakes an image.*  exposure  +exposure time .*default: 45 ms"),
        (["profile.camera"], r"The plugins.*  virtual  +Takes frames of the simulation"),
        (["psca"], r"^planner psca\n.*  degree_of_parallelism  "),
        (["exposure"], r"^exposure can be:.*  step image exposure\s+exposure time.*step rearrange exposure"),
        (["field", "confidence"], r"^field detection/confidence\n"),
        (["n_batches"], r"quantity n_batches .*column cycles n_batches "),
        (["quantity", "filling"], r"^quantity filling_fraction\n"),
        (["command", "bench", "planners"], r"labseq bench planners \[OPTIONS\]"),
        (["role", "camera"], r"^role Camera\n.*read\(timeout_s: float\) -> Frame\n    Wait for the oldest"),
        (["spiral"], r"^planner spiral\n"),
    ],
)
def test_an_explanation(words: list[str], shown: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "plugins").mkdir()
    hook = "@hookimpl\ndef labseq_register(registry):\n    registry.planner('spiral', object)\n"
    text = f"from labseq.plugin import hookimpl\nLABSEQ_API = 1\n\n{hook}"
    (here / "plugins" / "spirals.py").write_text(text)
    assert code_of("explain", *words, "--plugins", "plugins") == 0
    out, err = capsys.readouterr()
    assert re.search(shown, out, re.DOTALL), out
    assert (max(map(len, out.splitlines())) <= 110, err) == (True, "")


def test_nothing_of_that_name_to_explain(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "plugins").mkdir()
    (here / "plugins" / "broken.py").write_text("LABSEQ_API = 1\n1 / 0\n")
    assert code_of("explain", "stpe", "image") == 2
    not_included = f"{Path('plugins') / 'broken.py'} is not included; use --plugins plugins\n"
    assert capsys.readouterr().err.startswith(not_included)
    assert code_of("explain", "stpe", "image", "--plugins", "plugins") == 2
    err = capsys.readouterr().err
    assert err.startswith("broken did not load: ZeroDivisionError: division by zero")
    assert "there is no topic 'stpe image' to explain; did you mean 'step image'?" in err
