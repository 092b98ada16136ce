"""``labseq plan`` as users call it, in processes of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.session.planning import PlanRequest, plan_moves

pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"
RANDOM = "random:20x20@0.75"
COMPACT = ("--target", "compact:15x15")


def call(
    *arguments: str | Path, cwd: Path, stdin: str = "", **environment: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "labseq", "plan", *map(str, arguments)],
        capture_output=True,
        input=stdin,
        encoding="utf-8",
        cwd=cwd,
        env={**os.environ, "PYTHONUTF8": "1", **environment},
        timeout=120,
        check=False,
    )


def plan_json(cwd: Path, *arguments: str | Path, **options: Any) -> dict[str, Any]:
    done = call(*arguments, "--json", "-", cwd=cwd, **options)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("pattern", "dop"),
    [("compact:15x15", 2), ("kagome:15x15", 7), ("sierpinski:16x16", 15), ("ring:radius=5", 20)],
)
def test_the_json_is_the_plan_of_a_run(tmp_path: Path, pattern: str, dop: int) -> None:
    """The command interprets the kernels; a run, like this process, compiles them."""
    document = plan_json(tmp_path, RANDOM, "--seed", "11", "--target", pattern, "--dop", str(dop))
    request = PlanRequest(RANDOM, pattern, degree_of_parallelism=dop, seed=11)
    assert document == plan_moves(request).as_dict()
    fill, clear, predicted = (np.array(a) for a in (*document["target"].values(), document["predicted"]))
    assert predicted[fill == 1].all()
    assert not predicted[clear == 1].any()


def test_json_alone_on_stdout_and_all_else_on_stderr(tmp_path: Path) -> None:
    words = ("random:6x6@0.2", "--seed", "3", "--target", "compact:4x4", "--step", "--json", "-")
    done = call(*words, cwd=tmp_path)
    assert done.returncode == 0
    assert json.loads(done.stdout)["n_batches"] > 0
    assert "batch 1 of" in done.stderr
    assert "warning: 7 atoms for 16 target sites, 9 too few; the plan fills 7" in done.stderr


def test_a_report_a_file_and_a_picture(tmp_path: Path) -> None:
    words = (RANDOM, "--seed", "1", *COMPACT, "--dop", "15", "--json", "a.json", "--png", "a.png")
    done = call(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\x1b" not in done.stdout
    assert f"occupancy  {RANDOM}, seed 1: " in done.stdout
    assert "filled      225 of 225 (100.0 %) target sites" in done.stdout
    assert json.loads((tmp_path / "a.json").read_text("utf-8"))["degree_of_parallelism"] == 15
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_a_poor_terminal_gets_poor_characters(tmp_path: Path, encoding: str) -> None:
    environment = {"PYTHONUTF8": "0", "PYTHONIOENCODING": encoding}
    done = call(
        "random:6x6@0.7", "--seed", "3", "--target", "kagome:4x4", "--step", cwd=tmp_path, **environment
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "@ atom on a target site" in done.stdout
    assert "->" in done.stdout


def test_an_occupancy_may_come_through_a_pipe(tmp_path: Path) -> None:
    atoms = np.random.default_rng(4).random((6, 7)) < 0.7
    rows = atoms.astype(int).tolist()
    text = "\n".join("".join(map(str, row)) for row in rows)
    target = ("--target", "compact:3x3")
    drawn = plan_json(tmp_path, "random:6x7@0.7", "--seed", "4", *target)
    assert (drawn.pop("seed"), drawn["occupancy"]) == (4, rows)
    read = plan_json(tmp_path, "-", *target, stdin=text)
    assert (read.pop("seed"), read) == (None, drawn)


def test_a_shot_is_planned_again_as_it_was(tmp_path: Path) -> None:
    with labseq.Session.open(SEQUENCE, shots=1, seed=1, output=tmp_path) as session:
        (shot,) = session.run().shots
    assert len(shot.plans) > 1
    for cycle, plan in enumerate(shot.plans, start=1):
        assert plan_moves(PlanRequest(f"{shot.file}#{cycle}")).plan.moves.tolist() == plan.moves.tolist()
    document = plan_json(tmp_path, f"{shot.file}#2")
    moves = [
        [*a, *b] for batch in document["batches"] for a, b in zip(batch["from"], batch["to"], strict=True)
    ]
    assert moves == shot.plans[1].moves.tolist()


def test_a_mistake_is_reported_as_text(tmp_path: Path) -> None:
    done = call(RANDOM, "--target", "kagomee:5x5", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert "did you mean 'kagome'?" in done.stderr
    assert "Traceback" not in done.stderr


def test_without_matplotlib_everything_else_works(tmp_path: Path) -> None:
    (tmp_path / "without.py").write_text(
        "import sys\nsys.modules['matplotlib'] = None\nfrom labseq.cli import main\nmain(sys.argv[1:])\n",
        "utf-8",
    )

    def without(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [
            sys.executable,
            "without.py",
            "plan",
            "random:5x5@0.7",
            "--target",
            "compact:3x3",
            *arguments,
        ]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)

    assert without("--json", "-").returncode == 0
    done = without("--png", "a.png")
    assert done.returncode == 2
    assert "needs matplotlib, which is not installed; pip install 'labseq[plot]'" in done.stderr
