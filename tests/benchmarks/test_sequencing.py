"""The sequencer's own time: a shot of one step that does nothing, and a shot of 101 of them.

The difference of the two by 100 is what a step costs before a device does anything; the plan is at
most 300 us. Both stand in one group, so that pytest-benchmark's table gives their ratio within one run.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

import labseq
from labseq.guard import StopFlag
from labseq.model import ShotRecord
from labseq.roles import Step
from labseq.sequencer.run import Sequencer
from tests.system.null_devices import write

SHOTS = {"1 step": 1, "101 steps": 101}


class Nowhere:
    """Keeps nothing and reports nothing."""

    def write_shot(self, shot: ShotRecord) -> None:
        """Keep only the number of its timed stages."""
        self.n_stages = len(shot.timing)

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Forget it."""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[labseq.Session]:
    path = write(tmp_path_factory.mktemp("null"), 1)
    path.write_text(path.read_text("utf-8") + "  - nothing: {}\n", "utf-8")
    with labseq.Session.open(path) as session:
        yield session


@pytest.mark.benchmark(group="a shot of steps that do nothing")
@pytest.mark.parametrize("n_steps", SHOTS.values(), ids=SHOTS.keys())
def test_a_shot_of_null_steps(benchmark: Any, session: labseq.Session, n_steps: int) -> None:
    (step,) = [step for name, step in session.assembly.steps if name == "nothing"]
    steps: list[tuple[str, Step]] = [(f"step {number}", step) for number in range(n_steps)]
    nowhere, shots = Nowhere(), itertools.count()
    sequencer = Sequencer(session.build_lab(), steps, StopFlag(), nowhere, nowhere, seed=1)
    sequencer.open()
    try:
        benchmark(lambda: sequencer.take(next(shots)))
    finally:
        assert not sequencer.shut_down()
    assert nowhere.n_stages == n_steps
