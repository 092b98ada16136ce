"""Scans and checks that follow results of analyses: waited for, on record, and the same after a resume."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import labseq
from labseq.errors import CheckFailedError, ConfigError, DeviceError
from labseq.session import analysis_processes
from labseq.testing.fakes import RecordingObserver

from .small_runs import PROFILE, interrupted, resumed, table

PLUGIN = """
import os, time
from pathlib import Path
import labseq
LABSEQ_API = 1

class Named:
    def __init__(self, settings, context):
        pass
    def shot(self, shot):
        return {"filling": float(shot.occupancies[-1].mean()), "rows": shot.occupancies[-1].mean(axis=0)}

class Mean(Named):
    results = ("filling", "rows")

class Trouble(Named):
    def shot(self, shot):
        if shot.index == 1:
            raise ValueError("too dark")
        while shot.index == 2 and not os.path.exists("go"):
            Path("late").touch()
            time.sleep(0.01)
        if shot.index == 4 and not os.path.exists("repaired"):
            os._exit(7)
        return super().shot(shot)

@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.analysis("mean", Mean)
    registry.analysis("named", Named)
    registry.analysis("trouble", Trouble)
"""
SEQUENCE = """labseq: 1
name: awaited
profile: ./p.yaml
plugin_folders: [mine]
record_frames: none
target: {pattern: compact, rows: 3, cols: 3}
shot:
  - load: {duration: 500 ms}
  - name: last
    image: {exposure: 45 ms}
"""
CLIMB = """scan:
  use: climb
  over: {shot.0.load.duration: {from: 100 ms, to: 900 ms}}
  maximise: analysis.mean.filling
  points: 4
repeats: 2
analysis: [{use: mean, finish_within: 600 s}]
"""
N_LINES = SEQUENCE.count("\n")


def write(folder: Path, rest: str) -> Path:
    (folder / "mine").mkdir(exist_ok=True)
    (folder / "mine" / "analyses.py").write_text(PLUGIN, "utf-8")
    (folder / "p.yaml").write_text(PROFILE, "utf-8")
    path = folder / "awaited.yaml"
    path.write_text(SEQUENCE + rest, "utf-8")
    return path


def points(run: labseq.Run) -> list[Any]:
    return [event["values"] for event in run.events if event["event"] == "scan_point"]


def test_a_scan_follows_an_analysis_and_a_resumed_one_decides_alike(tmp_path: Path) -> None:
    path = write(tmp_path, CLIMB)
    whole = labseq.open_run(interrupted(path, "never", 1))
    filling = [row["filling"] for row in whole.analysis("mean")]
    assert [one["value"] for one in points(whole)] == pytest.approx(
        [sum(filling[i : i + 2]) / 2 for i in (0, 2, 4, 6)]
    )
    assert len(whole.scan["points"]) == 4
    (best,) = [event["values"] for event in whole.events if event["event"] == "scan_result"]
    assert best["value"] == pytest.approx(max(one["value"] for one in points(whole)))

    run_dir = interrupted(path, "shot_finished", 4)  # before the results of the second point are read
    assert len(points(labseq.open_run(run_dir))) == 1
    results = run_dir / "analysis" / "mean.jsonl"
    about, *_ = results.read_text("utf-8").splitlines()
    others = [json.dumps({"shot": shot, "filling": 9.0}) for shot in (0, 1)]
    results.write_text("\n".join([about, *others, ""]), "utf-8")  # of other values, and without the last ones
    again = resumed(run_dir)
    assert table(again) == table(whole)
    values = {one["point"]: one["value"] for one in points(whole)}
    assert [(one["point"], one["value"]) for one in points(again)] == [(i, values[i]) for i in (0, 2, 3)]


class Going(RecordingObserver):
    """Lets the analysis of shot 2 finish once shot 3 begins."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        super().event(name, values)
        if name == "shot_started" and values["shot"] == 3:
            Path("go").touch()


