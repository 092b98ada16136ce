"""Whole runs of a planner whose batches move rows and columns at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.assembly.planning import PlanRequest, plan_moves
from labseq.errors import ConfigError
from labseq.plain import to_plain
from labseq.plans.plan import PlanReport
from labseq.plans.plan_file import parse_plan

PLANNER = """
from itertools import combinations

import numpy as np

from labseq.plugin import Batch, Plan, hookimpl
from labseq.plugin.motion import TonePaths

LABSEQ_API = 1


class Lanes:
    '''Fills vacancies by two rows and two columns at once, through lanes, or else one by one.'''

    degree_of_parallelism = 4

    def __init__(self, settings, context):
        pass

    def plan(self, occupancy, target):
        atoms, batches = occupancy.copy(), []
        while (batch := self.batch(atoms, target)) is not None:
            batches.append(batch)
            atoms[tuple(batch.from_sites.T)] = False
            atoms[tuple(batch.to_sites.T)] = True
        return Plan.from_batches(batches)

    def batch(self, atoms, target):
        spare, wanted = atoms & ~target.fill, target.fill & ~atoms
        for n in (2, 1):
            lines = [np.array(list(combinations(range(size), n))) for size in atoms.shape]
            rows = np.repeat(lines[0], len(lines[1]), axis=0)[:, :, None]  # of each block of n x n sites
            columns = np.tile(lines[1], (len(lines[0]), 1))[:, None, :]
            moved = atoms[rows, columns]
            can_go = (moved == spare[rows, columns]).all(axis=(1, 2)) & (moved.sum(axis=(1, 2)) >= n)
            for k in np.flatnonzero(can_go):
                fits = np.where(moved[k], wanted[rows, columns], ~moved).all(axis=(1, 2))
                if fits.any():
                    goal = int(fits.argmax())
                    return self.through_lanes(rows[k], columns[k], rows[goal], columns[goal], moved[k])
        return None

    def through_lanes(self, *lines_and_moved):
        *lines, moved = lines_and_moved
        s, p, d, q = (one.ravel().astype(float) for one in lines)
        row = np.array([s, s + 0.5, s + 0.5, d + 0.5, d + 0.5, d])
        column = np.array([p, p, q + 0.5, q + 0.5, q, q])
        sites = [np.stack(np.broadcast_arrays(*one), axis=-1)[moved] for one in (lines[:2], lines[2:])]
        return Batch(*sites, tones=TonePaths(row, column))


@hookimpl
def labseq_register(registry):
    registry.planner("lanes", Lanes)
"""
SEQUENCE = """
labseq: 1
name: lanes
plugin_folders: [plugins]
profile: bench_awg
shots: 1
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: lanes}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1, window: 60 ms, exposure: 45 ms}
"""
MOBILE = "profile.mobile_tweezers"
SMALL = (
    "profile.grid.rows=5",
    "profile.grid.cols=5",
    "profile.simulation.loading=60 %",
    "profile.simulation.transport_loss=0 %",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("lanes")
    (found / "plugins").mkdir()
    (found / "plugins" / "lanes.py").write_text(PLANNER, encoding="utf-8")
    (found / "s.yaml").write_text(SEQUENCE, encoding="utf-8")
    return found


@pytest.mark.parametrize(
    ("profile", "overrides"),
    [
        ("virtual", ()),
        ("bench_awg", (f"{MOBILE}.mode=replay",)),
        ("bench_awg", (f"{MOBILE}.mode=sequence",)),
        ("bench_awg", (f"{MOBILE}.mode=stream",)),
    ],
    ids=["virtual", "replay", "sequence", "stream"],
)
def test_atoms_end_where_the_plan_says(folder: Path, profile: str, overrides: tuple[str, ...]) -> None:
    """On the simulation of the program, and of the samples that the card played."""
    with labseq.Session.open(
        folder / "s.yaml", profile=profile, seed=1, output=folder / "runs", overrides=(*SMALL, *overrides)
    ) as session:
        run = session.run()
    shot = run.shots[0]
    record = shot.record()
    cycle = record.cycles[0]
    assert cycle.n_batches_played == cycle.plan.n_batches >= 2
    assert max(cycle.report.n_tweezers) == 4
    assert cycle.plan.n_atom_moves > cycle.plan.n_batches
    assert record.images[-1].occupancy.tolist() == cycle.report.predicted.tolist()
    assert cycle.plan.is_same(shot.plans[0])
    if profile == "bench_awg":
        flights = shot.atom_events["flights"]
        assert set(flights["fate"].tolist()) == {b"kept"}
        assert flights["offset_m"].max() < 5e-9
        assert len(shot.atom_events["jumps"]) == 0


def test_what_labseq_plan_writes_is_read_again(folder: Path) -> None:
    request = PlanRequest("random:5x5@0.6", str(folder / "s.yaml"), planner="lanes", seed=1)
    moves = plan_moves(request)
    values: dict[str, Any] = to_plain(PlanReport.of(moves))
    assert parse_plan(json.dumps(values).encode(), "plan.json").plan.is_same(moves.plan)
    tones = values["batches"][0]["tones"]
    for words, key, wrong in (
        ("row_off must have knots from 1", "row_off", [9 for _ in tones["row_off"]]),
        ("column has shape", "column", tones["column"][1:]),
    ):
        values["batches"][0]["tones"] = tones | {key: wrong}
        with pytest.raises(ConfigError, match=words):
            parse_plan(json.dumps(values).encode(), "plan.json")
