"""A writer killed at any moment loses nothing that it had reported as written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from labseq.data.reader import open_run
from labseq.recording.doctor import examine

WRITE_FOR_EVER = """
import sys
from pathlib import Path
import numpy as np
from labseq.model import Frame, ImageRecord, RunRecord, ShotRecord, TargetPattern
from labseq.recording.writer import RunWriter

start = "2026-11-20T10:00:00.000000+00:00"
sites = np.ones((4, 5), np.bool_)
run = RunRecord(
    "kill", 1, 7, True, start, TargetPattern(sites, ~sites), "", "", "", "", {}, {}, {}, (), {}, "all", 1e-6, "square"
)
writer = RunWriter.create(Path(sys.argv[1]), run)
print(writer.run_dir, flush=True)
rng = np.random.default_rng(0)
for index in range(10**6):
    writer.event("shot_started", index=index)
    images = [
        ImageRecord(
            Frame(rng.integers(0, 2**16, (128, 128), np.uint16), 0.1, 0.1), sites, sites.astype(np.float32), 1, 0, 0.1, 0.1
        )
        for _ in range(4)
    ]
    writer.write_shot(ShotRecord(index, 0, 7, start, start, "complete", images=images, success=True))
    print(index, flush=True)
"""  # noqa: E501 - a program


@pytest.mark.parametrize("n_shots", [0, 5])
def test_kill(tmp_path: Path, n_shots: int) -> None:
    command = [sys.executable, "-c", WRITE_FOR_EVER, tmp_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        run_dir = Path(child.stdout.readline().strip())
        for _ in range(n_shots):
            child.stdout.readline()
        child.kill()  # somewhere in the next shots: nothing here waits for the child
        reported = n_shots + len(child.stdout.read().split())
    run = open_run(run_dir)
    assert run.status == "failed"
    assert len(run.shots) >= reported
    assert [shot.index for shot in run.shots] == list(range(len(run.shots)))
    for shot in run.shots:
        shot.verify()
        assert shot.record().success
        assert shot.frames.shape == (4, 128, 128)
    n_shots_found = len(run.shots)
    assert not any(one.left for one in examine(run_dir).findings)
    assert len(open_run(run_dir).shots) >= n_shots_found
    assert examine(run_dir).findings == []
