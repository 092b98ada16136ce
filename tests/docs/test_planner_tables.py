"""The page with the measured tables can be written again by its script."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.bench.work import draw
from labseq.model.estimate import Estimate
from tests.plugins.planning import COMPACT, plan_and_check, psca

from .scripts import load_script

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "develop" / "planner-figures.md").read_text(encoding="utf-8")


SCRIPT = load_script("make_planner_tables")
FIGURES = SCRIPT.FIGURES


def test_every_figure_has_a_measured_part_and_a_picture() -> None:
    parts = re.findall(r"<!-- measured: (.+?) -->", PAGE)
    assert sorted(parts) == sorted(SCRIPT.PARTS)
    for name in FIGURES:
        assert f"(../_static/planners/figure-{name}.png)" in PAGE
        assert (ROOT / "docs" / "_static" / "planners" / f"figure-{name}.png").is_file()


def test_only_the_measured_part_is_replaced() -> None:
    page = "before\n<!-- measured: a -->\nold\n<!-- end -->\nafter\n<!-- measured: b -->\n<!-- end -->\n"
    once = SCRIPT.replaced(page, "a", ["new"])
    assert once == page.replace("old", "\nnew\n")
    assert SCRIPT.replaced(once, "a", ["new"]) == once


def test_the_tables_call_only_the_variant_of_the_text_the_papers() -> None:
    for name in FIGURES:
        (head,) = re.findall(
            rf"<!-- measured: figure {name} -->.*?\n(\| (?:N|DOP) \|[^\n]*)", PAGE, re.DOTALL
        )
        labels = [label.strip() for label in head.split("|")[2:]]
        assert labels[:2] == ["psca variant=paper", "psca, generalised"]


def test_a_figure_is_measured_at_another_loading(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tables: list[list[str]] = []
    for options in ([], ["--loading", "63.7 %"]):
        SCRIPT.main(["--figure", "2b", "--loadings", "6", *options])
        tables.append(capsys.readouterr().out.splitlines())
    more, fewer = (float(re.split(r"[|(]", lines[5])[2]) for lines in tables)
    assert tables[0][0].startswith("| N | psca variant=paper | psca, generalised |")
    assert fewer > 1.2 * more  # 225 sites, fewer atoms
    assert (tmp_path / "figure-2b.png").is_file()


def test_what_the_text_gives_is_compared_with_what_the_paper_states(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {name: Estimate(paper.value + 0.3, 0.4) for name, paper in SCRIPT.STATED.items()}
    others: dict[str, Any] = {name: Estimate(1.0, 0.1) for name in SCRIPT.SPREADS} | {SCRIPT.SHORT: "88 / 1"}
    monkeypatch.setattr(SCRIPT, "results_at", lambda loading, n_loadings: values | others)
    rows = [line.split(" | ") for line in SCRIPT.statements(10) if line.startswith("|")]
    assert all(len(row) == 6 for row in rows)
    away = [float(row[3]) for row in rows[2:6]]
    assert away == pytest.approx([0.75, 0.75, 0.67, 0.75], abs=0.06)
    assert rows[6][3] == f"{sum(0.09 / (0.16 + p.error**2) for p in SCRIPT.STATED.values()):.0f}"


def test_the_text_is_measured_as_a_plain_loop_does() -> None:
    n = 8
    results = SCRIPT.results_at(0.637, n)
    report = SCRIPT.measured((SCRIPT.PAPERS_PSCA,), (FIGURES["2c"].at(0.637).conditions[-1],), n)
    batches = [
        plan_and_check(psca(variant="paper"), draw((20, 20), 0.637, 1, i), COMPACT, dop=15)[0].n_batches
        for i in range(n)
    ]
    assert results["batches at DOP 15, figure 2(c)"].value == report.rows[0]["n_batches"].value
    assert report.rows[0]["n_batches"].value == pytest.approx(np.mean(batches))
    assert results["s.d. of the batches at DOP 15"].value == pytest.approx(np.std(batches, ddof=1))
