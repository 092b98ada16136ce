"""Whole runs whose lines are switched by the timing box."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from labseq import Run, Session

from .labseq_ttl_rig import need_simavr
from .needs import need_library

ROOT = Path(__file__).parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"
VIRTUAL = ROOT / "hardware_profiles" / "virtual.yaml"
LINES = """
lines:
  use: USE
  channels:
    cooling: {channel: 2, on: [load, rearrange, wait, image, idle]}
    mot: {channel: 3, on: [load], lag: 2 ms}
    imaging: {channel: 4, on: [image], lead: 1 ms, lag: 1 ms}
    shutter: {channel: 9, on: [image], lead: 3 ms, lag: 2 ms, active_low: true}
  mutually_exclusive: [[mot, imaging]]
"""
LIGHTS = "  lights: {loading: [mot], cooling: [cooling], imaging: [imaging, shutter]}\n"


@pytest.fixture(autouse=True, scope="module")
def offered() -> None:
    def find() -> None:
        if not entry_points(group="labseq", name="labseq_ttl"):
            raise RuntimeError("labseq_ttl is no plugin of this installation; install labseq again")

    need_library(find)


def profile(folder: Path, use: str) -> str:
    """``virtual`` with lines."""
    path = folder / "with_lines.yaml"
    text = VIRTUAL.read_text().replace(
        "simulation:\n  use: virtual\n", f"simulation:\n  use: virtual\n{LIGHTS}"
    )
    assert LIGHTS in text
    path.write_text(text + LINES.replace("USE", use))
    return str(path)


def run(folder: Path, use: str, dry_run: Literal["off", "full"] = "off") -> Run:
    folder.mkdir()
    with Session.open(
        SEQUENCE, profile=profile(folder, use), shots=2, seed=1, output=folder, dry_run=dry_run
    ) as session:
        return session.run()


def assert_equal(one: Run, other: Run) -> None:
    for a, b in zip(one.shots, other.shots, strict=True):
        np.testing.assert_array_equal(a.occupancies, b.occupancies)
        assert a.occupancies[0].sum() > 200, "no light where light is needed"


def test_the_firmware_switches_the_lines_as_the_virtual_box_does(tmp_path: Path) -> None:
    need_simavr()
    virtual = run(tmp_path / "virtual", "virtual")
    firmware = run(tmp_path / "firmware", "ttl\n  port: simulated\n  simulated_by: simavr")
    assert firmware.simulated
    assert_equal(firmware, virtual)


def test_a_dry_run_with_a_real_boxs_profile_takes_the_model(tmp_path: Path) -> None:
    virtual = run(tmp_path / "virtual", "virtual")
    dry = run(tmp_path / "dry", "ttl\n  port: /dev/ttyACM0\n  start: external", dry_run="full")
    assert dry.simulated
    assert_equal(dry, virtual)
