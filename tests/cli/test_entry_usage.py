"""What a program that waits for JSON gets for arguments that make no sense."""

from __future__ import annotations

import json
from typing import Any

import pytest

from labseq.cli import main

NOTHING = {"run_dir": None, "shots": 0, "defect_free": None, "filling_fraction": None, "status": "failed"}


def outcome_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[Any, str, str]:
    with pytest.raises(SystemExit) as leaving:
        main(arguments)
    out, err = capsys.readouterr()
    return leaving.value.code, out, err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["run", "a.yaml", "--json", "--shots", "x"], "--shots"),
        (["run", "--json", "a.yaml", "--dry-run=quick"], "--dry-run"),
        (["run", "a.yaml", "--shot", "3", "--json"], "--shot"),
        (["run", "--json"], "SEQUENCE"),
        (["show", "--json", "a", "b"], "b"),
    ],
)
def test_a_run_that_never_began(arguments: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = outcome_of(capsys, *arguments)
    assert code == 2
    answer = json.loads(out)
    assert out.count("\n") == 1
    error = answer.pop("error")
    assert error.startswith("error: ")
    assert named in error
    assert answer == NOTHING
    assert named in err
    assert "Usage: labseq" in err


def test_a_sequence_that_was_never_checked(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = outcome_of(capsys, "check", "--json", "a.yaml", "b.yaml")
    answer = json.loads(out)
    assert code == 2
    assert answer["warnings"] == []
    (problem,) = answer["problems"]
    assert "b.yaml" in problem["what"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "a.yaml", "--shots", "x"],
        ["run", "--shots", "x", "--", "--json"],
        ["plan", "--json", "-"],
        ["fly", "--json"],
        ["--json"],
        [],
    ],
)
def test_nothing_on_stdout_where_no_json_was_asked_for(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = outcome_of(capsys, *arguments)
    assert (code, out) == (2, "")
    assert err
