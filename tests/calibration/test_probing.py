"""Overlay and frequencies on the virtual lab: a hidden offset is found, used, and gone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq

PROFILE = """grid: {rows: 8, cols: 8, spacing: 4.49 um}
detector: {use: threshold, frame: [150, 200], centre_px: [74.5, 99.5]}
simulation:
  use: virtual
  mobile_light: {offset: [200 nm, -150 nm]}
  image: {frame: [150, 200], centre_px: [74.5, 99.5]}
"""
N_POINTS = 29
NO_FRAMES = ["record_frames=none"]  # the occupancies are enough
HIDDEN_M = np.array([200e-9, -150e-9])


def test_a_hidden_offset_is_found_and_corrected(tmp_path: Path, make_lab: Any) -> None:
    lab = make_lab(tmp_path, PROFILE)
    first = lab.calibrate("overlay", shots=N_POINTS, overrides=NO_FRAMES)
    overlay = first.stored.entry
    assert overlay.values["offset_m"] == pytest.approx(HIDDEN_M, abs=100e-9)
    assert overlay.quality["error_m"] < 50e-9
    assert first.stored.picture is not None
    again = lab.calibrate("overlay", seed=2, shots=N_POINTS, overrides=NO_FRAMES)
    assert again.stored.entry.values["offset_m"] == pytest.approx(HIDDEN_M, abs=100e-9)
    assert "in addition to the correction in use" in again.summary_lines[0]
    lab.store.use_none("overlay")  # the correction that was in use during the run counts
    assert lab.calibrate("overlay", source=again.run.path).stored.entry.id == again.stored.entry.id

    outcome = lab.calibrate("frequencies", seed=3, shots=N_POINTS, overrides=NO_FRAMES)
    entry = outcome.stored.entry
    assert entry.origin["calibrations"] == {"overlay": again.stored.entry.id}
    (warning,) = outcome.warnings
    assert warning.startswith(f"overlay {again.stored.entry.id} is no longer used")
    assert {*lab.store.active()} == {"frequencies"}
    grid = labseq.SiteGrid(8, 8)
    for hz, nominal_hz, hidden_m in (
        (entry.values["column_hz"], grid.column_frequency_hz, HIDDEN_M[0]),
        (entry.values["row_hz"], grid.row_frequency_hz, HIDDEN_M[1]),
    ):
        moved_m = (nominal_hz - hz) / 1.6e6 * 4.49e-6
        assert moved_m.mean() == pytest.approx(hidden_m, abs=100e-9)
        assert moved_m == pytest.approx(np.full(8, hidden_m), abs=150e-9)
    old = lab.calibrate("overlay", source=first.run.path)
    assert "other frequencies" in old.refused
    assert {*lab.store.active()} == {"frequencies"}
