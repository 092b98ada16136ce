"""``labseq replay`` and ``labseq analyse``: what they print, and their exit codes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.analysis.analysing import analyse_run
from labseq.analysis.overview import scan_picture
from labseq.analysis.replay import ReplayRequest
from labseq.analysis.replay_report import replay_run
from labseq.analysis.scanned import ScanRequest
from labseq.data.scanned import FitRequest
from labseq.errors import ConfigError

SEQUENCE = """labseq: 1
name: replayed
shots: 2
seed: 5
plugin_folders: [mine]
target: {pattern: compact, rows: 12, cols: 12}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 2, window: 60 ms, stop_when: never}
  - image: {exposure: 45 ms}
"""
PLUGIN = """
import labseq
LABSEQ_API = 1

class Wrong:
    def __init__(self, settings, context):
        pass
    def plan(self, occupancy, target):
        return labseq.Plan.from_batches([([(0, 0)], [(3, 3)])])
    def shot(self, shot):
        raise ValueError("too dark")

@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("wrong", Wrong)
    registry.analysis("wrong", Wrong)
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    folder = tmp_path_factory.mktemp("replay")
    (folder / "mine").mkdir()
    (folder / "mine" / "wrong.py").write_text(PLUGIN)
    (folder / "replayed.yaml").write_text(SEQUENCE)
    with labseq.Session.open(folder / "replayed.yaml", output=folder) as session:
        return session.run()


def replayed(run: labseq.Run, output: Path | None = None, **options: Any) -> int:
    return replay_run(run.path, ReplayRequest(**options), output, as_json=False)


def test_a_run_that_comes_out_the_same_says_so(run, capsys):
    assert replayed(run) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{run.path}: 2 shots\n")
    assert out.endswith("\nreproduced: 4 plans and 8 images, all as recorded\n")
    assert "the same as recorded: 4 of 4 (100.0 %)" in out
    assert re.search(r"^sites that differ +0 of 3200, on 0 images$", out, re.MULTILINE)
    rows = [line.split()[:5] for line in out.splitlines() if "recorded   " in line or "replayed   " in line]
    assert [row[:4] for row in rows[:2]] == [
        ["cycle", "0,", "recorded", "2"],
        ["cycle", "0,", "replayed", "2"],
    ]


def test_a_run_that_does_not_come_out_the_same_exits_with_1(run, capsys, monkeypatch):
    from labseq_psca.planner import PscaPlanner

    monkeypatch.setattr(PscaPlanner, "plan", lambda *_: labseq.Plan.from_batches([]))
    assert replayed(run) == 1
    assert capsys.readouterr().out.splitlines()[-1].startswith("NOT REPRODUCED: ")


def test_plans_that_break_a_rule_are_reported(run, capsys):
    assert replayed(run, planner="wrong", shots="1") == 0
    printed = capsys.readouterr()
    assert "INVALID: 2 of 2 (100.0 %)" in printed.out
    assert re.match(r"shot 1, cycle 0: planner 'wrong': batch 0.* breaks the rule", printed.err)


def test_sites_that_differ_are_drawn(run, capsys):
    assert replayed(run, overrides=["profile.detector.threshold=1e6"], shots="0") == 0
    out = capsys.readouterr().out
    assert "detector threshold: threshold 1000000.0" in out
    assert re.search(r"^on a last image +recorded \d+, now 0, truth \d+$", out, re.MULTILINE)
    drawn = out.partition("* both\n")[2].splitlines()
    seen = run.shots[0].occupancies.any(axis=0)
    assert drawn == [" ".join(".-"[int(atom)] for atom in row) for row in seen]


def test_everything_is_written_as_json(run, tmp_path, capsys):
    path = tmp_path / "replay.json"
    assert replayed(run, path, planner="tetris") == 0
    capsys.readouterr()
    values = json.loads(path.read_text())
    assert values["used"] == {"planner": {"use": "tetris", "degree_of_parallelism": 7}}
    assert (values["reproduced"], values["detector"]) == (None, None)
    assert [plan["shot"] for plan in values["planner"]["plans"]] == [0, 0, 1, 1]
    assert values["planner"]["replayed"]["n_plans"] == 4


def test_an_analysis_is_made_up_and_reported(run, capsys):
    assert analyse_run(run.path, "survival", ["atoms=moved"], again=False) == 0
    path = run.path / "analysis" / "survival.jsonl"
    assert capsys.readouterr().out == f"survival: 2 shots analysed; see {path}\n"
    assert analyse_run(run.path, "survival", ["atoms=moved"], again=False) == 0
    assert "0 shots analysed, 2 already had a result" in capsys.readouterr().out


def test_quantities_need_neither_analysis_nor_scan(run, capsys):
    assert analyse_run(run.path, None, [], ScanRequest(("loading",)), again=False) == 0
    expected = run.quantity("loading").over(run.shots).scaled(100)
    assert capsys.readouterr().out.splitlines() == [
        "the run has no scan: these are all its shots",
        "",
        "shots  loading",
        f"    2  {expected} %",
    ]
    with pytest.raises(ConfigError, match="there is no axis to fit along; expected a scan of a num"):
        analyse_run(run.path, None, [], ScanRequest(fit=FitRequest("linear", {})), again=False)
    with pytest.raises(ConfigError, match=r"it has no scan; expected .*`labseq show --scan` prints"):
        scan_picture(run, ScanRequest())


def test_an_analysis_that_fails_exits_with_1(run, capsys):
    assert analyse_run(run.path, "wrong", [], again=False) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    for i, line in enumerate(lines):  # with the line of the analysis
        assert re.fullmatch(rf"wrong: shot {i} failed: ValueError: too dark \(.*\.py:\d+\)", line)


@pytest.mark.parametrize(
    ("use", "overrides", "expected"),
    [
        (None, [], "the run's sequence has no analysis; name one with --use"),
        (None, ["atoms=all"], "--set atoms=all: .*; name it with --use"),
        ("sruvival", [], "unknown analysis 'sruvival'.*did you mean 'survival'"),
        ("survival", ["atom=all"], "'atom' is not a setting.*did you mean 'atoms'"),
        ("survival", ["profile.atoms=all"], "an analysis has no settings in the profile"),
    ],
)
def test_what_cannot_be_analysed_is_refused(run, use, overrides, expected):
    with pytest.raises((ConfigError, labseq.UnknownPluginError), match=expected):
        analyse_run(run.path, use, overrides, again=False)
