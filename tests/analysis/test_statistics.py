"""Statistics of cycles over shots that are known."""

from __future__ import annotations

import pytest

from labseq.analysis.statistics import statistics_of
from labseq.model.estimate import Rate

from .records import Write, make_shot


def test_each_cycle_counts_the_shots_that_made_it_and_those_that_had_ended_well(write: Write) -> None:
    run = write([make_shot(0), *(make_shot(i, n_defects=i, n_cycles=2) for i in (1, 3))])
    statistics = statistics_of(run.shots, run.target)
    first, second = statistics.cycles
    assert (first.n_shots, first.defect_free, first.seen) == (3, Rate(1, 3), Rate(1, 3))
    assert (second.n_shots, second.defect_free, second.seen) == (2, Rate(0, 2), Rate(1, 3))
    fillings = [1, 5 / 6, 3 / 6]
    assert first.filling.value == pytest.approx(sum(fillings) / 3)
    variance = sum((one - sum(fillings) / 3) ** 2 for one in fillings) / 2
    assert first.filling.error == pytest.approx((variance / 3) ** 0.5)
    assert second.filling.value == pytest.approx((5 / 6 + 3 / 6) / 2)
    assert (first.n_atom_moves.value, second.n_atom_moves.value) == (1, 0)
    assert (first.defects, second.defects) == ((1, 1, 0, 1), (0, 1, 0, 1))
    assert (first.period_s.value, second.period_s.value) == pytest.approx((0.2, 0.1))
