"""The most that losses and detection leave of an array."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from .scripts import load_script

script = load_script("make_paper_figures")
AtomLosses, max_defect_free = script.AtomLosses, script.max_defect_free

PAPER = AtomLosses(lifetime_s=33.0, imaging_loss=0.00314, imaging_loss_exposure_s=0.045)
GIVEN: dict[str, Any] = {"lifetime": 33.0, "imaging_loss": 0.00314, "imaging_loss_exposure": 0.045}


def perfect_rearrangement(
    n_shots: int, n_atoms: int, period_s: float, losses: Any, seed: int
) -> float:  # fmt: skip
    """Share of the shots seen defect-free in the end, if every move succeeds: atom by atom."""
    rng = np.random.default_rng(seed)
    there = np.ones((n_shots, n_atoms), np.bool_)
    seen = there
    for _ in range(6):
        lost = rng.random(there.shape) < losses.imaging_loss
        has_shone = ~lost | (rng.random(there.shape) > 0.4)  # lost atoms, until they were bright enough
        missed = rng.random(there.shape) < (losses.false_negative or 0.0)
        seen = there & has_shone & ~missed
        there &= ~lost
        there = np.where(seen, there, ~there)  # the second atom on a site takes the first with it
        there &= rng.random(there.shape) < np.exp(-period_s / losses.lifetime_s)
    return float(seen.all(axis=1).mean())


@pytest.mark.parametrize("missed", [None, 5e-4])
@pytest.mark.parametrize("period_s", [0.05, 0.2])
def test_perfect_rearrangement_reaches_it(period_s: float, missed: float | None) -> None:
    losses = PAPER._replace(false_negative=missed)
    n_shots = 3_000
    reached = perfect_rearrangement(n_shots, 225, period_s, losses, seed=3)
    most = max_defect_free(225, period_s, 0.045, losses)
    assert reached == pytest.approx(most, abs=4 * np.sqrt(most * (1 - most) / n_shots))


def test_the_losses_are_those_that_the_simulation_tells() -> None:
    assert AtomLosses.of({"simulation": GIVEN}) == PAPER
    assert AtomLosses.of({"simulation": {**GIVEN, "false_negative": 6e-5}}) == PAPER._replace(
        false_negative=6e-5
    )
