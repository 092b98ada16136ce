"""kill -9 of a run and of the control system that leads it, at random moments: both can begin again."""

from __future__ import annotations

import contextlib
import os
import random
import subprocess
import sys
from collections.abc import Generator
from pathlib import Path

import labseq_client
import pytest

import labseq
from tests.remote.conftest import free_port

from .chaos import PROFILE, Bench, check_after_end
from .resumable import check_committed

pytestmark = pytest.mark.system

N_TRIALS = int(os.environ.get("LABSEQ_KILLS", "1"))
N_SHOTS = 4
LEADER = """
import sys
import time
from labseq_client import Leader, LabseqError
while True:
    try:
        with Leader(port=int(sys.argv[1])) as labseq:
            while True:
                labseq.go()
                labseq.wait()
    except (LabseqError, OSError):  # no run waits, or the last leader is still known
        time.sleep(0.02)
"""
SEQUENCE = f"""
labseq: 1
name: led
profile: ./lab.yaml
shots: {N_SHOTS}
seed: 7
target: {{pattern: compact, rows: 6, cols: 6}}
planner: {{use: chaos}}
shot:
  - wait: {{for: go, timeout: 60 s}}
  - image: {{exposure: 45 ms}}
  - rearrange: {{cycles: 2, window: 200 ms, exposure: 45 ms}}
  - image: {{exposure: 45 ms}}
"""
DEVICES = "devices: {leader: {use: tcp_leader, port: PORT, deadline: 60 s, loads: true}}"


@contextlib.contextmanager
def leading(bench: Bench, port: int) -> Generator[subprocess.Popen[bytes]]:
    """A control system that starts one shot after the other, in whatever run waits."""
    folder = Path(labseq_client.__file__).parent
    command = [sys.executable, "-c", LEADER, str(port)]
    with subprocess.Popen(command, cwd=folder, env=bench.environment) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("trial", range(N_TRIALS))
def test_a_run_and_its_leader_begin_again_after_kills(trial: int, tmp_path: Path) -> None:
    chance, bench, port = random.Random(trial), Bench(tmp_path, None), free_port()
    (bench.home / "led.yaml").write_text(SEQUENCE)
    (bench.home / "lab.yaml").write_text(PROFILE + DEVICES.replace("PORT", str(port)))
    run = bench.start("run", "led.yaml")
    with leading(bench, port):  # the run survives the end of this one
        bench.await_calls(run, chance.randint(1, 50))
    with leading(bench, port):
        bench.await_calls(run, bench.n_calls() + chance.randint(1, 30))
        run.kill()
        check_after_end(bench, run, bench.end(run))
    command = ["resume", str(bench.runs()[0])] if bench.runs() else ["run", "led.yaml"]
    with leading(bench, port):
        text = bench.run(*command)
    (folder,) = bench.runs()
    done = labseq.open_run(folder)
    assert (done.status, len(done.shots)) == ("complete", N_SHOTS), text
    check_committed(folder, may_be_torn=True)
    assert bench.is_on() == []
