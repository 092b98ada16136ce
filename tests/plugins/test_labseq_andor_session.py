"""Whole runs whose frames come through pylablib and the stand-in of Andor's SDK."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from labseq_andor.library import load_pylablib
from labseq_andor.settings import AndorSettings

from labseq import Run, Session

from .needs import need_library

ROOT = Path(__file__).parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"
VIRTUAL = ROOT / "hardware_profiles" / "virtual.yaml"
READOUT_S = AndorSettings().readout_s(None, (512, 512))


@pytest.fixture(autouse=True, scope="module")
def pylablib() -> None:
    need_library(lambda: load_pylablib("camera"))


def profile(folder: Path, **camera: Any) -> str:
    """``virtual`` with another camera."""
    parts = yaml.safe_load(VIRTUAL.read_text())
    parts["camera"] = {"use": "andor", "em_gain": 300, **camera}
    path = folder / "bench_andor.yaml"
    path.write_text(yaml.safe_dump(parts))
    return str(path)


def run(output: Path, profile: str, *overrides: str, dry_run: Any = "off") -> Run:
    with Session.open(
        SEQUENCE, profile=profile, shots=2, seed=1, output=output, overrides=overrides, dry_run=dry_run
    ) as session:
        return session.run()


def assert_equal(one: Run, other: Run) -> None:
    for a, b in zip(one.shots, other.shots, strict=True):
        np.testing.assert_array_equal(a.occupancies, b.occupancies)


def test_the_whole_experiment_sees_what_the_virtual_camera_sees(tmp_path: Path) -> None:
    andor = run(tmp_path, profile(tmp_path, camera="simulated"))
    assert andor.simulated
    assert_equal(andor, run(tmp_path, "virtual", f"profile.camera.readout={READOUT_S}"))


def test_a_dry_run_with_a_real_cameras_profile_takes_the_simulated_one(tmp_path: Path) -> None:
    real = profile(tmp_path, serial=4711, model="DU-897", cooling={"temperature": "-70 degC"})
    done = run(tmp_path, real, dry_run="full")
    assert done.simulated
    described = done.record["devices"]["camera"]
    assert (described["serial_number"], described["setpoint_k"]) == ("10001", pytest.approx(203.15))
