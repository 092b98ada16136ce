from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from labseq.bench.comparison import Comparison, Condition, PlannerEntry
from labseq.bench.planners import Resources, compare
from labseq.bench.report import Report, save_histogram
from labseq.errors import ConfigError
from labseq.pictures.figures import make_figure
from tests.pictures.pixels import decoded, is_colour

from .scripts import load_script

SCRIPT = load_script("make_planner_tables")
FIGURES, points_of = SCRIPT.FIGURES, SCRIPT.points_of

CONDITIONS = tuple(
    Condition((4 * n, 4 * n), f"{{pattern: compact, rows: {3 * n}, cols: {3 * n}}}", 0.75, 5)
    for n in (1, 2, 3)
)

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


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("scans", Scans)
"""


def compared(conditions: tuple[Condition, ...] = CONDITIONS, *planner_entries: PlannerEntry) -> Report:
    return compare(Comparison(planner_entries or (PlannerEntry("psca"),), conditions, 10, 1), Resources(1))


@pytest.fixture(scope="module")
def report() -> Report:
    return compared()


def figure(**changes: Any) -> Any:
    return replace(FIGURES["2b"], planner_entries=(PlannerEntry("psca"),), conditions=CONDITIONS, **changes)


def curves(report: Report, drawn: Any) -> dict[str, Any]:
    """Label in the legend -> its curve."""
    axes = make_figure(4.0, 3.0).add_subplot()
    SCRIPT.draw_curves(axes, points_of(report, drawn), drawn)
    return dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))


def test_the_bound_is_drawn_with_the_planners(report: Report) -> None:
    points = points_of(report, figure())
    assert [one.label for one in points] == ["psca, generalised", "bound"]
    assert points[0].x.tolist() == points[1].x.tolist() == [9.0, 36.0, 81.0]
    assert (points[0].y >= points[1].y).all()
    assert [*curves(report, figure())] == [f"{one.label}: $N^{{{one.law.exponent}}}$" for one in points]


def test_a_figure_over_the_degree_of_parallelism_has_no_law_but_histograms(tmp_path: Path) -> None:
    conditions = tuple(replace(CONDITIONS[1], degree_of_parallelism=dop) for dop in (2, 3, 5))
    over_dop = replace(FIGURES["2c"], planner_entries=(PlannerEntry("psca"),), conditions=conditions)
    report = compared(conditions)
    assert [one.law for one in points_of(report, over_dop)] == [None, None]
    assert {*curves(report, over_dop)} == {"psca, generalised", "bound", "the paper"}
    for name, drawn in (("two", over_dop), ("one", replace(over_dop, histograms_at=()))):
        SCRIPT.draw_figure(tmp_path / f"{name}.png", report, drawn)
    with Image.open(tmp_path / "one.png") as one, Image.open(tmp_path / "two.png") as two:
        assert (two.width, two.height) == (2 * one.width, one.height)


def test_a_planner_that_scans_is_drawn_by_its_scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scans.py").write_text(SCANS, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    report = compared(CONDITIONS, PlannerEntry("scans"), PlannerEntry("psca"))
    batches, times = points_of(report, figure()), points_of(report, figure(y="motion_s"))
    assert [one.label for one in batches] == ["scans (scans)", "psca, generalised", "bound"]
    assert batches[0].y.tolist() == [7.0] * 3
    assert times[0].y.tolist() == [0.5] * 3
    assert (times[1].y < 0.1).all()


def test_a_comparison_is_drawn_as_a_histogram(tmp_path: Path) -> None:
    entry = PlannerEntry("psca", (("degree_of_parallelism", "3"),))
    report = compared(CONDITIONS[2:], entry, PlannerEntry("psca"))
    save_histogram(tmp_path / "histogram.png", report)
    pixels = decoded((tmp_path / "histogram.png").read_bytes(), "RGB")
    with_3, with_5 = (np.flatnonzero(is_colour(pixels, colour).any(axis=0)) for colour in ("C0", "C1"))
    assert with_3.max() > with_5.max()  # fewer tweezers need more batches
    with pytest.raises(ConfigError, match="the picture cannot be written"):
        save_histogram(tmp_path / "nowhere" / "histogram.png", report)
