"""Where the sites of a recorded run are on its frames."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.analysis.overview import grid_of, sites_of
from labseq.calibration_store import encode_entry
from labseq.data.reader import Run, open_run
from labseq.model import CalibrationEntry, SiteGrid
from labseq.model.calibration import grid_facts
from labseq.recording.schema import RUN_FORMAT_VERSION

Floats = NDArray[np.float64]

DETECTOR: dict[str, Any] = {
    "sites": None,
    "frame": [512, 512],
    "centre_px": [255.5, 255.5],
    "pixel_size": 4e-7,
    "angle": 0.0,
}


def run_at(folder: Path, resolved: dict[str, Any], **changes: Any) -> Run:
    """A run of 2 x 3 sites that says no more than it must."""
    record = {
        "format": "labseq-run",
        "format_version": RUN_FORMAT_VERSION,
        "name": "x",
        "n_shots": 0,
        "seed": 1,
        "simulated": True,
        "target": {"name": "all", "fill": ["111", "111"], "clear": ["000", "000"]},
        "lattice": "triangular",
        "grid_spacing_m": 4e-6,
        "resolved": resolved,
    }
    (folder / "run.json").write_text(json.dumps(record | changes), "utf-8")
    return open_run(folder)


def test_the_grid_is_that_of_the_recorded_profile(tmp_path: Path) -> None:
    grid = grid_of(run_at(tmp_path, {"profile": {"grid": {"shear": -1}}}))
    assert (grid.shape, grid.spacing_m, grid.lattice, grid.shear) == ((2, 3), 4e-6, "triangular", -1)
    assert grid_of(run_at(tmp_path, {}, lattice="square")).lattice == "square"


@pytest.mark.parametrize("odd", [None, {"profile": 3}, {"profile": {"grid": []}}])
def test_a_record_that_tells_nothing_has_a_grid_and_no_sites(tmp_path: Path, odd: Any) -> None:
    run = run_at(tmp_path, odd, grid_spacing_m=None)
    assert grid_of(run).shape == (2, 3)
    assert sites_of(run) is None


def test_sites_are_where_the_detectors_settings_put_them(tmp_path: Path) -> None:
    sites = sites_of(run_at(tmp_path, {"profile": {"detector": DETECTOR}}))
    assert sites is not None
    assert sites.frame == (512, 512)
    assert np.diff(sites.positions_px[0], axis=0).tolist() == [pytest.approx([0, 10])] * 2


def test_the_calibration_copied_into_the_run_counts_before_the_settings(tmp_path: Path) -> None:
    rows, cols = np.indices((2, 3))
    positions: Floats = 10.0 * np.stack([rows + 1, cols + 1], axis=-1).astype(np.float64)
    facts = grid_facts(SiteGrid(2, 3, spacing_m=4e-6))
    values: dict[str, Floats] = {"positions_px": positions, "frame": np.array([64.0, 96.0])}
    entry = CalibrationEntry("sites", values, {}, facts, {}, "2026-11-20T08:00:00+00:00")
    (tmp_path / "calibration_sites.json").write_bytes(encode_entry(entry))
    sites = sites_of(run_at(tmp_path, {"profile": {"detector": DETECTOR}}))
    assert sites is not None
    assert sites.frame == (64, 96)
    assert sites.positions_px.tolist() == positions.tolist()


@pytest.mark.parametrize("damage", ["calibration", "file"])
def test_what_cannot_be_read_is_not_known(tmp_path: Path, damage: str) -> None:
    detector = DETECTOR | ({"sites": str(tmp_path / "gone.csv")} if damage == "file" else {})
    if damage == "calibration":
        (tmp_path / "calibration_sites.json").write_text("{}")
    assert sites_of(run_at(tmp_path, {"profile": {"detector": detector}})) is None
