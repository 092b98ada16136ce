"""The overlay of the mobile tweezers on the sites, measured on the virtual lab by ordinary sequences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.builtin.overlay import fit_overlay, overlay_offset
from labseq.errors import ConfigError
from labseq.model import SiteGrid
from labseq.testing.fakes import RecordingObserver

ROOT = Path(__file__).parents[2]
HEAD = """labseq: 1
name: overlay
profile: virtual
seed: 3
record_frames: none
target: {pattern: compact, rows: 10, cols: 10}
"""
SHOT = """shot:
  - load: {duration: 500 ms}
  - image: {}
"""


def run(folder: Path, text: str, offset_um: tuple[float, float], **options: Any) -> labseq.Run:
    path = folder / "s.yaml"
    path.write_text(HEAD + text)
    profile = str(ROOT / "hardware_profiles" / "virtual.yaml")
    light = f"profile.simulation.mobile_light={{offset: [{offset_um[0]} um, {offset_um[1]} um]}}"
    with labseq.Session.open(path, profile=profile, overrides=[light], output=folder, **options) as session:
        return session.run()


def test_a_scan_of_the_probe_finds_the_true_offset(tmp_path: Path) -> None:
    along = np.linspace(-1.4, 1.4, 9).round(3)
    points = [(x, 0.0) for x in along] + [(0.0, y) for y in along if y]
    listed = ", ".join(f"[{x} um, {y} um]" for x, y in points)
    text = f"scan:\n  shot.2.probe.offset: [{listed}]\n{SHOT}  - probe: {{}}\n  - image: {{}}\n"
    done = run(tmp_path, text, (0.2, -0.15))
    offset, before, survived = [], [], []
    for shot in done.shots:
        first, last = shot.occupancies
        offset.append(shot.parameters["shot.2.probe.offset"])
        before.append(first.sum())
        survived.append((first & last).sum())
    fit = fit_overlay(offset, before, survived, SiteGrid())
    assert fit.error_m.max() < 40e-9
    assert overlay_offset(fit.centre_m) == pytest.approx([0.2e-6, -0.15e-6], abs=3 * fit.error_m.max())


@pytest.mark.parametrize("offset_um", [(0.0, 0.0), (0.3, 0.0)])
def test_a_check_of_the_overlay_finds_a_shift(tmp_path: Path, offset_um: tuple[float, float]) -> None:
    observer = RecordingObserver()
    text = f"shots: 3\n{SHOT}  - check_overlay: {{every: 2}}\n"
    done = run(tmp_path, text, offset_um, observer=observer)
    checked = [shot.readings for shot in done.shots if "overlay.error_m" in shot.readings]
    assert len(checked) == 2
    for readings in checked:
        found = [readings["overlay.along_row_m"], readings["overlay.row_to_row_m"]]
        assert found == pytest.approx(np.array(offset_um) * 1e-6, abs=4 * readings["overlay.error_m"])
    warned = [w for w in observer.of("warning") if "calibrate overlay" in w["text"]]
    assert len(warned) == (2 if any(offset_um) else 0)


def test_sites_are_checked_on_the_frames_of_the_run(tmp_path: Path) -> None:
    observer = RecordingObserver()
    text = f"shots: 1\n{SHOT}  - check_sites: {{}}\n"
    done = run(tmp_path, text, (0.0, 0.0), observer=observer)
    readings = done.shots[0].readings
    assert abs(readings["sites.shift_y_px"]) < 0.1
    assert abs(readings["sites.shift_x_px"]) < 0.1
    assert not [w for w in observer.of("warning") if "sites" in w["text"]]


@pytest.mark.parametrize("step", ["probe", "check_sites", "check_overlay"])
def test_a_step_that_has_no_image_before_it_is_refused_with_its_place(tmp_path: Path, step: str) -> None:
    text = f"shots: 1\nshot:\n  - load: {{}}\n  - {step}: {{}}\n  - image: {{}}\n"
    with pytest.raises(ConfigError, match=rf"s.yaml:10:5: '{step}' needs an image before it in the shot"):
        run(tmp_path, text, (0.0, 0.0))
