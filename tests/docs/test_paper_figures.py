"""The simulated figures 4 and 5 in the docs hold what the page says of them, and can be drawn again."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from .scripts import load_script

ROOT = Path(__file__).parents[2]
TABLES = ROOT / "docs" / "_static" / "paper"
PAGE = (ROOT / "docs" / "explanation" / "virtual-lab.md").read_text(encoding="utf-8")


def rows(name: str) -> list[dict[str, float]]:
    with (TABLES / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def fillings(*, fixed: bool) -> dict[int, float]:
    return {int(row["dop"]): row["filling"] for row in rows("figure4") if (row["window_ms"] == 200) == fixed}


def test_degree_seven_is_on_a_plateau() -> None:
    own = fillings(fixed=False)
    assert own[7] > max(own.values()) - 0.001
    assert min(row["shots"] for row in rows("figure4")) == 20_000


def test_filling_declines_in_the_fixed_window_with_a_step_at_thirteen() -> None:
    fixed = fillings(fixed=True)
    assert fixed[3] > fixed[7] > fixed[11] > fixed[12] > fixed[13] > fixed[15]
    steps = {dop: fixed[dop - 1] - fixed[dop] for dop in range(4, 16)}
    assert max(steps, key=lambda dop: steps[dop]) == 13


@pytest.mark.parametrize(
    ("cycle", "paper", "within"), [(1, 0.015, 0.005), (2, 0.169, 0.04), (10, 0.33, 0.04)]
)
def test_figure_five_is_as_near_to_the_paper_as_the_page_says(
    cycle: int, paper: float, within: float
) -> None:
    row = rows("figure5")[cycle - 1]
    assert row["shots"] == 10_000
    assert row["defects_0"] / row["shots"] == pytest.approx(paper, abs=within)


def test_the_page_has_the_numbers_of_the_tables() -> None:
    for values in (fillings(fixed=True), fillings(fixed=False)):
        assert " | ".join(f"{100 * values[dop]:.2f}" for dop in sorted(values)) in PAGE
    for name in ("figure5", "figure5_untuned"):
        table = rows(name)
        assert f"{100 * table[0]['filling']:.2f} %" in PAGE
        for cycle in (2, 10):
            assert f"{table[cycle - 1]['defects_0'] / 100:.1f}(" in PAGE


def test_the_script_takes_a_point_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = load_script("make_paper_figures")
    assert script.point(15, 60, 3, 1)["shots"] == 3
    for name in ("figure4", "figure5", "figure5_untuned"):
        (tmp_path / f"{name}.csv").write_bytes((TABLES / f"{name}.csv").read_bytes())
    monkeypatch.setattr(script, "FIGURES", tmp_path)
    script.draw_4(tmp_path / "figure4.png")
    script.draw_5(tmp_path / "figure5.png")
    assert (tmp_path / "figure4.png").stat().st_size > 10_000
    assert (tmp_path / "figure5.png").stat().st_size > 10_000
