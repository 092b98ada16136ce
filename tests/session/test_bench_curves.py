from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.bench.comparison import Comparison, Condition, PlannerEntry, set_up
from labseq.bench.planners import compare
from labseq.bench.report import (
    FIGURES,
    Figure,
    Report,
    figure_drawing,
    fits_as_dicts,
    histogram_drawing,
    points_of,
)

CONDITIONS = tuple(Condition((4 * n, 4 * n), f"compact:{3 * n}x{3 * n}", 0.75, 5) for n in (1, 2, 3))

SCANS = """
import labseq

LABSEQ_API = 1


class Scanned:
    n_scans = 7

    def __init__(self, plan):
        self.plan = plan

    def duration_s(self, grid, motion):
        return 0.5


class Scans:
    degree_of_parallelism = 1

    def __init__(self, settings, context): ...

    def plan(self, occupancy, target):
        return labseq.Plan.from_batches([])

    def scan(self, occupancy, target):
        return Scanned(self.plan(occupancy, target))


@labseq.hookimpl
def labseq_register(registry):
    registry.planner("scans", Scans)
"""


def compared(conditions: tuple[Condition, ...] = CONDITIONS, *planner_entries: PlannerEntry) -> Report:
    return compare(Comparison(planner_entries or (PlannerEntry("psca"),), conditions, 10, 1), 1)


@pytest.fixture(scope="module")
def report() -> Report:
    return compared()


def figure(**changes: Any) -> Figure:
    return replace(FIGURES["2b"], planner_entries=(PlannerEntry("psca"),), conditions=CONDITIONS, **changes)


def test_the_bound_is_drawn_beside_the_planners(report: Report) -> None:
    points = points_of(report, figure())
    assert [one.label for one in points] == ["psca", "bound"]
    assert points[0].x.tolist() == points[1].x.tolist() == [9.0, 36.0, 81.0]
    assert (points[0].y >= points[1].y).all()
    drawing = figure_drawing(report, figure())
    assert [curve.is_limit for curve in drawing.curves] == [False, True]


def test_every_law_that_is_drawn_is_in_the_json(report: Report) -> None:
    points = points_of(report, figure())
    laws = fits_as_dicts(points)
    curves = figure_drawing(report, figure()).curves
    assert [(law["factor"], law["exponent"]["value"]) for law in laws] == [curve.law for curve in curves]
    assert points[0].law is not None
    assert curves[0].label == f"psca: $N^{{{points[0].law.exponent}}}$"


def test_times_are_drawn_in_milliseconds(report: Report) -> None:
    (curve,) = figure_drawing(report, figure(y="motion_s")).curves
    (points,) = points_of(report, figure(y="motion_s"))
    assert np.array_equal(curve.y, 1e3 * points.y)
    assert curve.law is not None
    assert np.allclose(curve.law[0] * curve.x ** curve.law[1], curve.y, rtol=0.5)


def test_a_figure_over_the_degree_of_parallelism_has_no_law_but_histograms() -> None:
    conditions = tuple(replace(CONDITIONS[1], degree_of_parallelism=dop) for dop in (2, 3, 5))
    over_dop = replace(FIGURES["2c"], planner_entries=(PlannerEntry("psca"),), conditions=conditions)
    report = compared(conditions)
    drawing = figure_drawing(report, over_dop)
    assert [one.law for one in points_of(report, over_dop)] == [None, None]
    assert [histogram.label for histogram in drawing.histograms] == ["DOP 2", "DOP 3", "DOP 5"]
    assert [curve.label for curve in drawing.curves] == ["psca", "bound", "the paper"]
    assert not drawing.logarithmic


def test_a_planner_that_scans_is_drawn_by_its_scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scans.py").write_text(SCANS, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    report = compared(CONDITIONS, PlannerEntry("scans"), PlannerEntry("psca"))
    batches, times = points_of(report, figure()), points_of(report, figure(y="motion_s"))
    assert [one.label for one in batches] == ["scans (scans)", "psca", "bound"]
    assert batches[0].y.tolist() == [7.0] * 3
    assert times[0].y.tolist() == [0.5] * 3
    assert (times[1].y < 0.1).all()


def test_an_incomplete_figure_says_so(report: Report) -> None:
    from labseq.errors import StopRequested

    stopped = replace(report, n_done=7, ended_by=StopRequested(), rows=report.rows[:1])
    drawing = figure_drawing(stopped, figure())
    assert "incomplete: 7 of 30" in drawing.note
    assert [curve.law for curve in drawing.curves] == [None, None]


def test_a_plain_comparison_shows_how_batches_spread() -> None:
    drawing = histogram_drawing(
        compared(CONDITIONS[:1], PlannerEntry("psca", (("degree_of_parallelism", "3"),)))
    )
    (histogram,) = drawing.histograms
    assert histogram.counts.sum() == 10
    assert drawing.title == "compact:3x3 out of 4 x 4, 75 % loading, degree of parallelism 5"


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_has_targets_that_its_loadings_can_mostly_fill(name: str) -> None:
    conditions = FIGURES[name].conditions
    for course in set_up(Comparison((PlannerEntry("psca"),), conditions, 1, 1)):
        n_sites = course.grid.n_rows * course.grid.n_cols
        mean, spread = course.loading * n_sites, (course.loading * (1 - course.loading) * n_sites) ** 0.5
        assert mean - 1.9 * spread > course.target.n_atoms
        assert course.runners[0].degree_of_parallelism <= course.motion.max_tweezers
