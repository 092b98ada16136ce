"""The simulated figures 4 and 5 in the docs hold what the page says of them, and can be drawn again."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.analysis.statistics import statistics_of

from .scripts import load_script

ROOT = Path(__file__).parents[2]
TABLES = ROOT / "docs" / "_static" / "paper"
PAGE = (ROOT / "docs" / "explanation" / "virtual-lab.md").read_text(encoding="utf-8")


def test_the_page_is_what_the_script_writes(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    load_script("make_paper_figures").write_page(page)
    assert page.read_text(encoding="utf-8") == PAGE


def test_a_series_grows_by_the_shots_that_are_added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = load_script("make_paper_figures")
    monkeypatch.setattr(script, "FIGURES", tmp_path)
    script.add_5("figure5", "psca", script.Tally([[5, 0], [9, 2]], [[100, 4], [90, 2]]))
    script.add_5("figure5", "psca", script.Tally([[0, 0]], [[80, 3]]))
    first, second = script.table_5("figure5")
    assert (first["shots"], first["defects_0"], first["defects_9"]) == ("3", "1", "1")
    assert float(first["atom_moves"]) == pytest.approx(90)
    assert float(second["filling"]) == pytest.approx(1 - 2 / 3 / 225)
    script.add_5("figure5", "grid", script.Tally([[0, 0]], [[80, 3]]))
    assert [(row["planner"], row["shots"]) for row in script.table_5("figure5")] == [("grid", "1")] * 2


def test_the_tables_name_the_planner_of_their_shots() -> None:
    script = load_script("make_paper_figures")
    planners = {
        name: script.planner_of(script.FIGURE_5, script.SERIES_5[name][1]) for name in script.SERIES_5
    }
    assert planners["figure5"] == script.planner_of(script.FIGURE_4) == "psca variant=paper"
    assert planners["figure5_fewest"] == "psca variant=fewest"
    for name in script.SERIES_5:
        rows = script.table_5(name)
        assert len({row["planner"] for row in rows}) == 1
        assert f"| `{rows[0]['planner']}` | {rows[0]['shots']} |" in PAGE


def test_figure_4_of_another_planner_is_begun_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = load_script("make_paper_figures")
    monkeypatch.setattr(script, "FIGURES", tmp_path)
    monkeypatch.setattr(script, "take_4", lambda dop, window_ms, shots: np.full(len(shots), 0.5))
    old = {"planner": "grid", "dop": 15, "window_ms": 60, "shots": 9, "filling": 1.0, "filling_squared": 1.0}
    script.write_rows(tmp_path / "figure4.csv", [old])
    script.simulate_4(2)
    rows = script.rows_of(tmp_path / "figure4.csv")
    assert len(rows) == len(script.points_4()) == 28
    assert {(row["planner"], row["shots"], float(row["filling"])) for row in rows} == {
        ("psca variant=paper", "2", 0.5)
    }


def test_parts_of_a_point_add_up_to_its_mean_and_error() -> None:
    filling = np.random.default_rng(1).normal(0.97, 0.01, 40)
    point = load_script("make_paper_figures").Filled(0, 0.0, 0.0)
    for part in np.split(filling, [10, 25]):
        point = point.with_shots(part)
    assert point.shots == 40
    assert point.filling == pytest.approx(filling.mean())
    assert point.error == pytest.approx(filling.std() / math.sqrt(40))


def test_the_script_takes_a_point_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = load_script("make_paper_figures")
    whole, rest = script.take_4(15, 60, range(3)), script.take_4(15, 60, range(2, 3))
    assert whole.shape == (3,)
    assert rest.tolist() == whole[2:].tolist()
    for name in ("figure4", "figure5", "figure5_fewest"):
        (tmp_path / f"{name}.csv").write_bytes((TABLES / f"{name}.csv").read_bytes())
    monkeypatch.setattr(script, "FIGURES", tmp_path)
    script.draw_4(tmp_path / "figure4.png")
    script.draw_5(tmp_path / "figure5.png")
    assert (tmp_path / "figure4.png").stat().st_size > 10_000
    assert (tmp_path / "figure5.png").stat().st_size > 10_000


def take(folder: Path, name: str, shots: int) -> Path:
    sequence, profile = ROOT / "sequences" / f"{name}.yaml", ROOT / "hardware_profiles" / "virtual.yaml"
    with labseq.Session.open(
        sequence, profile=str(profile), shots=shots, seed=1, output=folder, overrides=["record_frames=none"]
    ) as session:
        return session.run().path


def test_runs_are_drawn_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = load_script("make_paper_figures")
    drawn: dict[str, tuple[Any, ...]] = {}
    for name in ("draw_figure_4", "draw_figure_5"):
        monkeypatch.setattr(script, name, lambda *data, name=name: drawn.__setitem__(name, data))
    cycles, dops = take(tmp_path, "figure5_multicycle", 5), take(tmp_path, "figure4_dop_scan", 28)
    script.main(["--figure", "5", str(cycles), str(cycles)])
    _, _, (series, other), defects, quoted, ceiling = drawn["draw_figure_5"]
    run = labseq.open_run(cycles)
    of_cycles = statistics_of(run.shots, run.target).cycles
    assert series.y.tolist() == [cycle.defect_free.value for cycle in of_cycles]
    assert (series.low <= series.y).all()
    assert (series.y <= series.high).all()
    assert other.label.startswith(run.path.name)
    assert defects[0].sum() == 5
    assert quoted.y.tolist() == [0.015, 0.169, 0.33]
    assert ceiling.y[0] == ceiling.y.min()  # the first cycle takes longest
    assert ((ceiling.y > 0.25) & (ceiling.y < 0.36)).all()
    script.main(["--figure", "4", str(dops)])
    _, _, (fixed,), (own,), windows, _ = drawn["draw_figure_4"]
    assert fixed.x.tolist() == own.x.tolist() == list(range(2, 16))
    assert (fixed.label, own.label) == ("window 200 ms", "windows 60 to 106 ms")
    assert windows.y[[0, -1]] == pytest.approx(np.exp([-0.106 / 33, -0.06 / 33]))


@pytest.mark.parametrize(
    ("name", "shots", "figure", "message"),
    [
        ("compact_225", 2, "5", "figure 5 needs shots that all make every cycle"),
        ("compact_225", 1, "4", "figure 4 needs a scan of planner.degree_of_parallelism"),
    ],
)
def test_other_runs_are_refused(tmp_path: Path, name: str, shots: int, figure: str, message: str) -> None:
    script = load_script("make_paper_figures")
    with pytest.raises(SystemExit, match=message):
        script.main(["--figure", figure, str(take(tmp_path, name, shots))])
