"""Analyses beside a run: none of them stops or slows it, and what they left out is made up later."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.builtin.analyses import SurvivalAnalysis
from labseq.errors import ConfigError
from labseq.files import Lock
from labseq.recording.results import results_file
from labseq.roles import Analysis, RecordedShot
from labseq.session import observers
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
        if shot.index == 1 and not os.path.exists("mended"):
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
plugin_folders: [mine]
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
    done = run(
        tmp_path, "[{use: survival, atoms: moved, finish_within: 60 s}, {use: mean, finish_within: 60 s}]"
    )
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
    assert fillings(done) == [shot.occupancies[-1].mean() for shot in done.shots]
    assert log_of(done, "mean").read_text().splitlines() == [f"looking at {i}" for i in range(3)]
    assert not log_of(done, "survival").exists()


def test_a_run_does_not_mind_what_its_analyses_do(tmp_path, monkeypatch):
    monkeypatch.setattr(observers, "GRACE_S", 20.0)  # on a busy computer a process takes long to begin
    names = ["fails", "dies", "nomapping"]
    done = run(tmp_path, f"[{', '.join(f'{{use: {name}, finish_within: 60 s}}' for name in names)}]")
    assert (done.status, len(done.shots)) == ("complete", 3)
    told = "\n".join(warnings(done))
    assert "analysis 'fails' failed: shot 2: ValueError: too dark; see " in told
    assert "analysis 'fails' has no result of 1 of 3 shots (1 failed); 'labseq analyse" in told
    assert "analysis 'dies' failed: its process ended with exit code 7; see " in told
    assert "analysis 'dies' has no result of 3 of 3 shots; " in told
    assert "analysis 'nomapping' failed: shot 1: TypeError: the result is int; expected a mapping" in told
    assert len(warnings(done)) == 6
    assert done.analysis("fails")[1] == {"shot": 1, "error": "ValueError: too dark"}
    assert 'raise ValueError("too dark")' in log_of(done, "fails").read_text()

    monkeypatch.chdir(tmp_path)
    Path("mended").touch()
    made = analyse_missing(done, {"use": "fails"})
    assert (made.n_done, made.n_before, made.failures) == (1, 2, {})
    assert [set(row) for row in done.analysis("fails")] == [{"shot", "filling"}] * 3


def test_an_analysis_that_does_not_finish_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(observers, "GRACE_S", 0.0)
    done = run(tmp_path, "[{use: hangs, finish_within: 0 s}]")
    assert done.status == "complete"
    ended, left = warnings(done)
    assert ended == "analysis 'hangs' did not finish within 0 s after the run, and was ended"
    missing = "analysis 'hangs' has no result of 3 of 3 shots"
    assert left == f"{missing}; 'labseq analyse {done.path}' computes the missing results"


def test_a_wrong_setting_is_told_before_the_run(tmp_path):
    path = write(tmp_path, "[{use: mean, gain: 3}]")
    with pytest.raises(ConfigError, match=r"analysed.yaml:13:24: 'gain' is not a setting of analysis 'mean'"):
        labseq.Session.open(path)


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    """A run without analyses."""
    return run(tmp_path_factory.mktemp("taken"), "")


def test_any_analysis_can_be_made_up(taken):
    first = analyse_missing(taken, {"use": "mean"})
    assert (first.n_done, first.n_before) == (3, 0)
    again = analyse_missing(taken, {"use": "mean"})
    assert (again.n_done, again.n_before) == (0, 3)
    assert analyse_missing(taken, {"use": "mean"}, anew=True).n_done == 3
    assert [row["filling"] for row in taken.analysis("mean")] == [
        s.occupancies[-1].mean() for s in taken.shots
    ]


def test_results_of_other_settings_are_begun_again(taken):
    analyse_missing(taken, {"use": "survival"})
    rows = taken.analysis("survival")
    moved = analyse_missing(taken, {"use": "survival", "atoms": "moved"})
    assert (moved.n_done, moved.n_before) == (3, 0)
    assert taken.analysis("survival") != rows
    assert analyse_missing(taken, {"use": "survival"}).n_done == 3
    assert taken.analysis("survival") == rows


def test_results_say_what_made_them(taken):
    path = analyse_missing(taken, {"use": "survival", "atoms": "held"}).path
    heads = [row for line in path.read_text().splitlines() if "shot" not in (row := json.loads(line))]
    head = heads[-1]
    assert head | {"t_utc": ""} == {
        "analysis": "survival",
        "settings": {"atoms": "held"},
        "plugin": "labseq.builtin",
        "version": labseq.__version__,
        "labseq": labseq.__version__,
        "t_utc": "",
        "anew": True,
    }


def test_two_processes_never_write_the_same_results(taken):
    path = results_file(taken.path, "fails")
    lock = Lock(path.with_name(".fails.lock"), "the analysis 'fails'")
    assert lock.take() is None
    try:
        with pytest.raises(ConfigError, match="results of 'fails' are being written by the analysis 'fails'"):
            analyse_missing(taken, {"use": "fails"})
    finally:
        lock.release()


def test_what_open_run_gives_is_what_an_analysis_is_promised(taken):
    shot: RecordedShot = taken.shots[0]
    assert [name for name in dir(RecordedShot) if name[0] != "_" and not hasattr(shot, name)] == []
    analysis: Analysis = prepare(taken, {"use": "survival"}).analysis
    assert analysis.shot(shot)["n_expected"]
