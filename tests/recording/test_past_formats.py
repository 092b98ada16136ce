"""Runs of every past version of the formats are read; ``old_runs.py`` made them with labseq of their time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.analysis.statistics import statistics_of
from labseq.recording import Shot, open_run
from labseq.recording.reader import scan_points
from labseq.recording.schema import FORMAT_VERSION
from labseq.recording.shot import read_content

from .old_runs import a_run, a_shot

Same = Callable[[Any, Any], None]

DATA = Path(__file__).parent / "data"
VERSIONS = sorted(path.name.removeprefix("shot_") for path in DATA.iterdir())


def written_by(version: str, index: int) -> Any:
    """The record as far as labseq of that version could write it."""
    shot, minor = a_shot(index), int(version.partition(".")[2])
    if minor < 1:
        shot.atom_events = {}
    if minor < 2:
        shot.calibrations = {}
    if minor < 3:
        shot.images = [
            dataclasses.replace(
                one, frame=dataclasses.replace(one.frame, number=0, device_time_s=float("nan"))
            )
            for one in shot.images
            if one.frame is not None
        ]
    return shot


def test_there_is_a_run_of_every_version() -> None:
    newest = int(FORMAT_VERSION.partition(".")[2])
    assert [f"1.{minor}" for minor in range(newest + 1)] == VERSIONS


@pytest.mark.parametrize("version", VERSIONS)
def test_a_run_of_a_past_version_is_read(version: str, assert_same: Same) -> None:
    run = open_run(DATA / f"shot_{version}")
    assert (run.status, run.name, run.seed, run.n_shots, run.n_damaged_lines) == (
        "complete",
        "old µ",
        7,
        2,
        0,
    )
    assert_same(run.target, a_run().target)
    assert [shot.index for shot in run.shots] == [0, 1]
    for shot in run.shots:
        shot.verify()
        assert_same(shot.record(), written_by(version, shot.index))
        assert shot.frames.shape == (3, 3, 4)
        assert shot.provenance["sequence"] == a_run().sequence_text
        assert shot.devices["camera"] == {"model": "EMCCD"}


@pytest.mark.parametrize("version", VERSIONS)
def test_a_run_of_a_past_version_is_summed_up(version: str) -> None:
    run = open_run(DATA / f"shot_{version}")
    found = statistics_of(run.shots, run.target)
    assert (found.defect_free.n, found.defect_free.n_trials, found.unreadable) == (2, 2, ())
    assert [(cycle.cycle, cycle.n_shots, cycle.n_atom_moves.value) for cycle in found.cycles] == [(1, 2, 1.0)]
    points = [dict(point.parameters) for point in scan_points(run)]
    assert points == ([] if version < "1.2" else [{"shot.1.rearrange.window": w} for w in (0.06, 0.09)])


@pytest.mark.parametrize("version", VERSIONS)
def test_the_target_of_a_past_version_is_read(version: str) -> None:
    shot: Shot = open_run(DATA / f"shot_{version}").shots[0]
    np.testing.assert_array_equal(read_content(shot.file).target.fill, a_run().target.fill)
