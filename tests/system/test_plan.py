"""``labseq plan`` as users call it, in processes of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from labseq.assembly.planning import PlanRequest, plan_moves
from labseq.plain import to_plain
from labseq.plans.plan import PlanReport

pytestmark = pytest.mark.system


def call(*command: str, cwd: Path, stdin: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *command],
        capture_output=True,
        input=stdin,
        encoding="utf-8",
        cwd=cwd,
        env={**os.environ, "PYTHONUTF8": "1", **environment},
        timeout=120,
        check=False,
    )


def test_the_plan_for_an_occupancy_from_a_pipe_is_that_of_a_run(tmp_path: Path) -> None:
    """The command interprets the kernels; a run, like this process, compiles them."""
    request = PlanRequest(
        "random:20x20@0.75", "{pattern: kagome, rows: 15, cols: 15}", degree_of_parallelism=7, seed=11
    )
    expected = to_plain(PlanReport.of(plan_moves(request)))
    rows = "\n".join("".join(map(str, row)) for row in expected["occupancy"])
    command = (
        "-m",
        "labseq",
        "plan",
        "-",
        "--target",
        "{pattern: kagome, rows: 15, cols: 15}",
        "--dop",
        "7",
        "--json",
        "-",
    )
    done = call(*command, cwd=tmp_path, stdin=rows)
    assert (done.returncode, done.stdout.count("\n")) == (0, 1), done.stderr
    assert json.loads(done.stdout) == {**expected, "seed": None}
    fill, predicted = (np.array(a) for a in (expected["target"]["fill"], expected["predicted"]))
    assert predicted[fill == 1].all()


def test_a_poor_terminal_gets_poor_characters(tmp_path: Path) -> None:
    command = (
        "-m",
        "labseq",
        "plan",
        "random:6x6@0.7",
        "--seed",
        "3",
        "--target",
        "{pattern: kagome, rows: 4, cols: 4}",
        "--step",
    )
    done = call(*command, cwd=tmp_path, PYTHONUTF8="0", PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (0, "")
    assert "@ atom on a target site" in done.stdout
    assert "->" in done.stdout
