"""The panels of a run's overview."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from labseq.analysis.charts import (
    draw_curves,
    draw_defects,
    draw_loss_causes,
    draw_sites,
    draw_stages,
    draw_trend,
)
from labseq.analysis.overview import RunPicture, overview, picture_of
from labseq.errors import ConfigError
from labseq.model.estimate import jeffreys
from labseq.recording import Run, open_run

from .records import make_shot

Write = Callable[..., Run]


def kinds(picture: RunPicture) -> list[list[Any]]:
    panels: Any = picture.rows
    return [[panel.func for panel in row] for row in panels]


def drawn(picture: RunPicture, row: int = 0, column: int = 0) -> SimpleNamespace:
    """What a panel shows: the arguments of the function that draws it."""
    panel: Any = picture.rows[row][column]
    return SimpleNamespace(**panel.keywords)


def test_a_run_of_the_virtual_lab_fills_the_sheet(compact: Run) -> None:
    assert kinds(overview(compact)) == [
        [draw_trend, draw_curves, draw_defects],
        [draw_trend, draw_curves, draw_loss_causes],
        [draw_sites, draw_sites, draw_stages],
    ]


def test_a_run_without_rearrangement_has_the_rest(write: Write) -> None:
    run = write([make_shot(i, n_cycles=0) for i in range(3)], resolved={})
    assert kinds(overview(run)) == [[draw_trend, draw_defects], [draw_trend], [draw_sites, draw_stages]]
    with pytest.raises(
        ConfigError, match=r"nothing to show of lost atoms; expected readable shots with a rear"
    ):
        picture_of(run, "losses")


def test_shots_that_are_not_judged_are_shown_by_the_image_that_ended_the_last_cycle(write: Write) -> None:
    drawing = overview(write([make_shot(i, n_defects=i, judged=False) for i in range(3)]))
    filling, success = drawn(drawing), drawn(drawing, 1)
    assert filling.values == pytest.approx([1, 5 / 6, 4 / 6])
    assert success.values.tolist() == [1, 0, 0]


def test_a_running_rate_has_jeffreys_intervals(write: Write) -> None:
    trend = drawn(picture_of(write([make_shot(i, n_defects=i % 2) for i in range(30)]), "success"))
    x, _, low, high = trend.running[:, 0]
    assert x == 4.5  # ten shots
    assert (low, high) == jeffreys(5, 10)
    assert trend.is_rate


def test_defects_stand_beside_those_of_independent_sites(write: Write) -> None:
    chart = drawn(picture_of(write([make_shot(i, n_defects=(0, 0, 3)[i % 3]) for i in range(6)]), "defects"))
    _, y, low, high = chart.shares
    assert y == pytest.approx([4 / 6, 0, 0, 2 / 6])
    assert (low[1], high[1]) == jeffreys(0, 6)
    independent = [math.comb(6, k) * (1 / 6) ** k * (5 / 6) ** (6 - k) for k in range(7)]
    assert chart.expected == pytest.approx(independent[: len(chart.expected)])


def test_a_run_without_shots_says_so(write: Write) -> None:
    with pytest.raises(ConfigError, match="no shots yet; expected at least one complete shot"):
        overview(write([], status="running"))
    with pytest.raises(ConfigError, match="no shots that count"):
        overview(write([make_shot(0, status="failed", error="no light")], status="failed"))


def test_shots_whose_files_are_gone_are_left_out_of_what_needs_them(write: Write) -> None:
    run = write([make_shot(i) for i in range(3)])
    for one in run.shots[:2]:
        one.file.unlink()
    drawing = overview(open_run(run.path))
    assert kinds(drawing)[2][0] is draw_sites
    assert drawn(drawing, 2).title.endswith("1 of 3 shots")
    run.shots[2].file.write_bytes(b"nothing")
    gone = overview(open_run(run.path))
    assert draw_trend in kinds(gone)[0]
    with pytest.raises(ConfigError, match="nothing to show of survival by site"):
        picture_of(open_run(run.path), "survival")
