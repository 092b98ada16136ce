from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.assembly.planning import PlanRequest, plan_moves
from labseq.errors import ConfigError
from labseq.plain import dumps, to_plain
from labseq.plans.plan import PlanReport
from labseq.plans.plan_file import read_plan


def planned(**options: Any) -> dict[str, Any]:
    request = PlanRequest("random:8x9@0.7", "{pattern: compact, rows: 4, cols: 4}", **options)
    return to_plain(PlanReport.of(plan_moves(request)))


def read(document: dict[str, Any], **options: Any) -> dict[str, Any]:
    data = json.dumps(document).encode()
    return to_plain(PlanReport.of(read_plan(data, "plan.json", PlanRequest("plan.json", **options))))


@settings(max_examples=8)
@given(
    st.integers(0, 1000),
    st.sampled_from(
        [
            "{pattern: compact, rows: 4, cols: 4}",
            "{pattern: kagome, rows: 5, cols: 5}",
            "{pattern: ring, radius: 3}",
        ]
    ),
    st.integers(1, 9),
)
def test_a_plan_reads_back_as_it_was_written(seed: int, target: str, dop: int) -> None:
    request = PlanRequest("random:8x9@0.7", target, degree_of_parallelism=dop, seed=seed)
    moves = plan_moves(request)
    document = to_plain(PlanReport.of(moves))
    again = read_plan(json.dumps(document).encode(), "plan.json", PlanRequest("plan.json"))
    assert to_plain(PlanReport.of(again)) == document
    assert (again.source, again.motion) == ("plan.json", moves.motion)
    assert np.array_equal(again.report.n_tweezers, moves.report.n_tweezers)


def test_a_plan_that_breaks_a_rule_is_refused_with_the_files_name() -> None:
    document = planned(seed=1)
    row, col = np.argwhere(np.array(document["occupancy"]) == 0)[0].tolist()
    document["batches"] = [{"from": [[row, col]], "to": [[row, col - 1 if col else 1]], "linked": False}]
    with pytest.raises(
        ConfigError, match=rf"^plan\.json: batch 0, atom move 0 .*'source'.* \({row}, {col}\)"
    ):
        read(document)


def test_more_tweezers_than_the_plan_allows_are_refused() -> None:
    document = planned(seed=1, degree_of_parallelism=5) | {"degree_of_parallelism": 1}
    with pytest.raises(ConfigError, match="breaks the rule 'parallelism'"):
        read(document)


def test_a_profile_brings_motion_and_tones() -> None:
    request = PlanRequest("random:20x20@0.75", "{pattern: compact, rows: 6, cols: 6}", seed=1)
    data = dumps(PlanReport.of(plan_moves(request))).encode()
    slow = PlanRequest("plan.json", profile="virtual", overrides=["profile.mobile_tweezers.speed=65 um/ms"])
    fast, slower = read_plan(data, "plan.json", PlanRequest("plan.json")), read_plan(data, "plan.json", slow)
    assert slower.motion.speed_m_s == pytest.approx(0.065)
    assert slower.report.duration_s > fast.report.duration_s


def test_a_plan_for_another_grid_than_the_profiles_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"8 x 9 sites.* 20 x 20.*virtual"):
        read(planned(seed=1), profile="virtual")


@pytest.mark.parametrize(
    ("options", "option"),
    [
        ({"target": "{pattern: compact, rows: 3, cols: 3}"}, "--target"),
        ({"degree_of_parallelism": 3}, "--dop"),
        ({"seed": 3}, "--seed"),
        ({"overrides": ["degree_of_parallelism=3"]}, "--set degree_of_parallelism=3"),
    ],
)
def test_options_that_only_planning_takes_are_refused(options: dict[str, Any], option: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read(planned(seed=1), **options)
    assert str(caught.value).startswith(f"{option}: plan.json is already a plan")


def test_values_of_a_profile_need_a_profile() -> None:
    with pytest.raises(ConfigError, match="--profile is missing"):
        read(planned(seed=1), overrides=["profile.mobile_tweezers.speed=65 um/ms"])
