"""Every sequence that comes with labseq is accepted and runs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import labseq

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
SEQUENCES = sorted((ROOT / "sequences").glob("*.yaml"))
EACH = pytest.mark.parametrize("sequence", SEQUENCES, ids=lambda path: path.stem)
FIGURE_6 = ("kagome", "honeycomb", "link_kagome", "sierpinski", "lion_head")


def call(*arguments: str | Path) -> Any:
    """What a command prints as JSON."""
    command = [sys.executable, "-m", "labseq", *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_each_array_of_the_papers_figure_6_has_a_sequence() -> None:
    assert {*FIGURE_6, "compact_225"} <= {path.stem for path in SEQUENCES}


@EACH
def test_check_accepts_it_without_a_warning(sequence: Path) -> None:
    checked = call("check", sequence)
    assert (checked["problems"], checked["warnings"]) == ([], [])


@EACH
def test_it_runs(sequence: Path, tmp_path: Path) -> None:
    said = call("run", sequence, "--shots", "3", "--seed", "1", "--output", tmp_path)
    assert (said["status"], said["shots"]) == ("complete", 3)
    run = labseq.open_run(said["run_dir"])
    assert all(len(shot.plans) >= 1 for shot in run.shots)
    assert said["filling_fraction"] > 0.97


@pytest.mark.parametrize("name", FIGURE_6)
def test_the_atoms_are_enough_for_it_and_some_are_left_to_mend_it(name: str) -> None:
    target = labseq.Session.open(ROOT / "sequences" / f"{name}.yaml").assembly.target
    n_loaded, five_sigma = 0.75 * target.fill.size, 5 * (0.75 * 0.25 * target.fill.size) ** 0.5
    assert target.n_atoms < n_loaded - five_sigma
    assert (~target.fill & ~target.clear).sum() > 100
