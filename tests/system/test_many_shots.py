"""Thousands of shots: memory stays flat, and the index holds each once. ``poe soak`` takes 20,000."""

from __future__ import annotations

import gc
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import labseq
from tests.system.null_devices import write

pytestmark = pytest.mark.system

N_SHOTS = int(os.environ.get("LABSEQ_MANY_SHOTS", "75"))


class Watching:
    """Counts the objects in memory after a third of the shots and after the last."""

    def __init__(self) -> None:
        self.n = 0
        self.n_objects: list[int] = []

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        self.n += name == "shot_finished"
        if name == "shot_finished" and self.n in (N_SHOTS // 3, N_SHOTS):
            gc.collect()
            self.n_objects.append(len(gc.get_objects()))


def test_memory_stays_flat_and_the_index_whole(tmp_path: Path) -> None:
    watching = Watching()
    path = write(tmp_path, N_SHOTS)
    with labseq.Session.open(path, output=tmp_path / "data", observer=watching) as session:
        run = session.run()
    assert (run.status, run.n_damaged_lines, run.attempts) == ("complete", 0, ())
    assert [shot.index for shot in run.shots] == list(range(N_SHOTS))
    early, late = watching.n_objects
    assert late - early < N_SHOTS // 4, "objects stay behind, one or more every few shots"
    for shot in run.shots[:: max(1, N_SHOTS // 100)]:
        shot.verify()
    files = {path.name for path in (run.path / "shots").iterdir()}
    assert files == {shot.file.name for shot in run.shots}
