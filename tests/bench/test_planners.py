from __future__ import annotations

import csv
import importlib
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.bench import planners as bench
from labseq.bench.comparison import Comparison, Condition, PlannerEntry, read_comparison
from labseq.bench.planners import Resources, compare
from labseq.bench.report import Report
from labseq.bench.work import draw, set_up
from labseq.errors import ConfigError, PlanError
from labseq.plain import to_plain

SMALL = Comparison(
    (PlannerEntry("psca"),), (Condition((8, 8), "{pattern: compact, rows: 5, cols: 5}", 0.75, 4),), 60, 5
)
TIMES = {"planning_s", "duration_s"}
TWICE = (PlannerEntry("psca"), PlannerEntry("psca", (("degree_of_parallelism", "2"),)))

PLUGIN = """
import numpy as np

import labseq

LABSEQ_API = 1


class Moody:
    '''Fails for every loading with an atom in the corner.'''

    degree_of_parallelism = 1

    def __init__(self, settings, context): ...

    def plan(self, occupancy, target):
        if occupancy[0, 0]:
            raise ValueError("there is an atom in the corner")
        return labseq.Plan.from_batches([])


class Cold(Moody):
    def warm(self):
        raise RuntimeError("no kernels")


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("moody", Moody)
    registry.planner("cold", Cold)
"""

ALONE = Resources(1)


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bench_plugin.py").write_text(PLUGIN, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))


@pytest.fixture(scope="module")
def report() -> Report:
    return compare(replace(SMALL, planner_entries=TWICE), ALONE)


def without_times(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: without_times(value) for key, value in values.items() if key not in TIMES}
    return [without_times(value) for value in values] if isinstance(values, list) else values


