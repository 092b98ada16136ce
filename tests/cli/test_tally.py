from __future__ import annotations

import math
from typing import Any

import pytest

from labseq.cli.live import Tally
from labseq.model import StageTiming
from labseq.model.estimate import Estimate, Rate


def played(tally: Tally, events: Any) -> Tally:
    for name, values in events:
        tally.add(name, values)
    return tally


def test_a_run_is_summed_up(fake: Any) -> None:
    tally = played(Tally(lambda: 0.0), fake.script(fake.run(), n_shots=3))
    assert (tally.n_done, tally.n_defect_free, tally.n_seen) == (3, 3, 3)
    assert tally.n_shots == 20
    assert [one.quantity.name for one in tally.measured] == ["filling", "defect_free"]
    assert [one.mean for one in tally.measured] == [Estimate(1.0, 0.0), Rate(3, 3)]
    assert (tally.image_shot, tally.image.cycle if tally.image else None) == (2, 1)
    assert len(tally.stages["plan"].host_s) == 6
    assert tally.stages["plan"].medians_s() == (0.8e-3, 7.5e-3)
    assert tally.status == "complete"


def test_only_complete_shots_count(fake: Any) -> None:
    tally = Tally(lambda: 0.0)
    tally.add("run_starting", {"record": fake.run(), "run_dir": "x"})
    rows = [
        fake.row(0, success=False, seen=0, filling=0.99),
        fake.row(1, status="interrupted"),
        fake.row(2, status="failed"),
        fake.row(3, success=False, seen=-1, filling=math.nan),
    ]
    for row in rows:
        tally.add("shot_finished", {"row": row})
    # a shot that is not judged is no shot with defects
    assert (tally.n_done, tally.n_judged, tally.n_defect_free, tally.n_seen) == (2, 1, 0, 1)


def test_over_budget_is_counted() -> None:
    tally = Tally(lambda: 0.0)
    for duration_s in (59e-3, 60e-3, 62e-3):
        tally.add("stage", {"timing": StageTiming("move", 2, 1, 0.0, duration_s, 1e-3, 60e-3)})
    assert tally.stages["move"].n_over == 1


def test_time_left_follows_the_pace_so_far(fake: Any) -> None:
    now = 100.0
    tally = Tally(lambda: now)
    tally.add("run_starting", {"record": fake.run(n_shots=10), "run_dir": "x"})
    now = 107.0  # compiling and opening are not shots
    tally.add("shot_started", {"shot": 0, "attempt": 0})
    assert math.isnan(tally.time_left_s)
    for i in range(2):
        now += 3.0
        tally.add("shot_finished", {"row": fake.row(i)})
    assert tally.time_left_s == pytest.approx(24.0)
