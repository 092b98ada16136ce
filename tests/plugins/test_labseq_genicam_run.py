"""Whole runs whose frames come through GigE Vision, and what users see of them when the camera fails."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from labseq_genicam.aravis.library import library

from labseq import Run, Session
from labseq.cli import main

from .needs import need_library

ROOT = Path(__file__).parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"
VIRTUAL = ROOT / "hardware_profiles" / "virtual.yaml"


@pytest.fixture(autouse=True, scope="module")
def aravis() -> None:
    need_library(library)


def profile(folder: Path, **camera: Any) -> Path:
    """``virtual`` with another camera."""
    parts = yaml.safe_load(VIRTUAL.read_text())
    parts["camera"] = {"use": "genicam", "camera": "simulated", "frame_timeout": "50 ms", **camera}
    path = folder / "cameras.yaml"
    path.write_text(yaml.safe_dump(parts))
    return path


def run(output: Path, profile: str, *overrides: str, shots: int = 1, dry_run: Any = "off") -> Run:
    with Session.open(
        SEQUENCE, profile=profile, shots=shots, seed=1, output=output, overrides=overrides, dry_run=dry_run
    ) as session:
        return session.run()


def failing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], **camera: Any
) -> tuple[int, str, list[dict[str, Any]]]:
    """Exit code of ``labseq run``, what it says, and what it logs."""
    output = tmp_path / "data"
    command = ["run", str(SEQUENCE), "--profile", str(profile(tmp_path, **camera)), "--shots", "2", "--seed"]
    with pytest.raises(SystemExit) as left:
        main([*command, "1", "--output", str(output)])
    logs = [line for log in output.glob("*/*/events.jsonl") for line in log.read_text().splitlines()]
    assert isinstance(left.value.code, int)
    return left.value.code, capfd.readouterr().err, [json.loads(line) for line in logs]


def of(events: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    return [event["values"] for event in events if event["event"] == name]


def test_a_dry_run_with_a_real_cameras_profile_takes_the_simulated_one(tmp_path: Path) -> None:
    cut = (
        "profile.camera.region={y: 20, x: 6, height: 472, width: 500}",
        "profile.camera.readout=0 ms",
        "profile.detector.frame=[472, 500]",
        "profile.detector.centre_px=[235.5, 249.5]",
    )
    real = profile(tmp_path, camera="192.168.7.2", model="BFS-PGE-50S5M", serial="23456789")
    done = run(tmp_path, str(real), *cut, dry_run="full")
    assert done.simulated
    assert done.record["devices"]["camera"]["serial_number"] == "SIM1"
    virtual = run(tmp_path, "virtual", *cut)
    for shot, expected in zip(done.shots, virtual.shots, strict=True):
        np.testing.assert_array_equal(shot.occupancies, expected.occupancies)


def test_a_shot_with_a_lost_frame_is_repeated(tmp_path: Path) -> None:
    done = run(tmp_path, str(profile(tmp_path, faults={"failed_frames": [1]})))
    assert done.status == "complete"
    (log,) = tmp_path.glob("*/*/events.jsonl")
    events = [json.loads(line) for line in log.read_text().splitlines()]
    (repeated,) = of(events, "shot_repeated")
    assert "camera: frame 1 was lost, of a series of 1:" in str(repeated)
    assert "some of its network packets are missing" in str(repeated)


def test_when_packets_are_lost_the_shot_is_repeated_and_then_the_run_ends_safely(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """2 % of 360 packets: no frame comes whole."""
    code, said, events = failing(tmp_path, capfd, packet_size=1500, faults={"packet_loss": 0.02})
    assert code == 3
    assert "camera: frame 1 was lost, of a series of 1:" in said
    assert "some of its network packets are missing" in said
    assert len(of(events, "shot_repeated")) == 2
    assert all(event["ok"] for event in of(events, "safe_state"))


def test_a_camera_unplugged_in_a_shot_ends_the_run_safely(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    code, said, events = failing(tmp_path, capfd, faults={"unplugged_at": 2})
    assert code == 3
    assert "camera: the camera is gone: it does not answer; look after its cable and power" in said
    assert "camera is gone" in str(of(events, "shot_finished"))
    assert all(event["ok"] for event in of(events, "safe_state"))


def test_a_region_beyond_the_sensor_is_shown_in_the_profile(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    region = {"y": 500, "x": 0, "height": 100, "width": 512}
    code, said, _ = failing(tmp_path, capfd, region=region)
    assert code == 2
    assert "cameras.yaml:" in said
    assert "`region` ends at row 600 and column 512, beyond the sensor of 512 x 512 pixels" in said


def test_the_only_camera_may_be_the_wrong_one(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, said, _ = failing(tmp_path, capfd, model="BFS-PGE-50S5M")
    assert code == 3
    assert "camera: the camera SIM1 (Simulated) has the model Simulated; expected BFS-PGE-50S5M" in said
