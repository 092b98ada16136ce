"""Every sequence that comes with labseq is accepted and runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import labseq
from labseq.session.check import check

ROOT = Path(__file__).parents[2]
SEQUENCES = sorted((ROOT / "sequences").glob("*.yaml"))
EACH = pytest.mark.parametrize("sequence", SEQUENCES, ids=lambda path: path.stem)
FIGURE_6 = ("kagome", "honeycomb", "link_kagome", "sierpinski", "lion_head")


def test_each_array_of_the_papers_figure_6_has_a_sequence() -> None:
    assert {*FIGURE_6, "compact_225"} <= {path.stem for path in SEQUENCES}


@EACH
def test_it_is_accepted_without_a_warning_and_runs(sequence: Path, tmp_path: Path) -> None:
    dry_run = "full" if sequence.stem == "follow" else "off"  # it waits for another program
    with labseq.Session.open(sequence, shots=1, seed=1, output=tmp_path, dry_run=dry_run) as session:
        warnings = [one.what for one in check(session).warnings]
        if sequence.stem == "climb_dop_speed":  # goes to speeds at which the tweezers fade
            assert "above 269 um/ms" in warnings.pop()
        assert not warnings
        run = session.run()
    assert run.status == "complete"
    if "rearrange" not in sequence.read_text("utf-8"):
        return
    assert all(len(shot.plans) >= 1 for shot in run.shots)
    assert min(run.target.filling_fraction(shot.occupancies[-1]) for shot in run.shots) > 0.94


@pytest.mark.parametrize("name", FIGURE_6)
def test_the_atoms_are_enough_and_some_are_left_for_repairs(name: str) -> None:
    target = labseq.Session.open(ROOT / "sequences" / f"{name}.yaml").assembly.target
    n_loaded, five_sigma = 0.75 * target.fill.size, 5 * (0.75 * 0.25 * target.fill.size) ** 0.5
    assert target.n_atoms < n_loaded - five_sigma
    assert (~target.fill & ~target.clear).sum() > 100


@pytest.mark.parametrize("name", ["figure4_dop_scan", "figure5_multicycle"])
def test_figures_of_the_paper_are_planned_as_its_text_says(name: str) -> None:
    planner = labseq.Session.open(ROOT / "sequences" / f"{name}.yaml").assembly.planner.dump()
    assert (planner["use"], planner["variant"], planner["row_order"]) == ("psca", "paper", "half_filled")


@pytest.mark.parametrize("dop", [2, 4, 7])
def test_nearly_all_plans_fit_the_own_windows_of_figure_4(dop: int) -> None:
    scan = labseq.Session.open(ROOT / "sequences" / "figure4_dop_scan.yaml").assembly
    assert scan.scanned is not None
    points = [scan.at(i).parameters for i in range(scan.scanned.scan.n_points)]
    windows_s = {
        point["shot.2.rearrange.window"] for point in points if point["planner.degree_of_parallelism"] == dop
    }
    session = labseq.Session.open(
        ROOT / "sequences" / "compact_225.yaml",
        profile=str(ROOT / "hardware_profiles" / "paper.yaml"),
        overrides=[f"planner.degree_of_parallelism={dop}", "planner.variant=paper"],
    )
    rehearsal = check(session).rehearsal
    assert rehearsal is not None
    own_s = min(windows_s)
    assert max(windows_s) == 0.2
    assert np.count_nonzero(rehearsal.duration_s <= own_s) >= 0.97 * rehearsal.n_loadings
    assert own_s == 0.06 or np.count_nonzero(rehearsal.duration_s > 0.93 * own_s) > 0
