from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.model import SiteGrid
from labseq.motion.overlay import (
    SurvivalShape,
    covariance,
    deviance_residuals,
    dispersion,
    distance_m,
    unit_axes,
)

SHAPE = SurvivalShape(0.95e-6, 0.12e-6, floor=0.02, ceiling=0.97)


def test_a_shape_comes_back_from_its_calibration() -> None:
    assert SurvivalShape.from_values(SHAPE.values()) == SHAPE
    assert SurvivalShape.from_values({"offset_m": [0.0, 0.0]}) is None


@pytest.mark.parametrize(("lattice", "far"), [("triangular", 3**0.5), ("square", 2**0.5)])
def test_distances_are_those_in_the_plane(lattice: str, far: float) -> None:
    grid = SiteGrid(3, 3, lattice=lattice)  # pyright: ignore[reportArgumentType]
    offsets = np.array([[1.0, 0.0], [0.0, 2.0], [1.0, 1.0]])
    assert distance_m(offsets, unit_axes(grid)) == pytest.approx([1.0, 2.0, far])


@given(st.integers(1, 500), st.floats(0.001, 0.999), st.floats(0, 1))
def test_residuals_are_the_roots_of_the_deviance(n: int, p: float, share: float) -> None:
    k = round(share * n)
    (residual,) = deviance_residuals(np.array([k]), np.array([n]), np.array([p]))

    def log_likelihood(q: float) -> float:
        return (k * np.log(q) if k else 0.0) + ((n - k) * np.log(1 - q) if n - k else 0.0)

    deviance = 2 * (log_likelihood(k / n) - log_likelihood(p))
    assert residual**2 == pytest.approx(deviance, rel=1e-6, abs=1e-9)
    assert residual * (k / n - p) >= 0


def test_the_covariance_of_a_share_is_binomial() -> None:
    n = np.array([100.0, 300.0])
    spread = covariance(np.array([0.2]), n, lambda theta: np.full(2, theta[0]), np.array([1e3]))
    assert spread[0, 0] == pytest.approx(0.2 * 0.8 / 400)


def test_counts_that_scatter_more_than_binomial_ones_are_noticed() -> None:
    rng = np.random.default_rng(1)
    n, p = np.full(2000, 200.0), np.full(2000, 0.5)
    binomial = rng.binomial(200, p).astype(np.float64)
    common = rng.binomial(200, np.clip(p + rng.normal(0, 0.05, 2000), 0, 1)).astype(np.float64)
    assert dispersion(binomial, n, p, 0) == pytest.approx(1.0, abs=0.15)
    assert dispersion(common, n, p, 0) == pytest.approx(1 + 200 * 0.05**2 / 0.25, rel=0.15)
