"""Runs with remote devices."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import labseq
from tests.remote.conftest import served

DEVICES = ("camera", "static_tweezers", "mobile_tweezers", "lines", "instrument")
PROFILE = """\
labseq: 1
name: lab
grid: {{rows: 4, cols: 4, spacing: 4.49 um}}
camera: {camera}
static_tweezers: {static_tweezers}
mobile_tweezers: {mobile_tweezers}
lines: {{{lines}, channels: {{cooling: {{channel: 2, on: [load]}}}}}}
devices: {{instrument: {instrument}}}
detector:
  use: threshold
  frame: [80, 96]
  centre_px: [39.5, 47.5]
  pixel_size: 0.35 um
  region: 5
  threshold: 1630
simulation: {{use: virtual, image: {{frame: [80, 96], centre_px: [39.5, 47.5]}}}}
"""
SEQUENCE = """
labseq: 1
name: small
profile: ./lab.yaml
target: {pattern: compact, rows: 2, cols: 2}
shots: 2
shot:
  - load: {duration: LOAD}
  - image: {exposure: 5 ms}
"""


def write_client(folder: Path, at: Mapping[str, str], load: str = "1 ms") -> Path:
    """A sequence all of whose devices are at servers; ``at`` has the address of each."""
    remote = {name: f"use: remote, {at[name]}, device: {name}" for name in DEVICES}
    texts = {name: text if name == "lines" else f"{{{text}}}" for name, text in remote.items()}
    (folder / "lab.yaml").write_text(PROFILE.format(**texts), encoding="utf-8")
    path = folder / "small.yaml"
    path.write_text(SEQUENCE.replace("LOAD", load), encoding="utf-8")
    return path


def test_a_run_uses_the_devices_of_a_server_and_records_where_they_are(tmp_path: Path) -> None:
    with served(tmp_path) as server:
        sequence = write_client(tmp_path, dict.fromkeys(DEVICES, f"address: 'tcp://127.0.0.1:{server.port}'"))
        with labseq.Session.open(sequence, output=tmp_path / "runs") as session:
            run = session.run()
        assert all(device.owner is None for device in server.server.devices.values())
    assert len(run.shots) == 2
    record = json.loads((run.path / "run.json").read_text("utf-8"))
    for name in DEVICES:
        assert record["devices"][name]["remote"]["address"] == f"tcp://127.0.0.1:{server.port}"


def test_a_dry_run_makes_no_connection(tmp_path: Path) -> None:
    sequence = write_client(tmp_path, dict.fromkeys(DEVICES, "address: 'tcp://127.0.0.1:1'"))
    with labseq.Session.open(sequence, output=tmp_path / "runs", dry_run="full") as session:
        assert len(session.run().shots) == 2
