from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from labseq.cli import main


def code_of(*arguments: str) -> Any:
    with pytest.raises(SystemExit) as leaving:
        main(["bench", "waveform", *arguments])
    return leaving.value.code


def test_a_table_with_the_goals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "waveform.json"
    assert code_of("--repeats", "1", "--json", str(path)) == 0
    rows, ratios, extent = capsys.readouterr().out.split("\n\n")
    header, *lines = rows.splitlines()
    assert header.split() == ["two", "channels", "Gsample/s", "playing/rendering", "goal"]
    values = json.loads(path.read_text("utf-8"))
    assert [line.split("  ")[0] for line in lines] == [row["name"] for row in values["rows"]]
    assert lines[0].endswith(">= 3")
    assert lines[-1].endswith("-")
    assert len(ratios.splitlines()) == 1 + len(values["ratios"])
    assert "<= 1.3" in ratios
    assert extent.splitlines() == ["624 MHz, two threads; the best of 1"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--repeats", "0"], "--repeats"),
        (["--repeats", "many"], "--repeats"),
        (["--json", "nowhere/out.json"], "it cannot be written"),
    ],
)
def test_wrong_words_are_refused_before_the_work(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert code_of(*arguments) == 2
    out, err = capsys.readouterr()
    assert (words in err, out) == (True, "")