@pytest.mark.usefixtures("plugins")
def test_several_processes_find_what_one_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long work is shared after a while; two conditions, and a planner that fails."""
    monkeypatch.setattr(bench, "ALONE_S", 0.0)
    monkeypatch.setattr(bench, "n_cores", lambda: 2)
    entries = (PlannerEntry("moody"), PlannerEntry("psca"))
    conditions = (*SMALL.conditions, Condition((6, 7), "{pattern: compact, rows: 3, cols: 3}", 0.5))
    comparison = replace(SMALL, planner_entries=entries, conditions=conditions)
    alone, together = compare(comparison, ALONE), compare(comparison)
    assert alone.ended_by is together.ended_by is None
    assert without_times(to_plain(alone)) == without_times(to_plain(together))
    assert all(np.array_equal(a.counts, b.counts) for a, b in zip(alone.rows, together.rows, strict=True))
    in_the_corner = [index for index in range(60) if draw((8, 8), 0.75, SMALL.seed, index)[0, 0]]
    for moody, psca, *_ in (alone.rows, together.rows):
        assert psca["n_failed"] == 0
        assert moody["n_failed"] == len(in_the_corner) == 60 - moody.counts.sum()
        assert moody.first_failure is not None
        assert moody.first_failure.loading == in_the_corner[0]
        assert "there is an atom in the corner" in moody.first_failure.message


def test_a_cluster_finds_what_one_process_finds(report: Report) -> None:
    distributed: Any = importlib.import_module("distributed")
    with distributed.LocalCluster(
        n_workers=1, protocol="tcp", processes=False, dashboard_address=":0"
    ) as cluster:
        where = Resources(scheduler=cluster.scheduler_address)
        found = compare(replace(SMALL, planner_entries=TWICE), where)
    assert without_times(to_plain(found)) == without_times(to_plain(report))


def test_a_row_sums_up_what_the_planner_did(report: Report) -> None:
    row = report.rows[0]
    assert (row["n_loadings"], row["n_failed"], row["n_short"]) == (60, 0, 0)
    assert row["filling_fraction"].value == row["target_met"].value == 1.0
    assert row.counts.sum() == 60
    assert row.counts @ np.arange(len(row.counts)) / 60 == pytest.approx(row["n_batches"].value)
    assert row["ratio_to_bound"].value == pytest.approx(row["n_batches"].value / row["bound"].value)
    assert row["ratio_to_bound"].value >= 1.0
    assert row["planning_s"]["p99"] >= row["planning_s"]["median"] > 0.0
    assert (row["degree_of_parallelism"], row["settings"]["degree_of_parallelism"]) == (4, 4)


def test_losses_are_predicted_by_those_of_the_profile(report: Report) -> None:
    """Without spread, vacuum and image, each atom moved is lost with the loss of a move."""
    losses = {"move": "1 %", "spread": "0", "image": "0", "lifetime": "700 h"}
    overrides = [f"profile.mobile_tweezers.losses.{key}={value}" for key, value in losses.items()]
    asked = read_comparison(
        "psca", "8x8", "{pattern: compact, rows: 4, cols: 4}", "75 %", "2,4", 20, 1, overrides
    )
    two, four = compare(asked, ALONE).rows
    assert (two["degree_of_parallelism"], four["degree_of_parallelism"]) == (2, 4)
    for row in (two, four):
        assert row["n_lost"].value == pytest.approx(0.01 * row["n_atoms_moved"].value, rel=0.03)
        assert row["p_defect_free"].value == pytest.approx(1 - row["n_lost"].value, rel=0.02)


def test_csv_and_json_hold_the_same(report: Report) -> None:
    values = json.loads(json.dumps(to_plain(report), allow_nan=False))
    lines = list(csv.DictReader(io.StringIO(report.as_csv())))
    assert [line["label"] for line in lines] == ["psca", "psca degree_of_parallelism=2"]
    for line, row in zip(lines, values["rows"], strict=True):
        assert float(line["n_batches_mean"]) == row["n_batches"]["mean"]
        assert line["n_scans_mean"] == ""
        assert row["n_scans"] == {"mean": None, "error": None}


def test_overheads_count_only_where_they_are_set(report: Report) -> None:
    motion = (("overhead_per_batch", "1 ms"), ("overhead_per_cycle", "0"))
    loaded = compare(replace(SMALL, conditions=(replace(SMALL.conditions[0], motion=motion),)), ALONE).rows[0]
    more_s = loaded["motion_s"].value - report.rows[0]["motion_s"].value
    assert more_s == pytest.approx(1e-3 * loaded["n_batches"].value)
    assert loaded["moving_s"].value == pytest.approx(report.rows[0]["motion_s"].value)


def test_too_few_atoms_show_in_the_filling() -> None:
    row = compare(
        replace(SMALL, conditions=(Condition((8, 8), "{pattern: compact, rows: 8, cols: 8}", 0.5, 4),)), ALONE
    ).rows[0]
    assert row["n_short"] == row["n_loadings"] == 60
    assert row["n_failed"] == 0
    assert row["target_met"].value == 0.0
    assert row["filling_fraction"].value == pytest.approx(0.5, abs=0.05)
    assert str(row["ratio_to_bound"]) == "-"


def test_empty_and_full_loadings() -> None:
    for loading in (0.0, 1.0):
        conditions = (Condition((5, 5), "{pattern: compact, rows: 3, cols: 3}", loading, 4),)
        row = compare(replace(SMALL, conditions=conditions), ALONE).rows[0]
        assert row["n_failed"] == 0
        assert row["n_batches"].value == 0.0
        assert row["filling_fraction"].value == loading


@pytest.mark.usefixtures("plugins")
def test_a_planner_that_cannot_be_warmed_is_named() -> None:
    report = compare(replace(SMALL, planner_entries=(PlannerEntry("cold"),)), ALONE)
    assert isinstance(report.ended_by, PlanError)
    assert all(fact in str(report.ended_by) for fact in ("'cold'", "warm()", "RuntimeError: no kernels"))
    assert report.rows == ()


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"planners": "psac"}, "unknown planner 'psac'; expected .*; did you mean 'psca'?"),
        (
            {"target": "{pattern: compact, rows: 30, cols: 30}"},
            "--target {pattern: compact, rows: 30, cols: 30}: the size of the target is 30 rows",
        ),
        ({"dop": "21"}, "--dop 21: .*; expected 1 to 20, the maximum number of tweezers.*max_tweezers=21"),
        (
            {
                "dop": "6",
                "overrides": [f"profile.mobile_tweezers.max_{a}_tones=5" for a in ("row", "column")],
            },
            "--dop 6: .*; expected 1 to 5, the maximum number of tones per axis",
        ),
        ({"dop": "7,x"}, "--dop 7,x: this is not a degree of parallelism; expected whole numbers"),
        ({"planners": "psca:dop=3"}, "psca:dop=3: 'dop' is not a setting of planner 'psca'"),
        ({"overrides": ["planner.dop=3"]}, "--set planner.dop=3: 'dop' is not a setting"),
        ({"overrides": ["profile.mobile_tweezers.speed=3 ms"]}, "'3 ms' is a time, not a speed"),
    ],
)
def test_wrong_requests_are_refused(request_: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        compare(read_comparison(**request_), ALONE)


def test_the_tweezers_speed_can_be_set() -> None:
    speed = "profile.mobile_tweezers.speed=130 um/ms"
    (course,) = set_up(read_comparison(target="{pattern: compact, rows: 2, cols: 2}", overrides=[speed]))
    assert course.motion.speed_m_s == 0.13
