"""Runs with remote devices: the same data as with devices of this computer."""

from __future__ import annotations

from pathlib import Path

import pytest

import labseq
import labseq.remote.server
from labseq import wire
from tests.remote.conftest import served
from tests.session.small_runs import table

GRID = "{rows: 6, cols: 6, spacing: 4.49 um, row_frequency: TONES, column_frequency: TONES}".replace(
    "TONES", "{centre: 100 MHz, step: 1.6 MHz}"
)
CHANNELS = """
    mot: {channel: 3, on: [load]}
    imaging: {channel: 4, on: [image]}
    trigger: {channel: 5, on: [image], pulse: 0.2 ms, triggers: camera}
    awg: {channel: 7, on: [rearrange], pulse: 0.1 ms, triggers: mobile_tweezers}"""
MOTION = "rf: {full_scale: 200 mV, max_peak: 200 mV, amplifier_gain: 38}"
PROFILE = f"""\
labseq: 1
name: lab
grid: {GRID}
camera: CAMERA
static_tweezers: STATIC
mobile_tweezers: {{MOBILE, {MOTION}}}
devices: {{trap_camera: {{role: camera, TRAP}}}}
lines:
  LINES
  channels: {CHANNELS}
detector: {{use: threshold}}
simulation: SIMULATION
"""
HERE = {
    "CAMERA": "{use: virtual}",
    "STATIC": "{use: virtual}",
    "MOBILE": "use: spcm, card: simulated, mode: replay, sample_rate: 624 MHz",
    "TRAP": "use: virtual",
    "LINES": "{use: ttl, port: simulated, simulated_by: python}",
    "SIMULATION": "{use: virtual, lights: {loading: [mot], imaging: [imaging]}}",
}
DEVICES = {
    "CAMERA": "camera",
    "STATIC": "static_tweezers",
    "MOBILE": "mobile_tweezers",
    "TRAP": "trap_camera",
    "LINES": "lines",
}
SEQUENCE = """
labseq: 1
name: small
profile: ./lab.yaml
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: psca}
shots: 2
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 2, window: 60 ms, exposure: 45 ms}
  - image: {exposure: 45 ms}
"""


def filled(texts: dict[str, str]) -> str:
    profile = PROFILE
    for key, text in texts.items():
        inside = key in ("MOBILE", "TRAP", "LINES")
        if key == "LINES":
            text = text.strip("{}").replace(", ", "\n  ")
        profile = profile.replace(key, text.strip("{}") if inside else text)
    return profile


def run(folder: Path, profile: str) -> labseq.Run:
    folder.mkdir()
    (folder / "lab.yaml").write_text(profile, encoding="utf-8")
    (folder / "small.yaml").write_text(SEQUENCE, encoding="utf-8")
    with labseq.Session.open(folder / "small.yaml", seed=5, output=folder / "runs") as session:
        return session.run()


@pytest.fixture(autouse=True)
def _never_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four servers and a run share this process, which may stand still for long."""
    for module in (wire, labseq.remote.server):
        monkeypatch.setattr(module, "LOST_S", 60.0)


def test_devices_of_several_servers_share_a_simulation(tmp_path: Path) -> None:
    with served(tmp_path, filled(HERE), devices=("simulation",)) as first:
        there = {"SIMULATION": f"{{use: remote, address: 'tcp://127.0.0.1:{first.port}'}}"}
        split = filled({**HERE, **there})
        with (
            served(tmp_path, split, devices=("camera", "lines", "trap_camera")) as second,
            served(tmp_path, split, devices=("static_tweezers", "mobile_tweezers")) as third,
        ):
            for key, name in DEVICES.items():
                port = (third if "tweezers" in name else second).port
                about = f"use: remote, address: 'tcp://127.0.0.1:{port}', device: {name}, simulated: true"
                there[key] = f"{{{about}}}"
            apart = run(tmp_path / "apart", filled(there))
    together = run(tmp_path / "together", filled(HERE))
    assert table(apart) == table(together)


def test_a_dry_run_makes_no_connection(tmp_path: Path) -> None:
    about = "use: remote, address: 'tcp://127.0.0.1:1', device:"
    texts = {key: f"{{{about} {name}, simulated: true}}" for key, name in DEVICES.items()}
    (tmp_path / "lab.yaml").write_text(filled({**texts, "SIMULATION": f"{{{about} simulation}}"}), "utf-8")
    (tmp_path / "small.yaml").write_text(SEQUENCE, "utf-8")
    with labseq.Session.open(tmp_path / "small.yaml", output=tmp_path / "runs", dry_run="full") as session:
        assert len(session.run().shots) == 2
