"""Whole runs with the user's own plugins, right and wrong."""

import json
from pathlib import Path

import pytest

import labseq
from labseq.errors import ConfigError, InvalidPlanError, PlanError
from labseq.files import devices_root
from labseq.testing.fakes import RecordingObserver

from .whole_runs import ROOT, run

THIRD_PARTY = """
import numpy as np

import labseq

LABSEQ_API = 1


class OneByOne:
    def __init__(self, settings, context):
        self.degree_of_parallelism = 1

    def plan(self, occupancy, target):
        now, batches = occupancy.copy(), []
        for row, col in np.argwhere(target.fill):
            atoms = np.flatnonzero(now[row, col:])
            if not now[row, col] and len(atoms):
                source = col + atoms[0]
                batches.append(([(row, source)], [(row, col)]))
                now[row, source], now[row, col] = False, True
        return labseq.Plan.from_batches(batches)


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("mine", OneByOne)
"""

HAS_STARTED = """
RUNNING = []


@labseq.plugin.hookimpl
def labseq_run_started(run):
    RUNNING.append(run)
"""

SEQUENCE = """
labseq: 1
name: my-planner
plugin_folders: [my_plugins]
shots: 1
target: {pattern: compact, rows: 5, cols: 5}
planner: {use: mine}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 3, window: 200 ms}
  - image: {exposure: 45 ms}
"""


def with_plugin(tmp_path, text, sequence=SEQUENCE):
    folder = tmp_path / "my_plugins"
    folder.mkdir()
    (folder / "mine.py").write_text(text, encoding="utf-8")
    path = tmp_path / "mine.yaml"
    path.write_text(sequence, encoding="utf-8")
    return path


def test_a_planner_in_the_users_own_folder_runs(tmp_path):
    done = run(tmp_path, with_plugin(tmp_path, THIRD_PARTY), seed=1)
    assert done.status == "complete"
    assert done.shots[0].plans[0].n_batches > 0
    assert "mine" in {p["name"] for p in done.record["plugins"]}


@pytest.mark.parametrize(
    ("batches", "rule"),
    [
        ("[([(row, col)], [(row + 1, col + 1)]) for row, col in np.argwhere(occupancy[:-1])]", "straight"),
        ("[([(row, 0)], [(row, 1)]) for row in np.flatnonzero(~occupancy[:, 0])]", "source"),
    ],
)
def test_a_wrong_plan_is_stopped_before_anything_plays(tmp_path, batches, rule):
    wrong = f"from_batches({batches}[:1] if RUNNING else batches)"  # the rehearsal finds nothing
    code = THIRD_PARTY.replace("from_batches(batches)", wrong) + HAS_STARTED
    seen = RecordingObserver()
    with pytest.raises(InvalidPlanError) as caught:
        run(tmp_path, with_plugin(tmp_path, code), seed=1, observer=seen)
    assert (caught.value.rule, caught.value.planner) == (rule, "mine")
    stages = [v["timing"].stage for v in seen.of("stage")]
    assert "check" in stages
    assert not {"prepare", "play"} & set(stages)
    safe = [v["device"] for v in seen.of("safe_state")]
    assert safe == ["mobile_tweezers", "shutter", "synthesizer", "lines", "camera", "static_tweezers"]
    (index,) = (tmp_path / "data").glob("*/*/index.jsonl")
    (line,) = [json.loads(text) for text in index.read_text().splitlines()]
    assert line["status"] == "failed"
    assert rule in line["error"]


@pytest.mark.parametrize(
    ("old", "new", "kind", "message"),
    [
        (
            "return labseq.Plan.from_batches(batches)",
            "return batches",
            ConfigError,
            r"'shape': .*labseq.plugin.Plan.from_batches.* list",
        ),
        (
            "    def plan(",
            "    def warm(self):\n        raise SystemExit(0)\n\n    def plan(",
            PlanError,
            r"warm\(\) raised SystemExit: 0",
        ),
        (
            "        self.degree_of_parallelism = 1\n",
            "        pass\n\n    degree_of_parallelism = property(lambda self: __import__('sys').exit(0))\n",
            labseq.PluginLoadError,
            "degree_of_parallelism raised SystemExit: 0",
        ),
    ],
)
def test_a_plugin_that_fails_is_named(tmp_path, old, new, kind, message):
    path = with_plugin(tmp_path, THIRD_PARTY.replace(old, new, 1))
    with pytest.raises(kind, match=message) as caught:
        run(tmp_path, path, seed=1)
    assert "mine" in str(caught.value)


def test_a_plugin_that_changes_the_folder_does_no_harm(tmp_path, monkeypatch):
    code = "\n\n@labseq.plugin.hookimpl\ndef labseq_run_started(run):\n    __import__('os').chdir('/')\n"
    path = with_plugin(tmp_path, THIRD_PARTY + code)
    (tmp_path / "own.yaml").write_text(
        (ROOT / "hardware_profiles" / "virtual.yaml").read_text("utf-8"), "utf-8"
    )
    monkeypatch.chdir(tmp_path)
    with labseq.Session.open(path.name, profile="own.yaml", shots=1, output="here") as session:
        assert session.run().path.is_relative_to(tmp_path / "here")
    assert Path.cwd() != tmp_path
    assert list(devices_root().glob("*.json")) == []
