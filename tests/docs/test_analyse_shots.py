"""The how-to of analyses does what it says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import labseq

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "analyse-shots.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> labseq.Run:
    """The run of the sequence on the page, with its plugin and `survival` as well."""
    (plugin,) = [code for code in blocks("python") if "labseq_register" in code]
    (tmp_path / "my_plugins").mkdir()
    (tmp_path / "my_plugins" / "loading.py").write_text(plugin)
    (sequence,) = [text for text in blocks("yaml") if "my_plugins" in text]
    text = sequence.replace("analysis:\n", "analysis:\n  - {use: survival, finish_within: 60 s}\n")
    text = text.replace("finish_within: 30 s", "finish_within: 60 s")
    (tmp_path / "mine.yaml").write_text(text + "  - image: {exposure: 45 ms}\n")
    monkeypatch.chdir(tmp_path)
    with labseq.Session.open("mine.yaml", seed=1, output=tmp_path) as session:
        return session.run()


def test_the_analysis_of_the_page_runs(run: labseq.Run, capsys: pytest.CaptureFixture[str]) -> None:
    rows = run.analysis("loading")
    assert len(rows) == len(run.shots) == 3
    for row, shot in zip(rows, run.shots, strict=True):
        assert row["loading"] == pytest.approx(np.mean(row["rows"])) == pytest.approx(np.mean(row["columns"]))
        assert row["loading"] == shot.occupancies[0].mean()
    (code,) = [code for code in blocks("python") if "open_run" in code]
    (shown,) = re.findall(r'open_run\("(.*?)"\)', code)
    exec(code.replace(shown, str(run.path)), {})
    first, _, rest = capsys.readouterr().out.partition("\n")
    assert 0.9 < float(first) <= 1.0
    assert rest.startswith("[[")
