"""A scan of 3 x 4 points, twice each: exported, compared with the files read by plain h5py."""

from __future__ import annotations

import csv
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

import labseq
from labseq.cli.app import app
from tests.session.small_runs import PROFILE

pytestmark = pytest.mark.system

FOLDER = Path(__file__).parents[2]
DOPS, WINDOWS_S = (1, 2, 4), (0.005, 0.01, 0.02, 0.06)
SEQUENCE = """
labseq: 1
name: grid scan
profile: ./profile.yaml
seed: 3
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: psca}
scan:
  planner.degree_of_parallelism: [1, 2, 4]
  shot.2.rearrange.window: [5 ms, 10 ms, 20 ms, 60 ms]
repeats: 2
order: shuffled
record_frames: none
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1}
  - image: {exposure: 45 ms}
"""


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("grid")
    (folder / "profile.yaml").write_text(PROFILE, encoding="utf-8")
    (folder / "sequence.yaml").write_text(SEQUENCE, encoding="utf-8")
    with labseq.Session.open(folder / "sequence.yaml", output=folder / "data") as session:
        return session.run().path


def test_every_point_was_taken_twice(run_dir: Path) -> None:
    taken = [tuple(shot.parameters.values()) for shot in labseq.open_run(run_dir).shots]
    assert sorted(taken) == sorted([*itertools.product(DOPS, WINDOWS_S)] * 2)


def test_the_exported_table_agrees_with_the_files(run_dir: Path, tmp_path: Path) -> None:
    target = tmp_path / "table.csv"
    result = CliRunner().invoke(app, ["export", str(run_dir), "--to", "csv", "--output", str(target)])
    assert result.exit_code == 0, result.output
    with target.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert len(rows) == 24
    for row in rows:
        with h5py.File(run_dir / row["file"], "r") as file:
            shot = cast("Mapping[str, Any]", file)
            seen = shot["entry/detection/occupancy"][-1].astype(bool)
            fill = shot["entry/target/fill"][:].astype(bool)
            batches = shot["entry/rearrangement/cycles"][:]
            changed = json.loads(shot["entry/parameters"][()])
        assert float(row["filling_fraction"]) == pytest.approx(seen[fill].mean())
        assert int(row["n_defects"]) == np.count_nonzero(~seen[fill])
        assert int(row["n_batches"]) == batches["n_batches_played"].sum()
        for address, value in changed.items():
            assert float(row[address]) == value
