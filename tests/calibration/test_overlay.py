from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.builtin.overlay import fit_overlay, overlay_offset
from labseq.errors import DeviceError
from labseq.model import SiteGrid
from labseq.motion import correct_overlay

GRIDS = {lattice: SiteGrid(20, 20, lattice=lattice) for lattice in ("triangular", "square")}  # type: ignore[arg-type]
GRID = GRIDS["triangular"]


def probe(
    atoms: Any, offset: Any, hidden: Any, n_atoms: int, seed: int, grid: SiteGrid = GRID
) -> tuple[NDArray[Any], NDArray[Any]]:
    rng = np.random.default_rng(seed)
    n = np.full(len(offset), n_atoms)
    return n, rng.binomial(n, atoms.survival_at(offset, np.asarray(hidden), grid))


@pytest.mark.parametrize("lattice", GRIDS)
@given(
    hidden=st.tuples(*[st.floats(-0.25e-6, 0.25e-6)] * 2),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=8, deadline=None)
def test_a_hidden_offset_is_found_to_a_few_of_its_errors(
    atoms: Any, lattice: str, hidden: tuple[float, float], seed: int
) -> None:
    grid, offset = GRIDS[lattice], atoms.scan(1.6e-6, 17)
    fit = fit_overlay(offset, *probe(atoms, offset, hidden, 300, seed, grid), grid)
    off = np.abs(overlay_offset(fit.centre_m) - hidden)
    assert (off < 5 * fit.error_m).all()
    assert off.max() < 50e-9
    assert fit.error_m.max() < 25e-9
    assert fit.shape.half_width_m == pytest.approx(0.93e-6, rel=0.05)


def test_errors_cover_the_truth_as_often_as_they_should(atoms: Any) -> None:
    offset, hidden = atoms.scan(), np.array([0.12e-6, -0.07e-6])
    pulls = []
    for seed in range(30):
        fit = fit_overlay(offset, *probe(atoms, offset, hidden, 120, seed), GRID)
        pulls.append((fit.centre_m + hidden) / fit.error_m)
    within = np.abs(pulls) < 1
    assert 0.55 < within.mean() < 0.85  # 60 values: 0.68 within 3 s.d.
    assert abs(np.mean(pulls)) < 0.3


def test_an_offset_that_was_found_is_undone(atoms: Any) -> None:
    """Twice round, through the tones: what the second scan finds is what the first one left."""
    hidden, in_use = np.array([0.21e-6, -0.16e-6]), np.zeros(2)
    offset = atoms.scan()
    for seed in (1, 2):
        grid = correct_overlay(GRID, in_use)
        moved = np.array(
            [
                grid.column_frequency_hz[0] - GRID.column_frequency_hz[0],
                grid.row_frequency_hz[0] - GRID.row_frequency_hz[0],
            ]
        )
        stands = hidden + moved / 1.6e6 * GRID.spacing_m
        fit = fit_overlay(offset, *probe(atoms, offset, stands, 1500, seed), grid)
        in_use = overlay_offset(fit.centre_m, in_use)
        assert in_use == pytest.approx(hidden, abs=12e-9)
    assert fit.centre_m == pytest.approx([0, 0], abs=12e-9)


def test_losses_common_to_a_shot_widen_the_errors(atoms: Any) -> None:
    offset, rng = atoms.scan(), np.random.default_rng(3)
    n = np.full(len(offset), 300)
    share = atoms.survival_at(offset, np.zeros(2), GRID) * rng.uniform(0.75, 1.0, len(offset))
    even = fit_overlay(offset, *probe(atoms, offset, (0, 0), 300, 3), GRID)
    uneven = fit_overlay(offset, n, rng.binomial(n, share), GRID)
    assert uneven.dispersion > 3
    assert uneven.error_m.min() > 1.5 * even.error_m.max()
    assert uneven.centre_m == pytest.approx([0, 0], abs=4 * uneven.error_m.max())


def test_the_far_side_of_the_ring_does_not_pull_the_centre(atoms: Any) -> None:
    offset, hidden = atoms.scan(2.4e-6, 25), np.array([0.5e-6, 0.0])
    fit = fit_overlay(offset, *probe(atoms, offset, hidden, 600, 5), GRID)
    assert fit.centre_m == pytest.approx(-hidden, abs=15e-9)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_without_a_peak_there_is_no_overlay(atoms: Any, share: float) -> None:
    offset = atoms.scan()
    n = np.full(len(offset), 200)
    k = np.random.default_rng(1).binomial(n, share)
    with pytest.raises(DeviceError, match=r"there is no survival peak, .* \(.*% in all\); scan further"):
        fit_overlay(offset, n, k, GRID)


@pytest.mark.parametrize(
    ("hidden", "message"),
    [
        ((0.6e-6, 0.0), r"only one edge .* in range along a row, .* at -1.4 um; continue in direction -"),
        ((-0.6e-6, 0.0), r"only one edge .* in range along a row, .* at 1.4 um; continue in direction \+"),
        ((0.0, 0.6e-6), r"only one edge .* from row to row, .* at -1.4 um; continue in direction -"),
        ((1.0e-6, 0.0), r"only one edge .* in range along a row, .* continue in direction -"),
        ((0.5e-6, 1.1e-6), r"misses the survival peak; scan about -.* along a row and -1.* from row to row"),
    ],
)
def test_a_peak_out_of_range_says_where_to_scan(atoms: Any, hidden: Any, message: str) -> None:
    offset = atoms.scan()
    grid = GRIDS["square"]
    with pytest.raises(DeviceError, match=message):
        fit_overlay(offset, *probe(atoms, offset, hidden, 1000, 1, grid), grid)


def test_few_atoms_are_refused_with_how_many_more(atoms: Any) -> None:
    offset = atoms.scan()
    with pytest.raises(DeviceError, match="only 60 atoms were probed, but 100 are needed"):
        fit_overlay(offset, *probe(atoms, offset, (0, 0), 2, 1), GRID)
    counts = probe(atoms, offset, (0, 0), 40, 1)
    with pytest.raises(DeviceError, match=r"the centre is only known to .* nm; for 2 nm take \d+ times"):
        fit_overlay(offset, *counts, GRID, worst_error_m=2e-9)


def test_both_axes_must_be_scanned(atoms: Any) -> None:
    offset = atoms.scan()[:15]
    with pytest.raises(DeviceError, match="the offset from row to row has fewer than 5 values"):
        fit_overlay(offset, *probe(atoms, offset, (0, 0), 100, 1), GRID)


@pytest.mark.parametrize(
    ("offset", "n", "k"),
    [
        (np.zeros((3, 2)), [1, 2], [1, 1]),
        (np.zeros(3), [1, 2, 3], [1, 1, 1]),
        (np.zeros((2, 2)), [1, 2], [1, 3]),
        (np.zeros((2, 2)), [1, 2], [-1, 2]),
        (np.full((2, 2), np.nan), [1, 2], [1, 2]),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(offset: Any, n: Any, k: Any) -> None:
    with pytest.raises(ValueError, match=r"do not match|no more atoms may survive"):
        fit_overlay(offset, n, k, GRID)
