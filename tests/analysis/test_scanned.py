"""Filling and defect-free fraction against what was scanned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from types import SimpleNamespace
from typing import Any

import pytest

from labseq.analysis.charts import draw_curves, draw_map
from labseq.analysis.overview import overview, picture_of
from labseq.data.reader import Run
from labseq.units import parse_any

from .records import make_shot

Write = Callable[..., Run]


def si(word: str) -> Any:
    """A value as run.json has it."""
    try:
        return parse_any(word)[0] if " " in word else float(word)
    except ValueError:
        return word


def scan(*columns: tuple[str, Sequence[str]], repeats: int = 1) -> dict[str, Any]:
    """A scan whose points are rows of these columns."""
    written = [list(row) for row in zip(*(words for _, words in columns), strict=True)]
    return {
        "addresses": [address for address, _ in columns],
        "points": [[si(word) for word in row] for row in written],
        "written": written,
        "point_of_shot": [point for point in range(len(written)) for _ in range(repeats)],
    }


def taken(write: Write, of: dict[str, Any], n_shots: int | None = None) -> Run:
    n = len(of["point_of_shot"]) if n_shots is None else n_shots
    return write([make_shot(i, n_defects=i % 3) for i in range(n)], scan=of)


def charts(run: Run) -> list[list[Any]]:
    panels: Any = picture_of(run, "scan").rows
    return [[SimpleNamespace(func=panel.func, **panel.keywords) for panel in row] for row in panels]


def test_a_quantity_is_an_axis_in_its_unit(write: Write) -> None:
    ((filling, success),) = charts(taken(write, scan(("a.window", ["90 ms", "30 ms", "60 ms"]), repeats=2)))
    assert filling.func is draw_curves
    assert filling.x_label == "a.window (ms)"
    assert filling.curves[""][0].tolist() == [30, 60, 90]
    assert filling.curves[""][1] == pytest.approx([(4 / 6 + 1) / 2, (5 / 6 + 4 / 6) / 2, (1 + 5 / 6) / 2])
    assert success.curves[""][1].tolist() == [0.5, 0, 0.5]
    assert not filling.logarithmic


@pytest.mark.parametrize(
    ("words", "logarithmic"),
    [
        (["1", "10", "100"], True),
        (["1", "2", "5", "10", "20"], True),
        (["0.01", "0.015", "0.03", "0.1", "0.3", "1", "3"], True),
        (["1", "50", "100"], False),
        (["-1", "0", "30"], False),
    ],
)
def test_values_at_equal_ratios_are_on_a_logarithmic_axis(
    write: Write, words: list[str], logarithmic: bool
) -> None:
    ((chart, _),) = charts(taken(write, scan(("a", words))))
    assert chart.logarithmic is logarithmic


@pytest.mark.parametrize("words", [["psca", "other"], ["10 ms", "1 um"], ["1", "true"]])
def test_what_is_no_number_is_written_below_the_axis(write: Write, words: list[str]) -> None:
    ((chart, _),) = charts(taken(write, scan(("planner", words))))
    assert tuple(chart.ticks) == tuple(words)
    assert chart.curves[""][0].tolist() == [0, 1]


def test_values_in_several_units_of_a_dimension_are_on_one_axis(write: Write) -> None:
    ((chart, _),) = charts(taken(write, scan(("a", ["10 ms", "1 s"]))))
    assert chart.curves[""][0].tolist() == [0.01, 1.0]
    assert "(s)" in chart.x_label


def test_two_values_make_a_map(write: Write) -> None:
    rows = list(product(["1", "2", "3"], ["10 ms", "20 ms"]))
    of = scan(("dop", [a for a, _ in rows]), ("window", [b for _, b in rows]))
    (filling, success), *_ = charts(taken(write, of))
    assert filling.func is draw_map
    assert (filling.y_label, filling.x_label, filling.values.shape) == ("dop", "window", (3, 2))
    assert filling.values.ravel() == pytest.approx([100, 500 / 6, 400 / 6] * 2)
    assert success.label == "defect-free (%)"


def test_more_values_make_a_row_of_maps_with_one_scale(write: Write) -> None:
    rows = list(product("ab", "123", "xy"))
    of = scan(*((name, [row[i] for row in rows]) for i, name in enumerate(("first", "second", "third"))))
    run = taken(write, of)
    maps, _ = charts(run)
    assert [chart.title for chart in maps] == ["first a", "first b"]
    assert len({chart.limits for chart in maps}) == 1
    row: Any = overview(run).rows[2]
    assert [panel.func for panel in row] == [draw_map, draw_map]


def test_values_that_go_together_are_one_axis(write: Write) -> None:
    of = scan(("dop", ["1", "2", "3"]), ("window", ["30 ms", "20 ms", "20 ms"]), ("fixed", ["7", "7", "7"]))
    ((chart, _),) = charts(taken(write, of))
    assert chart.x_label == "dop with window"


def test_points_of_an_optimiser_are_drawn_in_their_order(write: Write) -> None:
    a, b = ["0.1", "0.4", "0.2", "0.35", "0.3", "0.15"], ["1", "5", "2", "3", "4", "6"]
    ((chart, _),) = charts(taken(write, scan(("a", a), ("b", b))))
    assert chart.x_label == "point of the scan"
    assert chart.curves[""][0].tolist() == [0, 1, 2, 3, 4, 5]
