"""kill -9 at random moments: every shot in the index opens and reads back whole."""

import hashlib
import json
import os
import random

import numpy as np
import pytest

import labseq

pytestmark = pytest.mark.system

N_KILLS = int(os.environ.get("LABSEQ_KILLS", "4"))


@pytest.mark.parametrize("trial", range(N_KILLS))
def test_committed_shots_survive(bench, trial):
    random_moment = random.Random(trial)
    process = bench.start("run", "sequence.yaml", "--shots", "100000")
    bench.await_calls(process, "camera.read", random_moment.randint(1, 150))
    process.kill()
    process.communicate()
    run_dir = bench.run_dir()
    index_file = run_dir / "index.jsonl"
    lines = index_file.read_bytes().split(b"\n")[:-1] if index_file.exists() else []  # a torn line has no end
    run = labseq.open_run(run_dir)
    assert run.status == "failed"
    assert len(run.shots) == len(lines)
    for line, shot in zip(map(json.loads, lines), run.shots, strict=True):
        data = (run_dir / line["file"]).read_bytes()
        assert hashlib.sha256(data).hexdigest() == line["sha256"]
        assert shot.frames.shape[0] == len(shot.occupancies) == line["n_images"]
        assert shot.frames.dtype == np.uint16
        assert [plan.n_batches for plan in shot.plans] == [c.plan.n_batches for c in shot.cycles]
