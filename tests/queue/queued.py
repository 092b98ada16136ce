"""A queue of small runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from labseq.assembly.options import Options
from labseq.errors import LabseqError
from labseq.queue.queue import Entry, Queue, Rules
from labseq.queue.running import Opening, QueueRun, add_checked

SEQUENCE = """
labseq: 1
name: look
profile: ./p.yaml
shots: 3
seed: 1
target: {pattern: compact, rows: 2, cols: 2}
shot:
  - load: {duration: 100 ms}
  - image: {}
"""
PROFILE = """
labseq: 1
name: bench
grid: {rows: 4, cols: 4, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold, frame: [96, 96], centre_px: [47.5, 47.5]}
simulation: {use: virtual, image: {frame: [96, 96], centre_px: [47.5, 47.5]}}
"""


@pytest.fixture
def queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Queue:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("GIT_DIR", "/dev/null")
    Path("s.yaml").write_text(SEQUENCE, encoding="utf-8")
    Path("p.yaml").write_text(PROFILE, encoding="utf-8")
    return Queue(Path("data"))


def add(queue: Queue, sequence: str = "s.yaml", rules: Rules | None = None, **options: object) -> Entry:
    return add_checked(queue, Path(sequence), Options(**options), rules or Rules())[0]  # pyright: ignore[reportArgumentType]


class Taking:
    """Takes what it is given, and remembers it."""

    def __init__(self, *acts: Callable[[Path], object]) -> None:
        self.runs: list[Path] = []
        self.failures: list[LabseqError] = []
        self.begun: list[int] = []
        self.calibrated: list[tuple[str, str]] = []
        self._acts = dict(enumerate(acts))

    def __call__(self, opening: Opening) -> None:
        act = self._acts.get(len(self.runs))

        class Acting:
            def event(self, name: str, values: dict[str, Path]) -> None:
                if name == "shot_finished" and act is not None:
                    act(session.run_dir or Path())

        session = opening(Acting())  # pyright: ignore[reportArgumentType]
        with session:
            try:
                session.run()
            finally:
                if session.run_dir is not None:
                    self.runs.append(session.run_dir)

    def calibrate(self, kind: str, profile: str, dry_run: str) -> None:
        self.calibrated.append((kind, Path(profile).name))

    def run(self, queue: Queue, *, keep_going: bool = False) -> QueueRun:
        runs = QueueRun(
            queue,
            self,
            lambda entry: self.begun.append(entry.id),
            self.failures.append,
            self.calibrate,
            keep_going=keep_going,
        )
        runs.run()
        return runs


def states(queue: Queue) -> dict[int, str]:
    return {entry.id: entry.state for entry in queue.entries()}
