"""``labseq bench planners`` in processes of its own: stopped, and with JSON alone on stdout."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

STUCK = """
import os
import pathlib
import threading

import labseq

LABSEQ_API = 1


class Stuck:
    '''Never comes back from the 61st call in a process, so that some jobs are done by then.'''

    degree_of_parallelism = 1

    def __init__(self, settings, context):
        self.n_calls = 0
        log = pathlib.Path(os.environ["STUCK_LOG"])
        with log.open("a") as file:
            file.write(f"{os.getpid()}\\n")

    def plan(self, occupancy, target):
        self.n_calls += 1
        if self.n_calls > 60:
            threading.Event().wait()
        return labseq.Plan.from_batches([])


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("stuck", Stuck)
"""

SMALL = ("--grid", "6x6", "--target", "compact:3x3", "--loadings", "200")


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    (folder / "plugins").mkdir()
    (folder / "plugins" / "stuck.py").write_text(STUCK, "utf-8")
    environment = {"LABSEQ_PLUGIN_PATH": str(folder / "plugins"), "STUCK_LOG": str(folder / "pids")}
    return subprocess.Popen(
        [sys.executable, "-m", "labseq", "bench", "planners", *SMALL, *arguments],
        cwd=folder,
        env={**os.environ, **environment},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals between processes")
@pytest.mark.parametrize(
    ("n_workers", "n_done", "number", "code"), [(2, 100, signal.SIGINT, 130), (1, 50, signal.SIGTERM, 143)]
)
def test_what_is_done_is_kept(tmp_path: Path, n_workers: int, n_done: int, number: int, code: int) -> None:
    arguments = ("--planners", "stuck", "--workers", str(n_workers), "--csv", "out.csv", "--json", "-")
    with start(tmp_path, *arguments) as child:
        assert child.stderr is not None
        line = ""
        while line != f"{n_done} of 200 loadings\n":
            line = child.stderr.readline()
            assert line, f"it ended early: {child.poll()}"
        if number == signal.SIGINT:
            os.killpg(child.pid, number)  # as a terminal does: every process gets it
        else:
            child.send_signal(number)
        out, err = child.communicate(timeout=60)
    assert child.returncode == code, err
    assert "Traceback" not in err
    assert f"INCOMPLETE: {n_done} of 200 loadings" in err
    assert err.splitlines()[-1].startswith("stopped by ")
    values = json.loads(out)
    assert values["complete"] is False
    assert [row["n_loadings"] for row in values["rows"]] == [n_done]
    assert len((tmp_path / "out.csv").read_text("utf-8").splitlines()) == 2
    for pid in {int(pid) for pid in (tmp_path / "pids").read_text().split()}:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_a_process_that_dies_ends_the_comparison_with_what_is_done(tmp_path: Path) -> None:
    with start(tmp_path, "--planners", "stuck", "--workers", "2") as child:
        assert child.stderr is not None
        while (line := child.stderr.readline()) != "100 of 200 loadings\n":
            assert line
        pids = {int(pid) for pid in (tmp_path / "pids").read_text().split()} - {child.pid}
        os.kill(min(pids), signal.SIGKILL)
        out, err = child.communicate(timeout=60)
    assert child.returncode == 1
    assert "INCOMPLETE: 100 of 200 loadings" in out
    assert "error: a process of the comparison died (exit code -9)" in err
    assert "Traceback" not in err
