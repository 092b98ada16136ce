"""A few hundred damaged files of ``poe fuzz``, always the same ones."""

from __future__ import annotations

import os
import signal
import sys
from collections import deque
from itertools import repeat
from pathlib import Path

import pytest

if sys.platform == "win32":
    pytest.skip("signals limit the time", allow_module_level=True)

from tests.fuzz import run
from tests.fuzz.cases import Templates
from tests.fuzz.run import Results, read_one

N_FILES = {"calibration": 60, "plan": 60, "queue": 30, "run.json": 40, "index": 5, "shot": 5, "run": 2}


@pytest.fixture(scope="module")
def templates(tmp_path_factory: pytest.TempPathFactory) -> Templates:
    return Templates(tmp_path_factory.mktemp("templates"))


@pytest.mark.parametrize("kind", [*N_FILES])
def test_a_damaged_file_is_refused_or_read(
    kind: str, templates: Templates, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LABSEQ_DATA", "")
    for number in range(N_FILES[kind]):
        folder = tmp_path / str(number)
        folder.mkdir()
        error = read_one(kind, number, 18, templates, folder)
        assert not error, f"poe fuzz --seed 18 --only {kind} {number}: {error}"


@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_a_loop_of_c_is_ended_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    loops = {1: lambda: deque(repeat(None), 0), 2: lambda: os.kill(os.getpid(), signal.SIGKILL)}
    monkeypatch.setattr(run, "_TIMERS", {signal.SIGPROF: (signal.ITIMER_PROF, 0.2)})
    results = Results(tmp_path, seed=1)
    monkeypatch.setattr(run, "read_one", lambda kind, number, *_: loops.get(number, str)() and "")
    results.read([("shot", number) for number in range(4)])
    results.print()
    assert results.failures == [
        ("shot", "a hang: it ended the process (SIGPROF)"),
        ("shot", "a crash: it ended the process (SIGKILL)"),
    ]
    assert "shot              4        2" in capfd.readouterr().out
