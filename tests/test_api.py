"""Planners, targets and tone programs by name, and what is said of wrong arguments."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.errors import ConfigError

PLUGIN = """
from labseq.plugin import hookimpl
LABSEQ_API = 1

class Mine:
    def __init__(self, settings, context): pass
    def plan(self, occupancy, target): return None

@hookimpl
def labseq_register(registry):
    registry.planner("mine", Mine)
"""


@pytest.mark.parametrize("name", [None, 5, ["psca"]])
def test_a_name_is_text(name: Any):
    with pytest.raises(ConfigError, match="the name of the planner is"):
        labseq.make_planner(name)
    with pytest.raises(ConfigError, match="the name of the pattern is"):
        labseq.make_target(name)


@pytest.mark.parametrize("grid", [20, (0, 5), (20, 20, 20), (20.0, 20.0), (10**6, 10**6)])
def test_a_grid_is_a_grid_or_a_size(grid: Any):
    with pytest.raises(ConfigError, match=r"grid is .*; expected .*\(n_rows, n_cols\)"):
        labseq.make_target("compact", rows=5, cols=5, grid=grid)
    with pytest.raises(ConfigError, match="grid is "):
        labseq.make_planner("psca", grid=grid)


def test_a_planner_takes_the_size_of_a_grid():
    planner = labseq.make_planner("psca", grid=(12, 10), degree_of_parallelism=np.int64(3))
    target = labseq.make_target("compact", rows=4, cols=4, grid=np.zeros((12, 10)).shape)
    occupancy = np.random.default_rng(1).random((12, 10)) < 0.75
    plan = planner.plan(occupancy, target)
    report = labseq.check_plan(plan, occupancy, target, 3, labseq.SiteGrid(12, 10))
    assert report.meets_target


def test_half_of_a_character_is_no_setting():
    with pytest.raises(ConfigError, match=r"'#\\ud800' contains half a character"):
        labseq.make_target("bitmap", sites="#\ud800")


@pytest.mark.parametrize("kind", [str, Path, lambda folder: [folder]])
def test_one_plugin_folder_or_several(tmp_path: Path, kind: Any):
    (tmp_path / "mine.py").write_text(PLUGIN)
    assert labseq.make_planner("mine", plugin_folders=kind(tmp_path))


def test_a_tone_program_for_the_machine_of_a_profile():
    plan = labseq.Plan.from_batches([([(0, 0)], [(0, 3)])])
    paused = labseq.MotionSpec(overhead_per_batch_s=0.5e-3)
    program, same = labseq.tone_program(plan, profile="virtual"), labseq.tone_program(plan, motion=paused)
    assert program.column.end_hz.tolist() == same.column.end_hz.tolist()
    assert program.duration_s.tolist() == same.duration_s.tolist()
    bare = labseq.tone_program(plan, motion=labseq.MotionSpec(), profile="virtual")
    assert bare.n_segments == program.n_segments - 1
    with pytest.raises(ConfigError, match="there is no hardware profile 'virtuel'"):
        labseq.tone_program(plan, profile="virtuel")
