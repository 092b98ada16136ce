"""Analyses beside a run: none of them stops or slows it, and missing results can be computed later."""

from __future__ import annotations

import json
import os
import re
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.builtin.analyses import SurvivalAnalysis
from labseq.errors import ConfigError
from labseq.processes import Lock
from labseq.recording.results import results_file
from labseq.roles import Analysis, RecordedShot
from labseq.session import analysis_processes
from labseq.session.analyses import analyse_missing, analyses_of, prepare

PLUGIN = """
import os, threading
import labseq
LABSEQ_API = 1

class Mean:
    def __init__(self, settings, context):
        self.n_sites = context.grid.n_rows * context.grid.n_cols
    def shot(self, shot):
        print("looking at", shot.index)
        return {"filling": shot.occupancies[-1].sum() / self.n_sites}

class Fails(Mean):
    def shot(self, shot):
        if shot.index == 1 and not os.path.exists("repaired"):
            raise ValueError("too dark")
        return super().shot(shot)

class Dies(Mean):
    def shot(self, shot):
        os._exit(7)

class Hangs(Mean):
    def shot(self, shot):
        threading.Event().wait()

class NoMapping(Mean):
    def shot(self, shot):
        return 5

@labseq.plugin.hookimpl
def labseq_register(registry):
    for made in (Mean, Fails, Dies, Hangs, NoMapping):
        registry.analysis(made.__name__.lower(), made)
"""
SEQUENCE = """labseq: 1
name: analysed
shots: 3
seed: 5
plugin_folders: [plugins, mine]
target: {pattern: compact, rows: 5, cols: 5}
record_frames: none
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 2, window: 60 ms}
  - image: {exposure: 45 ms}
"""


def write(folder: Path, analysis: str) -> Path:
    (folder / "mine").mkdir()
    (folder / "mine" / "analyses.py").write_text(PLUGIN)
    path = folder / "analysed.yaml"
    path.write_text(SEQUENCE + (f"analysis: {analysis}\n" if analysis else ""))
    return path


def run(folder: Path, analysis: str) -> labseq.Run:
    with labseq.Session.open(write(folder, analysis), output=folder / "data") as session:
        return session.run()


def warnings(run: labseq.Run) -> list[str]:
    return [event["values"]["text"] for event in run.events if event["event"] == "warning"]


def fillings(run: labseq.Run) -> list[float]:
    return [row["filling"] for row in run.analysis("mean")]


def log_of(run: labseq.Run, name: str) -> Path:
    return results_file(run.path, name).with_suffix(".log")


def test_every_shot_of_a_run_is_analysed_beside_it(tmp_path):
    done = run(tmp_path, "[{use: survival, atoms: moved, finish_within: 600 s}]")
    assert warnings(done) == []
    rows = done.analysis("survival")
    assert [row["shot"] for row in rows] == [0, 1, 2]
    settings: Any = prepare(done, analyses_of(done)[0]).about["settings"]
    assert settings == {"atoms": "moved"}
    analysis = prepare(done, analyses_of(done)[0]).analysis
    assert isinstance(analysis, SurvivalAnalysis)
    for row, shot in zip(rows, done.shots, strict=True):
        made = analysis.shot(shot)
        assert np.array_equal(row["expected"], made["expected"])
        assert (row["n_expected"], row["n_survived"]) == (made["n_expected"], made["n_survived"])
    assert not log_of(done, "survival").exists()


