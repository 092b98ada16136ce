"""Panels on matplotlib axes, and pictures of several."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest

from labseq.analysis.charts import (
    Panel,
    defects,
    draw_curves,
    draw_map,
    draw_sites,
    loss_causes,
    points_of,
    running_mean,
    stages_of_a_shot,
    trend,
)
from labseq.analysis.timing import Quantiles, StageStatistics
from labseq.model import SiteGrid
from labseq.model.estimate import Estimate, Rate, jeffreys
from labseq.pictures.figures import RED, make_figure

NAN = math.nan


def points(n: int = 4) -> np.ndarray[Any, np.dtype[np.float64]]:
    return points_of(range(1, n + 1), [Estimate(value, 0.1) for value in np.linspace(0.2, 0.9, n).tolist()])


def stage(name: str, session_s: tuple[float, float], host_s: tuple[float, float], budget_s: float) -> Any:
    return StageStatistics(name, 1, 1.0, budget_s, Quantiles(*session_s), Quantiles(*host_s), 0.5, 0)


def trend_of(n: int, *, is_rate: bool = False) -> Panel:
    shots = np.arange(1.0, n + 1)
    values = shots % 2 if is_rate else 1 - 0.01 * (shots % 3)
    return trend("a trend", shots, values, is_yes_or_no=is_rate) or no_panel


def no_panel(_: object) -> None:
    raise AssertionError


def curves(**changes: Any) -> Panel:
    kept: dict[str, Any] = {
        "title": "curves",
        "x_label": "a $x$ (ms)",
        "y_label": "%",
        "curves": {"": points()},
    }
    return partial(draw_curves, **kept | changes)


def map_of(values: Any, x_ticks: str, y_ticks: str) -> Panel:
    labels = {"title": "map", "x_label": "x", "y_label": "y", "label": "filling (%)"}
    limits = float(np.nanmin(values)), float(np.nanmax(values))
    return partial(draw_map, x_ticks=x_ticks, y_ticks=y_ticks, values=values, limits=limits, **labels)


def sites(values: Any, grid: SiteGrid) -> Panel:
    return partial(draw_sites, title="sites", label="%", grid=grid, values=values, outlined=values > 0.9)


CLOCKS = {"session_s": "modelled", "host_s": "this computer"}
PANELS: dict[str, Panel] = {
    "shots": trend_of(30),
    "many rates": trend_of(3000, is_rate=True),
    "text below the axis": curves(curves={"": points(3)}, ticks=("psca", "a" * 30, "x"), from_zero=True),
    "a single count": curves(curves={"": points(1)}, whole=True),
    "ratios": curves(logarithmic=True),
    "map with a gap": map_of(np.array([[0.1, NAN], [0.5, 0.9]]), "12", "34"),
    "defects": defects((3, 2, 1), 6, 6, "at the end") or no_panel,
    "many defects": defects((0,) * 200 + (3, 2), 4000, 5, "at the end") or no_panel,
    "causes": loss_causes({"imaging": Estimate(3.0, 0.1), "$x$": Estimate(1.0, NAN)}) or no_panel,
    "one clock": stages_of_a_shot("s", [stage("plan", (NAN, NAN), (1e-3, 2e-3), NAN)], CLOCKS),
    "no times": stages_of_a_shot(
        "s", [stage("plan", (NAN, NAN), (NAN, NAN), NAN)], {"session_s": "measured"}
    ),
    "sites": sites(np.where(np.eye(4, 5) > 0, NAN, 0.97), SiteGrid(4, 5)),
    "unknown sites": sites(np.full((2, 2), NAN), SiteGrid(2, 2, lattice="square")),
}


@pytest.mark.parametrize("name", PANELS)
def test_every_panel_can_be_drawn(name: str) -> None:
    figure = make_figure(3.0, 3.0)
    axes = figure.add_subplot()
    PANELS[name](axes)
    figure.canvas.draw()
    assert axes.get_title()


def test_points_are_means_with_their_intervals() -> None:
    found = points_of([1, 2, 3], [Estimate(0.5, 0.1), Estimate(NAN, NAN), Rate(1, 2)])
    assert found[0].tolist() == [1, 3]
    assert found[1:, 0] == pytest.approx([0.5, 0.4, 0.6])
    assert found[1:, 1].tolist() == [0.5, *Rate(1, 2).interval]


def test_curves_are_drawn_in_per_cent_with_error_bars() -> None:
    axes = make_figure(3.0, 3.0).add_subplot()
    curves(curves={"": points_of([1, 2], [Estimate(0.2, 0.1), Rate(1, 10)])})(axes)
    (line, _, (bars,)), *_ = axes.containers
    assert line.get_ydata().tolist() == pytest.approx([20, 10])
    low, high = jeffreys(1, 10)
    assert bars.get_segments()[0][:, 1].tolist() == pytest.approx([10.0, 30.0])
    assert bars.get_segments()[1][:, 1].tolist() == pytest.approx([100 * low, 100 * high])


def test_a_stage_has_its_median_and_its_budget() -> None:
    axes = make_figure(3.0, 3.0).add_subplot()
    one = stage("play", (3e-3, 5e-3), (NAN, NAN), 4e-3)
    stages_of_a_shot("s", [one], {"session_s": "measured"})(axes)
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert lines["measured"].get_xdata() == [3e-3]
    assert lines["budget"].get_xdata() == [4e-3]
    assert lines["budget"].get_color() == RED


def test_a_running_rate_has_jeffreys_intervals() -> None:
    shots = np.arange(30.0)
    window, points = running_mean(shots, 1.0 - shots % 2, is_yes_or_no=True)
    assert window == 10
    assert points[0, 0] == 4.5
    assert tuple(points[2:, 0]) == jeffreys(5, 10)


def test_defects_stand_beside_those_of_independent_sites() -> None:
    axes = make_figure(3.0, 3.0).add_subplot()
    panel = defects((4, 0, 0, 2), 6, 6, "at the end")
    assert panel is not None
    panel(axes)
    bars: Any = axes.patches
    assert [bar.get_height() for bar in bars] == pytest.approx([400 / 6, 0, 0, 200 / 6])
    (line,) = (line for line in axes.get_lines() if line.get_label() == "independent sites")
    independent = [100 * math.comb(6, k) * (1 / 6) ** k * (5 / 6) ** (6 - k) for k in range(7)]
    found: Any = line.get_ydata()
    assert list(found) == pytest.approx(independent[: len(found)])


def test_a_site_of_few_atoms_does_not_take_up_the_range_of_the_colours() -> None:
    axes = make_figure(3.0, 3.0).add_subplot()
    values = np.full((20, 20), 0.98)
    values[::2], values[0, 0] = 1.0, 0.0
    sites(values, SiteGrid())(axes)
    cells: Any = axes.collections[0]
    assert cells.get_clim() == pytest.approx((98.0, 100.0))
