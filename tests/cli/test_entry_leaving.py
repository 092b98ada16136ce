"""The end of the process, with plugins that leave threads behind."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PLUGIN = """
import sys
import threading
from labseq.plugin import hookimpl

LABSEQ_API = 1
threading.Thread(target=threading.Event().wait, name="labseq test poller", daemon={daemon}).start()

@hookimpl
def labseq_register(registry):
    sys.__stdout__.write("still in the buffer")  # print() would go to stderr here
"""


def leave(tmp_path: Path, command: str, *, daemon: bool) -> subprocess.CompletedProcess[str]:
    (tmp_path / "poller.py").write_text(PLUGIN.format(daemon=daemon), "utf-8")
    environment = {**os.environ, "LABSEQ_PLUGIN_PATH": str(tmp_path)}
    environment.pop("PYTHONUNBUFFERED", None)
    arguments = [sys.executable, "-m", "labseq", *command.split()]
    return subprocess.run(
        arguments, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=600
    )


def test_a_thread_that_never_ends_does_not_keep_the_process(tmp_path: Path) -> None:
    done = leave(tmp_path, "plan random:20x20@0.75 --target compact_225 --planner none", daemon=False)
    assert done.returncode == 2
    assert "a thread of a plugin did not end and stopped with the process: labseq test poller" in done.stderr
    assert "still in the buffer" in done.stdout


def test_a_daemon_thread_is_not_mentioned(tmp_path: Path) -> None:
    done = leave(tmp_path, "plugins", daemon=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "still in the buffer" in done.stdout
