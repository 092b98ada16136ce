from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from labseq.cli import main

SEQUENCE = str(Path(__file__).parents[2] / "sequences" / "compact_225.yaml")


def code_of(*arguments: str) -> Any:
    with pytest.raises(SystemExit) as leaving:
        main(["bench", "latency", *arguments])
    return leaving.value.code


def test_two_tables_and_what_was_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "latency.json"
    assert code_of(SEQUENCE, "--loadings", "2", "--seed", "3", "--json", str(path)) == 0
    out, err = capsys.readouterr()
    to_chunk, to_light, notes = out.split("\n\n")
    header, *rows = to_chunk.splitlines()
    assert header.split() == ["stage", "median", "99", "%", "share"]
    assert [row.split("  ")[0] for row in rows] == [
        *("detect", "plan", "check", "tone program", "renderer", "first chunk"),
        *("hand-over", "in between"),
        "frame to first chunk",
    ]
    assert rows[-1].endswith("100 %")
    assert [row.split("  ")[0] for row in to_light.splitlines()] == [
        *("to the light", "camera read-out", "frame to tone program", "prepare", "start", "trigger"),
        "end of exposure to light",
    ]
    assert "the goal is 2 ms" in notes
    assert "2 loadings, seed 3; " in notes
    assert "psca, degree of parallelism 7: " in notes
    assert [line for line in err.splitlines() if not line.startswith("compiling")][-1] == "2 of 2 loadings"
    values = json.loads(path.read_text("utf-8"))
    assert (values["n_loadings"], values["seed"], values["profile"]) == (2, 3, "virtual")


def test_json_alone_is_on_stdout(capfd: pytest.CaptureFixture[str]) -> None:
    assert code_of(SEQUENCE, "--loadings", "1", "--json", "-") == 0
    out, err = capfd.readouterr()
    assert json.loads(out)["total"]["median_s"] > 0.0
    assert "frame to first chunk" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "SEQUENCE"),
        (["nowhere.yaml"], "nowhere.yaml"),
        ([SEQUENCE, "--loadings", "0"], "--loadings"),
        ([SEQUENCE, "--seed", "x"], "--seed"),
        ([SEQUENCE, "--profile", "virtaul"], "virtaul"),
        ([SEQUENCE, "--set", "planner.degree_of_parallelism=0"], "degree_of_parallelism"),
        ([SEQUENCE, "--json", "nowhere/out.json"], "it cannot be written"),
        ([SEQUENCE, "--set", "profile.simulation.loading=0 %"], "there is nothing to move"),
    ],
)
def test_wrong_words_are_refused(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert code_of(*arguments) == 2
    out, err = capsys.readouterr()
    assert words in err
    assert out == ""
    assert "Traceback" not in err
