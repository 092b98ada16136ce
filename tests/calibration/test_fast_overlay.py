from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.builtin.overlay import FastOffset, SurvivalShape, fast_offset, group_counts
from labseq.model import SiteGrid
from labseq.motion.hold import cross_offsets_m

GRID = SiteGrid(20, 20)
ALL = np.ones(GRID.shape, np.bool_)
OFFSETS = cross_offsets_m(GRID.shape, (0.9e-6, 0.9e-6))
SHAPE = SurvivalShape(0.928e-6, 0.228e-6, 0.02, 0.966)
"""What the fit of an overlay finds of these atoms."""


def shot(atoms: Any, hidden: Any, rng: np.random.Generator, offsets: Any = OFFSETS) -> FastOffset:
    before = rng.random(GRID.shape) < 0.75
    after = before & (rng.random(GRID.shape) < atoms.survival_at(offsets, np.asarray(hidden), GRID))
    return fast_offset(*group_counts(offsets, before, after), SHAPE, GRID)


def test_one_shot_finds_a_small_shift_to_thirty_nanometres(atoms: Any) -> None:
    rng = np.random.default_rng(1)
    for hidden in ((60e-9, -40e-9), (-80e-9, 0.0)):
        found = [shot(atoms, hidden, rng) for _ in range(25)]
        offsets = np.array([one.offset_m for one in found])
        errors = np.array([one.error_m for one in found])
        assert offsets.mean(axis=0) == pytest.approx(hidden, abs=10e-9)
        assert (offsets.std(axis=0) < 45e-9).all()
        assert np.mean([one.fits for one in found]) > 0.99
        assert 0.5 < np.mean(np.abs(offsets - hidden) < errors) < 0.85


@given(st.floats(0.25e-6, 0.9e-6), st.floats(0, 2 * np.pi), st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_a_large_shift_is_never_found_small(atoms: Any, far: float, angle: float, seed: int) -> None:
    place = far * np.array([np.cos(angle), np.sin(angle)])
    hidden = np.linalg.solve((GRID.axes / GRID.spacing_m).T, place)
    found = shot(atoms, hidden, np.random.default_rng(seed))
    assert found.length_m > 0.1e-6 or not found.fits


def test_another_temperature_is_no_shift(atoms: Any) -> None:
    """A peak that is wider on all sides leaves the centre where it is."""
    kinds, n, _ = group_counts(OFFSETS, ALL, ALL)
    k = np.rint(n * atoms.survival_at(kinds * 0.9, np.zeros(2), GRID)).astype(np.int64)
    assert np.abs(fast_offset(kinds, n, k, SHAPE, GRID).offset_m).max() < 5e-9


def test_without_atoms_nothing_is_known() -> None:
    none = ~ALL
    found = fast_offset(*group_counts(OFFSETS, none, none), SHAPE, GRID)
    assert np.isnan(found.offset_m).all()
    assert np.isinf(found.error_m).all()
    assert found.n_atoms == 0


def test_survivors_are_counted_by_offset() -> None:
    before = np.array([[1, 1, 1, 1], [1, 0, 0, 1]], np.bool_)
    after = np.array([[1, 0, 0, 1], [0, 1, 0, 1]], np.bool_)
    kinds, n, k = group_counts(cross_offsets_m((2, 4), (2.0, 3.0)), before, after)
    assert kinds.tolist() == [[-2.0, 0.0], [0.0, -3.0], [0.0, 3.0], [2.0, 0.0]]
    assert (n.tolist(), k.tolist()) == ([2, 1, 1, 2], [1, 1, 0, 1])
