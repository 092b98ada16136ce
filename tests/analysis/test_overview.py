"""The panels of a run's overview."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest

from labseq.analysis.overview import RunPicture, overview, picture_of
from labseq.data.reader import Run, open_run
from labseq.errors import ConfigError
from labseq.pictures.figures import make_figure

from .records import make_shot

Write = Callable[..., Run]


def titles(picture: RunPicture) -> list[list[str]]:
    """The titles of the panels, without numbers."""
    found: list[list[str]] = []
    for row in picture.rows:
        axes = [make_figure(3.0, 3.0).add_subplot() for _ in row]
        for one, panel in zip(axes, row, strict=True):
            panel(one)
        found.append(
            [re.sub(r"^[\d().]+ |[:;,].*", "", one.get_title(loc="left") or one.get_title()) for one in axes]
        )
    return found


SITES = ["moved atoms", "atoms that stayed"]


def test_a_run_of_the_virtual_lab_fills_the_sheet(compact: Run) -> None:
    assert titles(overview(compact)) == [
        ["filling by shot", "filling by cycle", "defects in a shot"],
        ["defect-free by shot", "defect-free by cycle", "lost in a shot"],
        [*SITES, "stages of a shot"],
    ]


def test_a_run_without_rearrangement_has_the_rest(write: Write) -> None:
    run = write([make_shot(i, n_cycles=0) for i in range(3)], resolved={})
    assert titles(overview(run)) == [
        ["filling by shot", "defects in a shot"],
        ["defect-free by shot"],
        [SITES[1], "stages of a shot"],
    ]
    with pytest.raises(
        ConfigError, match=r"nothing to show of lost atoms; expected readable shots with a rear"
    ):
        picture_of(run, "losses")


def test_shots_that_are_not_judged_are_shown_by_the_image_that_ended_the_last_cycle(write: Write) -> None:
    drawing = overview(write([make_shot(i, n_defects=i, judged=False) for i in range(3)]))
    for row, expected in ((0, [100, 500 / 6, 400 / 6]), (1, [100, 0, 0])):
        axes = make_figure(3.0, 3.0).add_subplot()
        drawing.rows[row][0](axes)
        assert list(axes.get_lines()[0].get_ydata()) == pytest.approx(expected)  # pyright: ignore[reportArgumentType]


def test_a_run_without_shots_says_so(write: Write) -> None:
    with pytest.raises(ConfigError, match="no shots yet; expected at least one complete shot"):
        overview(write([], status="running"))
    with pytest.raises(ConfigError, match="no shots that count"):
        overview(write([make_shot(0, status="failed", error="no light")], status="failed"))


def test_shots_whose_files_are_gone_are_left_out_of_what_needs_them(write: Write) -> None:
    run = write([make_shot(i) for i in range(3)])
    for one in run.shots[:2]:
        one.file.unlink()
    moved: Any = overview(open_run(run.path)).rows[2][0]
    assert moved.keywords["title"].endswith("1 of 3 shots")
    run.shots[2].file.write_bytes(b"nothing")
    gone = overview(open_run(run.path))
    assert titles(gone)[0][0] == "filling by shot"
    with pytest.raises(ConfigError, match="nothing to show of survival by site"):
        picture_of(open_run(run.path), "survival")
