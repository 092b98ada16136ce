"""The page with the measured tables can be written again by its script."""

from __future__ import annotations

import re
from pathlib import Path

from .scripts import load_script

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "explanation" / "planners.md").read_text(encoding="utf-8")


SCRIPT = load_script("make_planner_tables")
FIGURES = SCRIPT.FIGURES


def test_every_figure_has_a_measured_part_and_a_picture() -> None:
    parts = re.findall(r"<!-- measured: (.+?) -->", PAGE)
    assert sorted(parts) == sorted(["planners", "sizes", *(f"figure {name}" for name in FIGURES)])
    for name in FIGURES:
        assert f"(../_static/planners/figure-{name}.png)" in PAGE
        assert (ROOT / "docs" / "_static" / "planners" / f"figure-{name}.png").is_file()


def test_only_the_measured_part_is_replaced() -> None:
    page = "before\n<!-- measured: a -->\nold\n<!-- end -->\nafter\n<!-- measured: b -->\n<!-- end -->\n"
    once = SCRIPT.replaced(page, "a", ["new"])
    assert once == page.replace("old", "\nnew\n")
    assert SCRIPT.replaced(once, "a", ["new"]) == once
