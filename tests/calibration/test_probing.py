"""Overlay and frequencies on the virtual lab: a hidden offset is found, used, and gone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.calibration.measure import METHODS, CalibrationRequest, Outcome, calibrate
from labseq.calibration.store import Store
from labseq.errors import ConfigError, DeviceError
from labseq.session import assemble

PROFILE = """labseq: 1
name: beside
grid: {rows: 8, cols: 8, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold, frame: [150, 200], centre_px: [74.5, 99.5]}
simulation:
  use: virtual
  mobile_light: {offset: [200 nm, -150 nm]}
  image: {frame: [150, 200], centre_px: [74.5, 99.5]}
"""
N_POINTS = 29
HIDDEN_M = np.array([200e-9, -150e-9])


class Lab:
    """A profile whose mobile tweezers stand beside the sites."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.profile = folder / "beside.yaml"
        self.profile.write_text(PROFILE, "utf-8")
        self.store = Store(folder / "calibrations" / "beside")

    def calibrate(self, kind: str, seed: int = 1, **changes: Any) -> Outcome:
        request = CalibrationRequest(str(self.profile), output=self.folder / "data", seed=seed, **changes)
        return calibrate(METHODS[kind], request)


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path)


def test_a_hidden_offset_is_found_and_undone(lab: Lab) -> None:
    first = lab.calibrate("overlay", shots=N_POINTS)
    assert first.stored.entry.values["offset_m"] == pytest.approx(HIDDEN_M, abs=100e-9)
    assert first.stored.entry.quality["error_m"] < 50e-9
    assert first.stored.picture is not None
    again = lab.calibrate("overlay", seed=2, shots=N_POINTS)
    assert again.stored.entry.values["offset_m"] == pytest.approx(HIDDEN_M, abs=100e-9)
    assert "beyond the correction of the overlay in use" in again.summary_lines[0]
    lab.store.use_none("overlay")
    for outcome in (again, first):  # whatever is in use now, what was in use then counts
        assert outcome.run is not None
        repeated = lab.calibrate("overlay", source=outcome.run.path)
        assert repeated.stored.entry.id == outcome.stored.entry.id


def test_frequencies_hold_the_offset_and_put_the_overlay_aside(lab: Lab) -> None:
    first = lab.calibrate("overlay", shots=N_POINTS)
    overlay, run = first.stored.entry, first.run
    outcome = lab.calibrate("frequencies", seed=2, shots=2 * N_POINTS)
    entry = outcome.stored.entry
    assert entry.origin["calibrations"] == {"overlay": overlay.id}
    assert outcome.warnings == (
        f"overlay {overlay.id} is no longer used: these frequencies include its correction",
    )
    assert {*lab.store.active()} == {"frequencies"}
    step_hz_per_m = 1.6e6 / 4.49e-6
    own = labseq.SiteGrid(8, 8)
    for hz, own_hz, hidden_m in (
        (entry.values["column_hz"], own.column_frequency_hz, HIDDEN_M[0]),
        (entry.values["row_hz"], own.row_frequency_hz, HIDDEN_M[1]),
    ):
        moved_m = (own_hz - hz) / step_hz_per_m
        assert moved_m.mean() == pytest.approx(hidden_m, abs=100e-9)
        assert moved_m == pytest.approx(np.full(8, hidden_m), abs=150e-9)
    assert run is not None
    old = lab.calibrate("overlay", source=run.path)
    assert old.refused == "it was measured with other frequencies of the mobile tweezers"
    assert {*lab.store.active()} == {"frequencies"}
    left = lab.calibrate("overlay", seed=3, shots=N_POINTS).stored.entry
    assert left.origin["calibrations"] == {"frequencies": entry.id}
    assert left.values["offset_m"] == pytest.approx([0.0, 0.0], abs=100e-9)


def test_tweezers_that_are_off_give_no_bump(lab: Lab) -> None:
    with pytest.raises(DeviceError, match="no overlay found: "):
        lab.calibrate(
            "overlay", shots=N_POINTS, overrides=["profile.simulation.mobile_light.offset=[5 um, 0 um]"]
        )
    assert lab.store.entries() == []


def test_a_run_without_a_probe_is_refused(lab: Lab) -> None:
    run = lab.calibrate("sites", shots=10).run
    assert run is not None
    for kind in ("overlay", "frequencies"):
        with pytest.raises(ConfigError, match="the run does not scan the offset of a probe"):
            lab.calibrate(kind, source=run.path)
        with pytest.raises(ConfigError, match=f"a calibration of {kind} cannot be made from a file"):
            lab.calibrate(kind, source=lab.folder / "x.npy")


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_every_sequence_can_be_run_on_every_profile_with_virtual_devices(method: Any) -> None:
    assembly = assemble(method.sequence, profile="practice" if method.kind == "tweezers" else "virtual")
    assert assembly.sequence.name == f"calibrate-{method.kind}"
    assert assembly.sequence.record_frames == ("none" if method.kind == "tweezers" else "all")
    assert not assembly.warnings
