"""When a run takes no real time."""

from __future__ import annotations

from pathlib import Path

import pytest

import labseq
from labseq.assembly.profile import resolve_profile

PROFILE = """
labseq: 1
name: bench
grid: {rows: 5, cols: 6, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: MOBILE
detector: {use: threshold, frame: [128, 128], centre_px: [63.5, 63.5], pixel_size: 0.35 um}
simulation: {use: virtual, image: {frame: [128, 128], centre_px: [63.5, 63.5]}}
"""
SEQUENCE = """
labseq: 1
name: small
profile: p.yaml
target: {pattern: compact, rows: 2, cols: 2}
planner: {use: psca}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1, window: 60 ms}
  - image: {exposure: 45 ms}
"""


LINE = """
lines: {use: virtual, channels: {awg: {channel: 7, on: [rearrange], pulse: 1 ms, triggers: mobile_tweezers}}}
"""


def profile(folder: Path, mobile: str) -> str:
    path = folder / "p.yaml"
    path.write_text(PROFILE.replace("MOBILE", mobile), encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    ("mobile", "is_virtual"),
    [
        ("{use: spcm, card: simulated, mode: fifo, sample_rate: 250 MHz}", True),
        ("{use: spcm, card: /dev/spcm0}", False),
        ("{use: spcm, card: simulated, trigger: external}", False),  # somebody else must give it
        ("{use: spcm, card: simulated, trigger: external}" + LINE, True),
    ],
)
def test_a_driver_needs_no_real_time_if_it_is_set_up_as_in_a_dry_run(
    tmp_path: Path, mobile: str, is_virtual: bool
) -> None:
    assert resolve_profile(profile(tmp_path, mobile)).virtual_time is is_virtual


def test_a_run_with_a_simulated_card_is_on_the_virtual_clock(tmp_path: Path) -> None:
    profile(tmp_path, "{use: spcm, card: simulated}")
    (tmp_path / "s.yaml").write_text(SEQUENCE, encoding="utf-8")
    with labseq.Session.open(tmp_path / "s.yaml", shots=1, output=tmp_path / "runs") as session:
        assert session.build_lab().clock.virtual