def test_a_result_that_does_not_come_is_no_value_and_an_analysis_that_dies_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def now_s() -> float:  # the time for shot 2 is up as soon as its analysis has begun
        is_late = Path("late").exists() and not Path("go").exists()
        return time.monotonic() + (1e4 if is_late else 0.0)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(analysis_processes, "time", SimpleNamespace(monotonic=now_s))
    rest = CLIMB.replace("mean", "trouble").replace("repeats: 2", "repeats: 1")
    path, seen = write(tmp_path, rest.replace("points: 4", "points: 6")), Going()
    with labseq.Session.open(path, seed=5, output=tmp_path / "data", observer=seen) as session:
        with pytest.raises(DeviceError) as caught:
            session.run()
        run_dir = session.run_dir
    assert run_dir is not None
    for words in ("analysis 'trouble'", "'analysis.trouble.filling'", "analysis/trouble.log"):
        assert words in str(caught.value)
    assert caught.value.exit_code == 3
    assert [one["value"] is None for one in seen.of("scan_point")] == [False, True, True, False]
    texts = [one["text"] for one in seen.of("warning")]
    missing = [text for text in texts if "has no 'analysis.trouble.filling'" in text]
    assert [text[:6] for text in missing] == ["shot 1", "shot 2"]
    assert "ValueError: too dark" in missing[0]

    Path("repaired").touch()
    again = resumed(run_dir)
    assert (again.status, len(again.shots)) == ("complete", 6)
    used = [event["values"] for event in again.events if event["event"] == "results_used"]
    assert [one["shots"] for one in used] == [[0], [1], [2], [3], [4], [5]]
    assert [one["values"] == [None] for one in used] == [False, True, True, False, False, False]
    assert [row["shot"] for row in again.analysis("trouble") if "error" in row] == [1]


def test_a_check_waits_for_the_analysis_of_each_shot(tmp_path: Path) -> None:
    checks = """
    - {value: "loading:last", at_most: 0}
    - {value: analysis.mean.filling, at_least: 2, shots: 2, then: stop}"""
    path, seen = (
        write(
            tmp_path,
            f"shots: 6\npolicy:\n  checks:{checks}\nanalysis: [{{use: mean, finish_within: 600 s}}]\n",
        ),
        RecordingObserver(),
    )
    with labseq.Session.open(path, output=tmp_path / "data", observer=seen) as session:
        with pytest.raises(CheckFailedError, match=r"analysis\.mean\.filling is 0\.\d+ on the mean of the"):
            session.run()
        assert session.run_dir is not None
        run = labseq.open_run(session.run_dir)
    loading = run.quantity("loading")
    for i, warning in enumerate(seen.of("warning")):
        value = f"{loading.of_shot(run.shots[i]):.6g}"
        assert warning["text"].startswith(f"shot {i}: loading:last is {value}; ")
    assert len(seen.of("warning")) == 2
    assert len(run.shots) == 2


@pytest.mark.parametrize(
    ("figure", "analysis", "expected", "hint"),
    [
        ("analysis.mean.fillin", "mean", "analysis.mean.rows", "did you mean 'analysis.mean.filling'?"),
        ("analysis.man.filling", "mean", "analysis.mean.filling", "the sequence must list the analysis: "),
        ("analysis.mean.x", "named", "analysis.named.<name>", "'analysis: [{use: mean}]'"),
    ],
)
@pytest.mark.parametrize("purpose", ["to optimise", "to check"])
def test_a_result_that_no_analysis_gives_is_refused(
    tmp_path: Path, purpose: str, figure: str, analysis: str, expected: str, hint: str
) -> None:
    rest = CLIMB.replace("analysis.mean.filling", figure).replace("use: mean", f"use: {analysis}")
    if purpose == "to check":
        check = f"policy:\n  checks:\n    - {{value: {figure}, at_least: 0}}\n"
        rest = f"shots: 2\n{check}analysis: [{{use: {analysis}}}]\n"
    with pytest.raises(ConfigError) as caught:
        labseq.Session.open(write(tmp_path, rest))
    (problem,) = caught.value.problems
    assert problem.line == N_LINES + 4
    assert figure in problem.what
    assert purpose in problem.what
    assert expected in problem.expected.split(", ")
    assert hint in problem.hint
