"""Whole runs in this process, on the virtual lab."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import labseq
from labseq.guard import Guard
from labseq.model import TimelineEntry
from labseq.sequencer.run import plan_timelines

ROOT = Path(__file__).parents[2]
COMPACT = ROOT / "sequences" / "compact_225.yaml"
SMALL_FRAMES = tuple(
    f"profile.{part}.{setting}"
    for part in ("detector", "simulation.image")
    for setting in ("frame=[240, 400]", "centre_px=[119.5, 199.5]")
)
"""Frames that 20 x 20 sites just fill, a third of those of the virtual lab."""


def run(tmp_path: Path, sequence: Path = COMPACT, observer: Any = None, **options: Any) -> labseq.Run:
    with labseq.Session.open(sequence, output=tmp_path / "data", observer=observer, **options) as session:
        return session.run()


def timelines(session: labseq.Session) -> list[list[TimelineEntry]]:
    """The timeline of each step of a shot; nothing is opened."""
    guard = Guard(session.stop_flag)
    try:
        return plan_timelines(session.build_lab(), guard, session.assembly.steps)
    finally:
        guard.end()
