"""What is on the sheet of a run."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from labseq.analysis import overview
from labseq.analysis.charts import (
    CurvesChart,
    DefectsChart,
    LossCausesChart,
    RunDrawing,
    SitesChart,
    StagesChart,
    TrendChart,
)
from labseq.analysis.overview import CHOICES, picture_of
from labseq.analysis.statistics import jeffreys
from labseq.errors import ConfigError
from labseq.model import ShotRecord
from labseq.recording import Run, open_run

Shot = Callable[..., ShotRecord]
Write = Callable[..., Run]


def kinds(drawing: RunDrawing) -> list[list[type]]:
    return [[type(chart) for chart in row] for row in drawing.rows]


def test_a_run_of_the_virtual_lab_fills_the_sheet(compact: Run) -> None:
    assert kinds(overview(compact)) == [
        [TrendChart, CurvesChart, DefectsChart],
        [TrendChart, CurvesChart, LossCausesChart],
        [SitesChart, SitesChart, StagesChart],
    ]


@pytest.mark.parametrize("what", sorted({*CHOICES} - {"scan"}))
def test_each_part_is_there_alone(compact: Run, what: str) -> None:
    assert picture_of(compact, what).rows


def test_a_run_without_rearrangement_has_the_rest(write: Write, shot: Shot) -> None:
    run = write([shot(i, n_cycles=0) for i in range(3)], resolved={})
    assert kinds(overview(run)) == [[TrendChart, DefectsChart], [TrendChart], [SitesChart, StagesChart]]
    with pytest.raises(
        ConfigError, match=r"nothing to show of lost atoms; expected readable shots with a rear"
    ):
        picture_of(run, "losses")


def test_a_run_without_images_has_its_stages(write: Write, shot: Shot) -> None:
    run = write([shot(0, n_cycles=0, judged=False, images=[])])
    assert kinds(overview(run)) == [[StagesChart]]
    with pytest.raises(ConfigError, match="nothing to show of filling"):
        picture_of(run, "filling")


def test_one_shot_is_enough(write: Write, shot: Shot) -> None:
    drawing = overview(write([shot(0, n_defects=1)]))
    course: Any = drawing.rows[0][0]
    assert course.values.tolist() == [pytest.approx(5 / 6)]
    assert course.running.y.tolist() == [pytest.approx(5 / 6)]
    assert np.isnan(course.running.low).all()


def test_shots_that_are_not_judged_are_shown_by_the_image_that_ended_the_last_cycle(
    write: Write, shot: Shot
) -> None:
    drawing = overview(write([shot(i, n_defects=i, judged=False) for i in range(3)]))
    filling, success = (row[0] for row in drawing.rows[:2])
    assert isinstance(filling, TrendChart)
    assert isinstance(success, TrendChart)
    assert filling.values == pytest.approx([1, 5 / 6, 4 / 6])
    assert success.values.tolist() == [1, 0, 0]


def test_a_running_rate_has_jeffreys_intervals(write: Write, shot: Shot) -> None:
    drawing = picture_of(write([shot(i, n_defects=i % 2) for i in range(30)]), "success")
    chart: Any = drawing.rows[0][0]
    assert chart.running.x[0] == 5.5  # ten shots
    assert (chart.running.low[0], chart.running.high[0]) == jeffreys(5, 10)
    assert chart.is_rate


def test_defects_stand_beside_those_of_independent_sites(write: Write, shot: Shot) -> None:
    drawing = picture_of(write([shot(i, n_defects=(0, 0, 3)[i % 3]) for i in range(6)]), "defects")
    chart: Any = drawing.rows[0][0]
    assert chart.shares.y == pytest.approx([4 / 6, 0, 0, 2 / 6])
    assert (chart.shares.low[1], chart.shares.high[1]) == jeffreys(0, 6)
    independent = [math.comb(6, k) * (1 / 6) ** k * (5 / 6) ** (6 - k) for k in range(7)]
    assert chart.expected == pytest.approx(independent[: len(chart.expected)])


@pytest.mark.parametrize("n_defects", [0, 6])
def test_shots_that_are_all_alike_can_be_drawn(write: Write, shot: Shot, n_defects: int) -> None:
    chart: Any = picture_of(write([shot(i, n_defects=n_defects) for i in range(2)]), "defects").rows[0][0]
    assert chart.expected[n_defects] == 1.0


def test_a_run_that_goes_on_says_so(write: Write, shot: Shot) -> None:
    run = write([shot(0)], status="running", n_shots=20)
    assert "(running, 1 of 20 shots)" in overview(run).note


def test_a_run_without_shots_says_so(write: Write, shot: Shot) -> None:
    with pytest.raises(ConfigError, match="no shots yet; expected at least one complete shot"):
        overview(write([], status="running"))
    with pytest.raises(ConfigError, match="no shots that count"):
        overview(write([shot(0, status="failed", error="no light")], status="failed"))


def test_shots_whose_files_are_gone_are_left_out_of_what_needs_them(write: Write, shot: Shot) -> None:
    run = write([shot(i) for i in range(3)])
    for one in run.shots[:2]:
        one.file.unlink()
    drawing = overview(open_run(run.path))
    sites = next(chart for chart in drawing.rows[2] if isinstance(chart, SitesChart))
    assert sites.title.endswith("1 of 3 shots")
    run.shots[2].file.write_bytes(b"nothing")
    gone = overview(open_run(run.path))
    assert TrendChart in kinds(gone)[0]
    with pytest.raises(ConfigError, match="nothing to show of survival by site"):
        picture_of(open_run(run.path), "survival")


def test_an_unknown_part_is_told(compact: Run) -> None:
    with pytest.raises(
        ConfigError, match=r"--what: there is no picture 'x' of a run; expected one of 'defects'"
    ):
        picture_of(compact, "x")
