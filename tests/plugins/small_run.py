"""A run of one shot on a small virtual lab of which one device is another."""

from __future__ import annotations

from pathlib import Path

import labseq

PROFILE = """labseq: 1
name: bench
grid: {rows: 5, cols: 6, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: STATIC
mobile_tweezers: MOBILE
detector: {use: threshold, frame: [128, 128], centre_px: [63.5, 63.5], pixel_size: 0.35 um}
simulation: {use: virtual, image: {frame: [128, 128], centre_px: [63.5, 63.5]}}
"""
SEQUENCE = """labseq: 1
name: small
profile: p.yaml
target: {pattern: compact, rows: 2, cols: 2}
planner: {use: psca, degree_of_parallelism: 2}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1, window: 60 ms}
  - image: {exposure: 45 ms}
"""


def write(folder: Path, static: str = "{use: virtual}", mobile: str = "{use: virtual}") -> Path:
    """Its sequence; the static tweezers are in line 5 of p.yaml, the mobile ones in line 6."""
    folder.mkdir(exist_ok=True)
    profile = PROFILE.replace("STATIC", static).replace("MOBILE", mobile)
    (folder / "p.yaml").write_text(profile, encoding="utf-8")
    (folder / "s.yaml").write_text(SEQUENCE, encoding="utf-8")
    return folder / "s.yaml"


def run(folder: Path, static: str = "{use: virtual}", mobile: str = "{use: virtual}") -> labseq.Run:
    """Run it; see :func:`write`."""
    with labseq.Session.open(
        write(folder, static, mobile), shots=1, seed=1, output=folder / "runs"
    ) as session:
        return session.run()
