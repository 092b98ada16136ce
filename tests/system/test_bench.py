"""``labseq bench planners``, stopped: what is done is kept, with JSON alone on stdout."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from labseq.cli import main

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
            if "STUCK_SIGNAL" in os.environ:
                os.kill(os.getpid(), int(os.environ["STUCK_SIGNAL"]))
            threading.Event().wait()
        return labseq.Plan.from_batches([])


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("stuck", Stuck)
"""

COMMAND = [
    "bench",
    "planners",
    "--grid",
    "6x6",
    "--target",
    "{pattern: compact, rows: 3, cols: 3}",
    "--loadings",
    "200",
    "--planners",
    "stuck",
]
FILES = ["--csv", "out.csv", "--json", "-"]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "stuck.py").write_text(STUCK, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path / "plugins"))
    monkeypatch.setenv("STUCK_LOG", str(tmp_path / "pids"))
    monkeypatch.chdir(tmp_path)


def start(*arguments: str) -> subprocess.Popen[str]:
    """Two workers, after 100 loadings of 200."""
    child = subprocess.Popen(
        [sys.executable, "-m", "labseq", *COMMAND, "--workers", "2", *arguments],
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    assert child.stderr is not None
    line = ""
    while line != "100 of 200 loadings\n":
        line = child.stderr.readline()
        assert line, f"it ended early: {child.poll()}"
    return child


def check_kept(n_done: int, out: str, err: str) -> None:
    assert "Traceback" not in err
    assert f"INCOMPLETE: {n_done} of 200 loadings" in err
    assert err.splitlines()[-1].startswith("stopped by ")
    values = json.loads(out)
    assert values["complete"] is False
    assert [row["n_loadings"] for row in values["rows"]] == [n_done]
    assert len(Path("out.csv").read_text("utf-8").splitlines()) == 2


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals between processes")
def test_what_is_done_is_kept() -> None:
    with start(*FILES) as child:
        os.killpg(child.pid, signal.SIGINT)  # as a terminal does: every process gets it
        out, err = child.communicate(timeout=180)
    assert child.returncode == 130, err
    check_kept(100, out, err)
    for pid in {int(pid) for pid in Path("pids").read_text().split()}:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals between processes")
def test_what_is_done_is_kept_without_other_processes(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STUCK_SIGNAL", str(int(signal.SIGTERM)))
    with pytest.raises(SystemExit, match=r"^143$"):
        main([*COMMAND, "--workers", "1", *FILES])
    out, err = capfd.readouterr()
    check_kept(50, out, err)
