"""``labseq waveform`` as users call it, in processes of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.system

PLAN = ("plan", "random:10x10@0.75", "--seed", "4", "--target", "kagome:7x7", "--json", "plan.json")
WAVEFORM = ("waveform", "plan.json", "--batches", "1-2", "--sample-rate", "250 MHz")


def call(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "labseq", *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONUTF8": "1"},
        capture_output=True,
        encoding="utf-8",
        timeout=120,
        check=False,
    )


def test_a_plan_becomes_a_picture_and_samples(tmp_path: Path) -> None:
    assert call(*PLAN, cwd=tmp_path).returncode == 0
    done = call(*WAVEFORM, "--png", "a.png", "--npz", "a.npz", "--json", "-", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert (document["first_batch"], document["n_batches"]) == (0, 2)
    assert "crest factor" in done.stderr
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    with np.load(tmp_path / "a.npz") as file:
        assert file["samples"].shape == (2, document["n_samples"])
