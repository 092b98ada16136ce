from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.calibration.methods import fit_frequencies, smoothed
from labseq.errors import DeviceError
from labseq.model import MotionSpec, RfSpec, SiteGrid

GRID = SiteGrid(12, 16)
HZ_PER_M = 1.6e6 / GRID.spacing_m
MOTION = MotionSpec(rf=RfSpec(snap_within_m=0.0))


def hidden(rng: np.random.Generator, scatter_m: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """How far rows and columns stand beside their sites: a bow, a slope and a scatter."""
    row, col = np.linspace(-1, 1, GRID.n_rows), np.linspace(-1, 1, GRID.n_cols)
    return (
        0.08e-6 + 0.05e-6 * row + 0.03e-6 * row**2 + rng.normal(0, scatter_m, len(row)),
        -0.12e-6 + 0.06e-6 * col**2 + rng.normal(0, scatter_m, len(col)),
    )


def probe(atoms: Any, rows: Any, cols: Any, n_shots: int, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    offset = atoms.scan(1.6e-6, 13)
    beside = np.stack(np.broadcast_arrays(cols, rows[:, None]), axis=-1)
    share = atoms.survival_at(offset[:, None, None], beside, GRID)
    n = rng.binomial(n_shots, 0.75, share.shape)
    return offset, n, rng.binomial(n, share)


def test_tones_that_were_found_put_the_tweezers_onto_the_sites(atoms: Any) -> None:
    rng = np.random.default_rng(2)
    rows, cols = hidden(rng, 20e-9)
    fit = fit_frequencies(*probe(atoms, rows, cols, 10, rng), GRID, MOTION)
    for hz, site_hz, stood in (
        (fit.row_hz, GRID.row_frequency_hz, rows),
        (fit.column_hz, GRID.column_frequency_hz, cols),
    ):
        assert (hz - site_hz) / HZ_PER_M + stood == pytest.approx(np.zeros(len(hz)), abs=35e-9)
    better = replace(GRID, row_frequency_hz=fit.row_hz, column_frequency_hz=fit.column_hz)
    left_rows, left_cols = rows - fit.row_offset_m, cols - fit.column_offset_m
    again = fit_frequencies(*probe(atoms, left_rows, left_cols, 10, rng), better, MOTION)
    assert np.abs(again.overlay.centre_m).max() < 10e-9
    assert again.error_m < 15e-9


def test_errors_cover_the_truth_as_often_as_they_should(atoms: Any) -> None:
    rng = np.random.default_rng(4)
    pulls = []
    for _ in range(5):
        rows, cols = hidden(rng, 25e-9)
        fit = fit_frequencies(*probe(atoms, rows, cols, 6, rng), GRID, MOTION)
        pulls += [*(fit.row_offset_m - rows) / fit.row_error_m]
        pulls += [*(fit.column_offset_m - cols) / fit.column_error_m]
    assert 0.55 < np.mean(np.abs(pulls) < 1) < 0.8


def test_losses_common_to_a_shot_widen_the_errors_of_rows_and_columns(atoms: Any) -> None:
    errors_m: list[float] = []
    for least in (1.0, 0.75):  # survival of the shots, for any other reason
        rng = np.random.default_rng(3)
        offset, n, k = probe(atoms, *hidden(rng, 25e-9), 10, rng)
        k = rng.binomial(k, rng.uniform(least, 1.0, len(offset))[:, None, None])
        fit = fit_frequencies(offset, n, k, GRID, MOTION)
        errors_m.append(float(np.mean([*fit.row_error_m, *fit.column_error_m])))
    assert errors_m[1] > 1.28 * errors_m[0]  # 1.17 by the fewer atoms alone


def test_a_row_without_atoms_takes_the_place_of_its_neighbours(atoms: Any) -> None:
    rng = np.random.default_rng(5)
    rows, cols = hidden(rng, 5e-9)
    offset, n, k = probe(atoms, rows, cols, 10, rng)
    n[:, 7], k[:, 7] = 0, 0
    fit = fit_frequencies(offset, n, k, GRID, MOTION)
    assert fit.row_offset_m[7] == pytest.approx(rows[7], abs=30e-9)


def test_too_few_atoms_are_refused(atoms: Any) -> None:
    rng = np.random.default_rng(6)
    offset, n, k = probe(atoms, np.zeros(12), np.zeros(16), 4, rng)
    with pytest.raises(DeviceError, match=r"rows and columns are only known to .* nm; for .* take \d+ times"):
        fit_frequencies(offset, n, k, GRID, MOTION, worst_error_m=0.5e-9)


def test_counts_of_another_grid_are_refused(atoms: Any) -> None:
    offset = atoms.scan()
    with pytest.raises(ValueError, match=r"expected \(n_points, 12, 16\)"):
        fit_frequencies(offset, np.ones((30, 4, 4)), np.ones((30, 4, 4)), GRID, MOTION)


@settings(max_examples=25, deadline=None)
@given(st.integers(3, 30), st.floats(-1, 1), st.integers(0, 2**32 - 1))
def test_an_even_row_stays_where_it_is(n: int, height: float, seed: int) -> None:
    errors = np.random.default_rng(seed).uniform(0.01, 1.0, n)
    value, error = smoothed(np.full(n, height), errors)
    assert value == pytest.approx(np.full(n, height), abs=1e-9)
    assert (error <= errors * (1 + 1e-9)).all()


def test_one_that_truly_stands_apart_is_kept() -> None:
    values = np.zeros(20)
    values[4] = 1.0
    value, error = smoothed(values, np.full(20, 0.01))
    assert value[4] == pytest.approx(1.0)
    assert error[4] == pytest.approx(0.01)


def test_noise_is_smoothed_and_scatter_is_not() -> None:
    rng = np.random.default_rng(7)
    noise, scatter = rng.normal(0, 0.1, 40), rng.normal(0, 0.1, 40)
    quiet, _ = smoothed(noise, np.full(40, 0.1))
    rough, _ = smoothed(scatter, np.full(40, 0.01))
    assert quiet.std() < 0.06
    assert rough == pytest.approx(scatter, abs=0.02)


@pytest.mark.parametrize("n", [1, 2])
def test_a_grid_of_one_or_two_rows_has_its_own_values(n: int) -> None:
    value, error = smoothed(np.arange(n, dtype=float), np.full(n, 0.01))
    assert value == pytest.approx(np.arange(n), abs=0.02)
    assert (error > 0).all()
