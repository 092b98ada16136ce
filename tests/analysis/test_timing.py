"""The stages of a shot over many shots."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given, strategies as st

from labseq.analysis.overview import evenly
from labseq.analysis.timing import quantiles, timing_of, writing_s
from labseq.data.reader import Run, open_run

from .records import make_shot

Write = Callable[..., Run]


def test_stages_come_in_the_order_of_a_shot_and_whole_steps_last(compact: Run) -> None:
    names = [stage.stage for stage in timing_of(compact, compact.shots).stages]
    seen = ["arm", "expose", "read_out", "detect", "plan", "check"]
    assert names[:13] == [*seen, "tones", "prepare", "start", "light", "play", "move", "write"]
    assert names[13:] == ["step_0_load", "step_1_image", "step_2_rearrange", "step_3_image"]


def test_each_stage_is_told_against_its_budget(write: Write) -> None:
    run = write([make_shot(i, n_cycles=2) for i in range(4)])
    timing = timing_of(run, run.shots)
    stages = {stage.stage: stage for stage in timing.stages}
    move = stages["move"]
    assert (move.n, move.n_per_shot, move.n_over, move.budget_s) == (8, 2.0, 4, 0.03)
    assert move.session_s.p50 == pytest.approx(0.03)
    assert (move.host_s.p50, move.host_s.p99) == pytest.approx((0.003, 0.003))
    assert move.share == pytest.approx(0.06)
    assert math.isnan(stages["plan"].budget_s)
    assert (timing.shot_s.p50, timing.shot_s.p99) == pytest.approx((1.0, 1.0))


def test_writing_is_told_by_the_event_log(write: Write) -> None:
    run = write([make_shot(0), make_shot(1)])
    with (run.path / "events.jsonl").open("a") as log:
        for values in ({}, {"write_s": None}, {"write_s": "long"}, {"write_s": 10**400}, "none"):
            log.write(json.dumps({"event": "shot_finished", "values": values}) + "\n")
    assert writing_s(open_run(run.path)) == [0.02, 0.02]


def test_a_model_knows_nothing_of_writing(write: Write) -> None:
    for simulated in (True, False):
        run = write([make_shot(0)], simulated=simulated)
        (stage,) = (one for one in timing_of(run, run.shots).stages if one.stage == "write")
        assert math.isnan(stage.session_s.p50) is simulated
        assert stage.host_s.p50 > 0


def test_the_long_end_is_the_99th_percentile() -> None:
    of_201 = quantiles([float(i) for i in range(201)])
    assert (of_201.p50, of_201.p99) == pytest.approx((100, 198))


@given(st.integers(0, 50), st.integers(1, 20))
def test_chosen_shots_are_spread_over_the_run(n: int, most: int) -> None:
    chosen = evenly(range(n), most)
    assert len(chosen) == min(n, most)
    steps = [b - a for a, b in pairwise(chosen)]
    assert not steps or max(steps) - min(steps) <= 1
