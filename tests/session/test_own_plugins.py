"""Whole runs with plugins of one's own, right ones and those that are at fault."""

import json
from pathlib import Path

import pytest

import labseq
from labseq.errors import DeviceError, InvalidPlanError, PlanError
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


def test_a_planner_in_a_folder_of_ones_own_runs(tmp_path):
    done = run(tmp_path, with_plugin(tmp_path, THIRD_PARTY), seed=1)
    assert done.status == "complete"
    assert done.shots[0].plans[0].n_batches > 0
    assert "mine" in {p["name"] for p in done.record["plugins"]}


DAMAGED = '''
import numpy as np

import labseq

LABSEQ_API = 1


class Settings(labseq.plugin.Settings):
    damage: str


class Damaged:
    """One damaged plan per kind, made for the occupancy at hand."""

    degree_of_parallelism = 2

    def __init__(self, settings, context):
        self.damage = settings.damage

    def plan(self, occupancy, target):
        return labseq.Plan.from_batches(getattr(self, self.damage)(occupancy))

    def find(self, occupancy, pattern):
        width = len(pattern)
        for row in range(occupancy.shape[0]):
            for col in range(1, occupancy.shape[1] - width):
                if occupancy[row, col : col + width].tolist() == [bool(int(c)) for c in pattern]:
                    return row, col
        raise LookupError(pattern)

    def straight(self, occupancy):
        row, col = self.find(occupancy[:-1], "1")
        return [([(row, col)], [(row + 1, col + 1)])]

    def source(self, occupancy):
        row, col = self.find(occupancy, "00")
        return [([(row, col)], [(row, col + 1)])]

    def goal(self, occupancy):
        row, col = self.find(occupancy, "101")
        return [([(row, col), (row, col + 2)], [(row, col + 1), (row, col + 1)])]

    def path(self, occupancy):
        row, col = self.find(occupancy, "110")
        return [([(row, col)], [(row, col + 2)])]

    def order(self, occupancy):
        row, col = self.find(occupancy, "1100")
        return [([(row, col), (row, col + 1)], [(row, col + 3), (row, col + 2)])]

    def parallelism(self, occupancy):
        row, col = self.find(occupancy, "1110")
        return [([(row, col + i) for i in range(3)], [(row, col + i + 1) for i in range(3)])]

    def crossing(self, occupancy):
        rows, cols = occupancy.shape
        for row in range(rows - 1):
            for col in range(1, cols - 2):
                a, b = occupancy[row], occupancy[row + 1]
                if a[col] and not a[col + 1] and b[col]:
                    for other in range(col + 2, cols - 1):
                        if b[other] and not b[other + 1] and a[other] and not b[col + 1]:
                            return [([(row, col), (row + 1, other)], [(row, col + 1), (row + 1, other + 1)])]
        raise LookupError("crossing")

    def ejection(self, occupancy):
        row, col = next((r, c) for r, c in np.argwhere(occupancy) if c == 0)
        return [([(row, col)], [(row, -3)])]

    def grid(self, occupancy):
        return [([(occupancy.shape[0], 0)], [(occupancy.shape[0], 1)])]

    def linked(self, occupancy):
        row, col = self.find(occupancy, "100")
        first = ([(row, col)], [(row, col + 1)])
        again = labseq.Batch([(row, col + 2)], [(row, col + 1)], linked=True)
        return [first, again]


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("damaged", Damaged, Settings)
'''

RULES_OF = {  # damage -> the rules that may rightly be named first
    "straight": {"straight"},
    "source": {"source"},
    "goal": {"goal", "order"},
    "path": {"path"},
    "order": {"order"},
    "parallelism": {"parallelism"},
    "crossing": {"crossing", "parallelism"},
    "ejection": {"ejection", "grid"},
    "grid": {"grid"},
    "linked": {"linked"},
}


@pytest.mark.parametrize("damage", RULES_OF)
def test_a_damaged_plan_is_stopped_before_anything_plays(tmp_path, damage):
    sequence = SEQUENCE.replace("{use: mine}", f"{{use: damaged, damage: {damage}}}")
    path = with_plugin(tmp_path, DAMAGED, sequence)
    seen = RecordingObserver()
    with pytest.raises(InvalidPlanError) as caught:
        run(tmp_path, path, seed=1, observer=seen)
    assert caught.value.rule in RULES_OF[damage]
    assert caught.value.planner == "damaged"
    stages = [v["timing"].stage for v in seen.of("stage")]
    assert "check" in stages
    assert not {"prepare", "play"} & set(stages)
    safe = [v["device"] for v in seen.of("safe_state")]
    assert safe == ["mobile_tweezers", "shutter", "camera", "static_tweezers"]
    (index,) = (tmp_path / "data").glob("*/*/index.jsonl")
    (line,) = [json.loads(text) for text in index.read_text().splitlines()]
    assert line["status"] == "failed"
    assert caught.value.rule in line["error"]


@pytest.mark.parametrize(
    ("old", "new", "kind", "message"),
    [
        (
            "now, batches =",
            "raise KeyError('typo')\n        now, batches =",
            PlanError,
            "raised KeyError: 'typo'",
        ),
        ("return labseq.Plan.from_batches(batches)", "return batches", PlanError, "expected a Plan"),
        (
            "    def plan(",
            "    def warm(self):\n        raise SystemExit(0)\n\n    def plan(",
            PlanError,
            r"warm\(\) raised SystemExit: 0",
        ),
        (
            "def __init__(self, settings, context):",
            "def __init__(self, settings, context):\n        raise OSError('no')",
            labseq.PluginLoadError,
            "constructor of planner 'mine' raised OSError: no",
        ),
        (
            "def __init__(self, settings, context):",
            "def __init__(self, settings, context):\n        __import__('sys').exit(0)",
            labseq.PluginLoadError,
            "constructor of planner 'mine' raised SystemExit: 0",
        ),
        (
            "        self.degree_of_parallelism = 1\n",
            "        pass\n\n    degree_of_parallelism = property(lambda self: __import__('sys').exit(0))\n",
            labseq.PluginLoadError,
            "degree_of_parallelism raised SystemExit: 0",
        ),
        (
            "import labseq\n",
            "import labseq\nimport nothing_like_it\n",
            labseq.ConfigError,
            "nothing_like_it",
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
    assert list((tmp_path / "here" / ".active").iterdir()) == []


def test_a_detector_of_the_wrong_shape_stops_the_run(tmp_path):
    text = """
import numpy as np
import labseq
LABSEQ_API = 1

class Wrong:
    def __init__(self, settings, context): pass
    def detect(self, frame):
        return np.zeros((3, 3), bool), np.zeros((3, 3), np.float32)

@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.detector("wrong", Wrong)
"""
    path = with_plugin(tmp_path, text, SEQUENCE.replace("use: mine", "use: psca"))
    profile = (ROOT / "hardware_profiles" / "virtual.yaml").read_text(encoding="utf-8")
    start, end = profile.index("\ndetector:"), profile.index("\ndevices:")
    (tmp_path / "virtual.yaml").write_text(profile[:start] + "\ndetector: {use: wrong}\n" + profile[end:])
    with pytest.raises(DeviceError, match="the occupancy is bool"):
        run(tmp_path, path, seed=1)
