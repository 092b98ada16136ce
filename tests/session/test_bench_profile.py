"""The bench of real drivers: each on its simulated counterpart, all of them in one simulated world."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from labseq_genicam.aravis.library import library

from labseq import Run, Session
from labseq.cli import main
from tests.plugins.needs import need_library

SEQUENCE = Path(__file__).parents[2] / "sequences" / "compact_225.yaml"


@pytest.fixture(autouse=True, scope="module")
def aravis() -> None:
    need_library(library)


def run(tmp_path: Path, profile: str, shots: int = 2) -> Run:
    with Session.open(SEQUENCE, profile=profile, shots=shots, seed=1, output=tmp_path) as session:
        return session.run()


def test_frames_through_gige_vision_are_those_of_the_virtual_camera_and_so_is_the_run(tmp_path: Path) -> None:
    bench, expected = run(tmp_path, "bench"), run(tmp_path, "bench_awg")
    assert bench.simulated
    for shot, other in zip(bench.shots, expected.shots, strict=True):
        np.testing.assert_array_equal(shot.frames, other.frames)
        np.testing.assert_array_equal(shot.occupancies, other.occupancies)
        assert shot.story["flights"].tobytes() == other.story["flights"].tobytes()


def test_every_device_of_the_bench_answers_and_passes_its_self_test(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["devices", "bench", "--json"])
    devices = {device["name"]: device for device in json.loads(capfd.readouterr().out)["devices"]}
    assert devices["camera"]["serial_number"] == "SIM1"
    assert all(device["ok"] for device in devices.values())
