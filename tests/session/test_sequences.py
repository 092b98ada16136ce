"""Every sequence that comes with labseq is accepted and runs."""

from __future__ import annotations

from pathlib import Path

import pytest

import labseq
from labseq.session import check

ROOT = Path(__file__).parents[2]
SEQUENCES = sorted((ROOT / "sequences").glob("*.yaml"))
EACH = pytest.mark.parametrize("sequence", SEQUENCES, ids=lambda path: path.stem)
FIGURE_6 = ("kagome", "honeycomb", "link_kagome", "sierpinski", "lion_head")


def test_each_array_of_the_papers_figure_6_has_a_sequence() -> None:
    assert {*FIGURE_6, "compact_225"} <= {path.stem for path in SEQUENCES}


@EACH
def test_it_is_accepted_without_a_warning_and_runs(sequence: Path, tmp_path: Path) -> None:
    with labseq.Session.open(sequence, shots=3, seed=1, output=tmp_path) as session:
        assert not check(session).warnings
        run = session.run()
    assert run.status == "complete"
    assert all(len(shot.plans) >= 1 for shot in run.shots)
    assert min(shot.filling_fraction for shot in run.shots) > 0.96


@pytest.mark.parametrize("name", FIGURE_6)
def test_the_atoms_are_enough_for_it_and_some_are_left_to_mend_it(name: str) -> None:
    target = labseq.Session.open(ROOT / "sequences" / f"{name}.yaml").assembly.target
    n_loaded, five_sigma = 0.75 * target.fill.size, 5 * (0.75 * 0.25 * target.fill.size) ** 0.5
    assert target.n_atoms < n_loaded - five_sigma
    assert (~target.fill & ~target.clear).sum() > 100
