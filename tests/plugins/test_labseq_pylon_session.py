"""Whole runs whose frames come through pylon."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from labseq_pylon.library import load_pypylon

from labseq import Run, Session
from labseq.session.profile import DryRun

from .needs import need_library

ROOT = Path(__file__).parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"
VIRTUAL = ROOT / "hardware_profiles" / "virtual.yaml"


@pytest.fixture(autouse=True, scope="module")
def pypylon() -> None:
    need_library(lambda: load_pypylon("camera"))


def profile(folder: Path, camera: str) -> str:
    """``virtual`` with another camera."""
    text = VIRTUAL.read_text().replace("camera:\n  use: virtual\n", f"camera:\n  use: pylon\n{camera}", 1)
    assert "use: pylon" in text
    plugins = folder / "plugins"
    plugins.mkdir()
    (plugins / "labseq_pylon").symlink_to(ROOT / "plugins" / "labseq_pylon")
    path = folder / "bench_pylon.yaml"
    path.write_text(text.replace("plugin_folders: []", f"plugin_folders: [{plugins}]"))
    return str(path)


def run(tmp_path: Path, profile: str, *overrides: str, dry_run: DryRun = "off") -> Run:
    with Session.open(
        SEQUENCE, profile=profile, shots=2, seed=1, output=tmp_path, overrides=overrides, dry_run=dry_run
    ) as session:
        return session.run()


def assert_equal(one: Run, other: Run) -> None:
    for a, b in zip(one.shots, other.shots, strict=True):
        np.testing.assert_array_equal(a.occupancies, b.occupancies)


def test_the_whole_experiment_sees_what_the_virtual_camera_sees(tmp_path: Path) -> None:
    virtual = run(tmp_path, "virtual")
    emulated = run(tmp_path, profile(tmp_path, "  camera: simulated\n"))
    assert emulated.simulated
    assert_equal(emulated, virtual)


def test_a_dry_run_with_a_real_cameras_profile_takes_the_emulated_one(tmp_path: Path) -> None:
    cut = (
        "profile.camera.region={y: 20, x: 6, height: 472, width: 500}",
        "profile.camera.readout=0 ms",
        "profile.detector.frame=[472, 500]",
        "profile.detector.centre_px=[235.5, 249.5]",
    )
    real = profile(tmp_path, "  camera: 22345678\n  model: acA1920-40um\n")
    done = run(tmp_path, real, *cut, dry_run="full")
    assert done.simulated
    assert_equal(done, run(tmp_path, "virtual", *cut))
