"""What a program that waits for JSON gets for arguments that make no sense."""

from __future__ import annotations

import json
from typing import Any

import pytest

NOTHING = {"run_dir": None, "shots": 0, "defect_free": None, "filling_fraction": None, "status": "failed"}


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["run", "a.yaml", "--json", "--shots", "x"], "--shots is 'x'; expected a whole number"),
        (["run", "--json"], "SEQUENCE"),
        (["show", "--json", "a", "b"], "b"),
    ],
)
def test_a_run_that_never_began(arguments: list[str], named: str, call: Any) -> None:
    code, out, err = call(*arguments)
    assert code == 2
    answer = json.loads(out)
    assert out.count("\n") == 1
    error = answer.pop("error")
    assert error.startswith("error: ")
    assert named in error
    assert answer.items() >= NOTHING.items()
    assert named in err
    assert "Usage: labseq" in err


def test_a_sequence_that_was_never_checked(call: Any) -> None:
    code, out, _ = call("check", "--json", "a.yaml", "b.yaml")
    answer = json.loads(out)
    assert code == 2
    assert answer["warnings"] == []
    (problem,) = answer["problems"]
    assert "b.yaml" in problem["what"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "--shots", "x", "--", "--json"],
        ["plan", "--json", "-"],
        ["fly", "--json"],
        [],
    ],
)
def test_nothing_on_stdout_where_no_json_was_asked_for(arguments: list[str], call: Any) -> None:
    code, out, err = call(*arguments)
    assert (code, out) == (2, "")
    assert err
