"""Whatever came of a run can be painted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.analysis.charts import (
    Chart,
    CurvesChart,
    DefectsChart,
    LossCausesChart,
    MapChart,
    RunDrawing,
    SitesChart,
    StageBar,
    StagesChart,
    TrendChart,
    save_run,
)
from labseq.model import SiteGrid
from labseq.pictures.figures import QUOTED, Series, make_figure

NAN = math.nan


def series(n: int = 4, label: str = "") -> Series:
    x = np.arange(1.0, n + 1)
    y = np.linspace(0.2, 0.9, n)
    return Series(label, x, y, y - 0.1, y + 0.1)


def course(n: int, *, is_rate: bool = False) -> TrendChart:
    shots = np.arange(1.0, n + 1)
    values = shots % 2 if is_rate else 1 - 0.01 * (shots % 3)
    return TrendChart("filling by shot", "filling (%)", shots, values, series(min(n, 5)), is_rate=is_rate)


def sites(fraction: float = 0.97) -> SitesChart:
    values = np.full((4, 5), fraction)
    values[0, 0], values[1, 1] = NAN, 0.5
    return SitesChart("moved atoms", "there (%)", SiteGrid(4, 5), values, np.isfinite(values))


CHARTS: tuple[Chart, ...] = (
    course(30),
    course(1),
    course(3000, is_rate=True),
    CurvesChart("50 $ a shot", "a $x$ (ms)", "filling (%)", (series(), series(3, "other"))),
    CurvesChart("words", "planner", "filling (%)", (series(3),), ("psca", "a" * 30, "x"), from_zero=True),
    CurvesChart("cycles", "cycle", "lost (%)", (series(1),), whole=True),
    CurvesChart("ratios", "x", "lost (%)", (series(4),), logarithmic=True),
    MapChart(
        "a", "x", "y", ("1", "2"), ("3", "4"), np.array([[0.1, NAN], [0.5, 0.9]]), "filling (%)", (0.1, 0.9)
    ),
    MapChart("b", "x", "y", tuple("abcdefghijkl"), ("3",), np.full((1, 12), 0.5), "filling (%)", (0.5, 0.5)),
    DefectsChart("defects", "defects", series(3, "shots"), np.array([0.5, 0.3, 0.2])),
    LossCausesChart("lost", "atoms", ("imaging", "$x$"), np.array([3.0, 1.0]), np.array([0.1, NAN])),
    StagesChart("stages", ("modelled", "host"), (StageBar("plan", ((NAN, NAN), (1e-3, 2e-3)), NAN),)),
    StagesChart("nothing", ("measured",), (StageBar("plan", ((NAN, NAN),), NAN),)),
    sites(),
    SitesChart("none", "there (%)", SiteGrid(2, 2, lattice="square"), np.full((2, 2), NAN), np.eye(2) > 0),
)


@pytest.mark.parametrize("chart", CHARTS, ids=lambda chart: type(chart).__name__)
def test_every_chart_can_be_painted(chart: Chart) -> None:
    axes = make_figure(3.0, 3.0).add_subplot()
    chart.paint(axes)
    assert axes.get_title(loc="left")


def test_a_budget_is_a_mark_of_its_own() -> None:
    axes = make_figure(3.0, 3.0).add_subplot()
    StagesChart("stages", ("measured",), (StageBar("play", ((3e-3, 5e-3),), 4e-3),)).paint(axes)
    (budget,) = [line for line in axes.get_lines() if line.get_label() == "budget"]
    assert budget.get_xdata() == (4e-3,)
    assert budget.get_color() == QUOTED


def test_a_site_of_few_atoms_does_not_take_the_whole_scale() -> None:
    axes = make_figure(3.0, 3.0).add_subplot()
    values = np.full((20, 20), 0.98)
    values[::2], values[0, 0] = 1.0, 0.0
    SitesChart("", "", SiteGrid(), values, values > 0).paint(axes)
    painted: Any = axes.collections[0]
    assert painted.get_clim() == pytest.approx((98.0, 100.0))


def test_charts_stand_in_rows_on_one_sheet(tmp_path: Path) -> None:
    drawing = RunDrawing("a $ run", "a note", ((course(5), sites()), (course(5, is_rate=True),)))
    save_run(tmp_path / "run.svg", drawing)
    text = (tmp_path / "run.svg").read_text("utf-8")
    save_run(tmp_path / "run.svg", drawing)
    assert text == (tmp_path / "run.svg").read_text("utf-8")  # the same picture, the same bytes
