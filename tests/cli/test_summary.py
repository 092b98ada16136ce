"""What came of a run, as people read it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from labseq.analysis.statistics import CycleStatistics, Statistics
from labseq.cli.summary import NOT_JUDGED, Summary, cycle_table, statistics_rows
from labseq.data.quantities import make_quantity
from labseq.model.estimate import Estimate, Rate

pytestmark = pytest.mark.usefixtures("capsys")  # tables are as wide as the terminal
UNKNOWN = Estimate(math.nan, math.nan)
CYCLE = CycleStatistics(
    cycle=0,
    n_shots=20,
    defect_free=Rate(1, 20),
    seen=Rate(1, 20),
    filling=Estimate(0.97664, 0.0004),
    n_atom_moves=Estimate(185.2, 4.1),
    n_batches=Estimate(33.6, 0.71),
    n_left_out=Estimate(0.0, 0.0),
    period_s=Estimate(0.08, 0.001),
    defects=(1, 4, 15),
)
STATISTICS = Statistics(
    n_shots=20,
    defect_free=Rate(7, 20),
    seen=Rate(18, 20),
    filling=Estimate(0.993, 0.001),
    cycles=(CYCLE,),
    defects=(7, 9, 4),
    too_short=Rate(0, 20),
    losses={},
    defects_true=UNKNOWN,
    defects_seen=UNKNOWN,
)


def lines(**changes: Any) -> dict[str, str]:
    return dict(statistics_rows(replace(STATISTICS, **changes)))


def test_success_and_what_was_only_seen_stand_apart() -> None:
    assert lines() == {
        "defect-free": "7 of 20 (35.0 %), 25.3 to 46.2 %",
        "seen defect-free": "18 of 20 (90.0 %)",
        "filling": "99.3(1) %",
        "defects": "none in 7, 1 in 9, 2 in 4 shots",
    }


def test_shots_that_are_not_judged_are_said_not_to_be() -> None:
    printed = lines(defect_free=Rate(0, 0), filling=UNKNOWN, defects=())
    assert printed["defect-free"] == NOT_JUDGED
    assert printed["defects"] == "none in 1, 1 in 4, 2 in 15 shots, after 1 cycle"


def test_what_a_run_measures_is_never_blank(fake: Any) -> None:
    measured = [
        (make_quantity("filling", fake.target()), Estimate(0.971, 0.003)),
        (make_quantity("reading.laser.power_w", fake.target()), UNKNOWN),
    ]
    statistics = replace(STATISTICS, defect_free=Rate(0, 0), filling=UNKNOWN, defects=(), cycles=())
    text = [" ".join(line.split()) for line in Summary(statistics=statistics, measured=measured).as_text()]
    assert "filling 97.1(3) %" in text
    needed = "no shot has this value; see the available values with labseq show --scan reading.laser.power_w"
    assert f"reading.laser.power_w {needed}" in text


def test_no_shots_are_no_reason_to_complain() -> None:
    printed = lines(
        n_shots=0, defect_free=Rate(0, 0), seen=Rate(0, 0), filling=UNKNOWN, cycles=(), defects=()
    )
    assert printed == {"defect-free": "0 of 0", "seen defect-free": "0 of 0"}


def test_the_truth_of_a_simulation_is_reported() -> None:
    printed = lines(
        losses={"vacuum": Estimate(3.9, 0.6), "hand_over": Estimate(3.5, 0.5), "light": Estimate(0.0, 0.0)},
        defects_true=Estimate(1.9, 0.3),
        defects_seen=Estimate(1.3, 0.2),
    )
    assert printed["lost in a shot"] == "vacuum 3.9(6), hand over 3.5(5)"
    assert printed["true defects"] == "1.9(3) at the end of a shot, known from the simulation"
    assert printed["seen defects"] == "1.3(2) on the last image of a shot"
    assert lines(losses={"vacuum": Estimate(0.0, 0.0)})["lost in a shot"] == "no atoms"


def test_each_cycle_has_a_row() -> None:
    header, row, note = cycle_table(STATISTICS)
    assert header.split()[:3] == ["cycle", "shots", "defect-free"]
    assert " ".join(row.split()) == "0 20 5.0 % (2.1 to 12.3) 97.66(4) % 185(4) 33.6(7) 0"
    assert "reached" not in note  # all shots did
    assert cycle_table(replace(STATISTICS, cycles=())) == []


def test_cycles_that_not_all_shots_made_are_said_to_be() -> None:
    *_, note = cycle_table(replace(STATISTICS, cycles=(CYCLE, replace(CYCLE, cycle=1, n_shots=12))))
    assert "reached" in note
