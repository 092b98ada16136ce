"""Runs on the disk whose every shot is known, on a grid of 4 x 5 sites."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.data.reader import Run, open_run
from labseq.model import ShotRecord
from labseq.recording.writer import RunWriter

from .records import make_run

ROOT = Path(__file__).parents[2]
SHAPE = (4, 5)
START = "2026-11-20T10:00:00+00:00"

Write = Callable[..., Run]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes shots as a run, and opens it."""

    def run(shots: Sequence[ShotRecord], *, status: Any = "complete", **changes: Any) -> Run:
        writer = RunWriter.create(tmp_path / "data", make_run(**{"n_shots": len(shots), **changes}))
        for one in shots:
            writer.write_shot(one)
            values = {"shot_index": one.shot_index, "attempt": one.attempt}
            writer.event("shot_finished", shot=values, write_s=0.02)
        if status != "running":
            writer.finish(status)
        return open_run(writer.run_dir)

    return run


@pytest.fixture(scope="session")
def compact(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two shots of the virtual lab, with their frames."""
    sequence, profile = ROOT / "sequences" / "compact_225.yaml", ROOT / "hardware_profiles" / "virtual.yaml"
    root = tmp_path_factory.mktemp("compact")
    with labseq.Session.open(
        sequence, profile=str(profile), shots=2, seed=1, output=root, overrides=("record_frames=all",)
    ) as session:
        return session.run()


LIFETIME = """
labseq: 1
name: lifetime
profile: virtual
target: {pattern: compact, rows: 15, cols: 15}
scan:
  shot.hold.duration: [1 s, 5 s, 10 s, 20 s, 40 s, 80 s]
repeats: 2
order: shuffled
record_frames: none
analysis:
  - {use: survival}
shot:
  - load: {duration: 500 ms}
  - name: before
    image: {exposure: 45 ms}
  - name: hold
    wait: {duration: 1 s}
  - name: after
    image: {exposure: 45 ms}
"""


RECAPTURE = """
labseq: 1
name: recapture
profile: virtual
scan:
  shot.drop.duration: [1 us, 10 us, 15 us, 20 us, 30 us, 50 us]
repeats: 2
record_frames: none
shot:
  - load: {duration: 500 ms}
  - name: before
    image: {exposure: 45 ms}
  - name: drop
    release: {duration: 10 us}
  - name: after
    image: {exposure: 45 ms}
"""


def run_text(text: str, root: Path, seed: int) -> Run:
    """Run a sequence in the virtual lab."""
    (root / "sequence.yaml").write_text(text, "utf-8")
    profile = str(ROOT / "hardware_profiles" / "virtual.yaml")
    with labseq.Session.open(root / "sequence.yaml", profile=profile, seed=seed, output=root) as session:
        return session.run()


@pytest.fixture(scope="session")
def recapture(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A scan of the duration of a release, without a target."""
    return run_text(RECAPTURE, tmp_path_factory.mktemp("recapture"), seed=1)


@pytest.fixture(scope="session")
def lifetime(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A lifetime scan of 12 shots in the virtual lab."""
    return run_text(LIFETIME, tmp_path_factory.mktemp("lifetime"), seed=2)
