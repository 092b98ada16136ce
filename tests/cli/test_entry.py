from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from labseq.cli.entry import arrange


@pytest.mark.parametrize(
    ("given_arguments", "expected"),
    [
        (["run", "a.yaml", "--dry-run"], ["run", "a.yaml", "--dry-run=full"]),
        (["run", "--dry-run", "a.yaml"], ["run", "--dry-run=full", "a.yaml"]),
        (["run", "--dry-run=fast", "a.yaml"], ["run", "--dry-run=fast", "a.yaml"]),
        (["run", "a.yaml", "--debug"], ["--debug", "run", "a.yaml"]),
        (["--debug", "run", "--debug"], ["--debug", "run"]),
        (["doctor", "--dry-run", "data"], ["doctor", "--dry-run", "data"]),
        (["--debug", "doctor", "--dry-run"], ["--debug", "doctor", "--dry-run"]),
        (["run", "doctor", "--dry-run"], ["run", "doctor", "--dry-run=full"]),
        (["show", "--", "--dry-run", "--debug"], ["show", "--", "--dry-run", "--debug"]),
        (["show", "--scan", "7"], ["show", "--scan=", "7"]),
        (["show", "--scan", "data/1"], ["show", "--scan=", "data/1"]),
        (["show", "--scan", "filling"], ["show", "--scan", "filling"]),  # though a file has this name
        (["show", "--scan", "0001_of"], ["show", "--scan=", "0001_of"]),
        ([], []),
    ],
)
def test_arrange(
    given_arguments: list[str], expected: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "0001_of").mkdir()
    for name in ("filling", "0001_of/run.json"):
        (tmp_path / name).touch()
    assert arrange(given_arguments) == expected


@given(st.lists(st.text(max_size=5).filter(lambda text: text not in {"--dry-run", "--debug"})))
def test_other_arguments_pass_as_they_are(arguments: list[str]) -> None:
    assert arrange(arguments) == arguments