def test_analyses_that_fail_leave_the_run_alone(tmp_path, monkeypatch):
    tmp_path.chmod(0o2775)
    # on a busy computer their processes, which come last, take long to begin
    names = ["fails", "dies", "nomapping"]
    done = run(tmp_path, f"[{', '.join(f'{{use: {name}, finish_within: 600 s}}' for name in names)}]")
    assert (done.status, len(done.shots)) == ("complete", 3)
    text = "\n".join(warnings(done))
    assert re.search(r"analysis 'fails' failed: shot 1: ValueError: too dark \(.*\.py:\d+\); see ", text)
    assert "analysis 'fails' has no result for 1 of 3 shots (1 failed); 'labseq analyse" in text
    assert "analysis 'dies' failed: its process ended with exit code 7; see " in text
    assert "analysis 'dies' has no result for 3 of 3 shots; " in text
    assert "analysis 'nomapping' failed: shot 0: TypeError: the result is int; expected a mapping" in text
    assert len(warnings(done)) == 6
    assert done.analysis("fails")[1]["error"].startswith("ValueError: too dark (")
    log = log_of(done, "fails").read_text()
    assert log.startswith("looking at 0\n")
    assert os.name == "nt" or log_of(done, "fails").stat().st_mode & stat.S_IWGRP  # others may resume it
    assert 'raise ValueError("too dark")' in log
    for name, why in (("dies", ";"), ("nomapping", ": shot 0: TypeError: the result is int")):
        with pytest.raises(ConfigError, match=f"the analysis '{name}' has no result of any shot{why}"):
            done.quantity(f"analysis.{name}.filling")
    with pytest.raises(ConfigError, match=r"there is no quantity 'analysis\.fails\.feeling'"):
        done.quantity("analysis.fails.feeling")

    monkeypatch.chdir(tmp_path)
    Path("repaired").touch()
    made = analyse_missing(done, {"use": "fails"})
    assert (made.n_done, made.n_before, made.failures) == (1, 2, {})
    assert [set(row) for row in done.analysis("fails")] == [{"shot", "filling"}] * 3


def test_an_analysis_that_does_not_finish_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(analysis_processes, "GRACE_S", 0.0)
    done = run(tmp_path, "[{use: hangs, finish_within: 0 s}]")
    assert done.status == "complete"
    ended, left = warnings(done)
    assert "'hangs' did not finish within 0 s" in ended
    assert "'hangs' has no result for 3 of 3 shots" in left
    assert f"'labseq analyse {done.path}'" in left


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    """A run without analyses."""
    return run(tmp_path_factory.mktemp("taken"), "")


def test_missing_results_are_computed_once_and_again_for_other_settings(taken):
    def analyse(again: bool = False, **settings: str) -> tuple[int, int]:
        made = analyse_missing(taken, settings, again=again)
        return made.n_done, made.n_before

    assert [analyse(use="mean"), analyse(use="mean"), analyse(True, use="mean")] == [(3, 0), (0, 3), (3, 0)]
    assert fillings(taken) == [shot.occupancies[-1].mean() for shot in taken.shots]
    assert analyse(use="survival") == (3, 0)
    rows = taken.analysis("survival")
    assert analyse(use="survival", atoms="moved") == (3, 0)
    assert taken.analysis("survival") != rows
    assert analyse(use="survival") == (3, 0)
    assert taken.analysis("survival") == rows
    lines = map(json.loads, results_file(taken.path, "survival").read_text().splitlines())
    head = [row for row in lines if "shot" not in row][-1]
    assert head.items() >= {"analysis": "survival", "settings": {"atoms": "all"}}.items()
    assert head.items() >= {"plugin": "labseq.builtin", "version": labseq.__version__}.items()


def test_two_processes_never_write_the_same_results(taken):
    path = results_file(taken.path, "fails")
    lock = Lock(path.with_name(".fails.lock"), "the analysis 'fails'")
    assert lock.take() is None
    with pytest.raises(ConfigError, match="'fails' are being written"):
        analyse_missing(taken, {"use": "fails"})
    lock.release()


def test_what_open_run_gives_is_what_an_analysis_is_promised(taken):
    shot: RecordedShot = taken.shots[0]
    assert [name for name in dir(RecordedShot) if name[0] != "_" and not hasattr(shot, name)] == []
    analysis: Analysis = prepare(taken, {"use": "survival"}).analysis
    assert analysis.shot(shot)["n_expected"]
