"""Amplitudes of the mobile tweezers, measured with a second camera and used by the tone program."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_virtual.formulas import full_amplitudes
from labseq_virtual.mobile_light import with_true_response
from labseq_virtual.settings import MobileLightSettings
from numpy.typing import NDArray

import labseq
from labseq.assembly.profile import resolve_profile
from labseq.config.profile import load_profile
from labseq.errors import ConfigError, LabseqError
from labseq.model import Plan, SegmentKind

PROFILE = """grid: {rows: 8, cols: 10, spacing: 4.49 um}
detector: {use: threshold, frame: [150, 240], centre_px: [74.5, 119.5]}
devices:
  trap_camera:
    use: virtual
    role: camera
    region: {y: 150, x: 100, height: 212, width: 312}
    faults: {transient: 10 %}
  meter: {use: virtual_spot_meter}
simulation:
  use: virtual
  machine_seed: 5
  mobile_light: {tone_response: 14 %}
  image: {frame: [150, 240], centre_px: [74.5, 119.5]}
"""


def true_depths(profile: Path) -> NDArray[np.float64]:
    """Depths of mobile tweezers on all sites, by the program that a move gets and the lab's own response."""
    _, spec = load_profile(str(profile))
    grid, light = spec.grid_model(), MobileLightSettings(tone_response=0.14)
    full = full_amplitudes(grid, with_true_response(grid, spec.motion, light, 5))
    used = resolve_profile(str(profile))
    power = np.empty(grid.shape)
    for row, col in np.ndindex(*grid.shape):
        plan = Plan.from_batches([([(row, col)], [(row, col - 1 if col else col + 1)])])
        program = labseq.tone_program(plan, used.grid, used.motion)
        moving = int(np.flatnonzero(program.kind == SegmentKind.TRANSPORT)[0])
        tones = program.tones_at(float(program.joint_s[moving]))
        of_row, of_col = tones.row.amplitude[0] / full[0][row], tones.column.amplitude[0] / full[1][col]
        power[row, col] = (of_row * of_col) ** 2
    return power / power.mean()


def test_amplitudes_measured_on_frames_make_the_depths_of_moves_equal(tmp_path: Path, make_lab: Any) -> None:
    lab = make_lab(tmp_path, PROFILE)
    assert np.std(true_depths(lab.profile)) > 0.14
    outcome = lab.calibrate("amplitudes")
    assert outcome.refused == ""
    assert np.std(true_depths(lab.profile)) < 0.006
    assert "rows and columns are equal to 0." in outcome.summary_lines[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            "profile.mobile_tweezers.max_column_tones=9",
            "number of column tones to measure at once is 10",
        ),
        ("shot.0.equalise.device=meter", "'meter' is not a camera; choose a camera for mobile tweezers"),
    ],
)
def test_what_cannot_be_measured_is_refused(change: str, message: str, tmp_path: Path, make_lab: Any) -> None:
    lab = make_lab(tmp_path, PROFILE)
    with pytest.raises((ConfigError, LabseqError), match=message):
        lab.calibrate("amplitudes", overrides=[change])
