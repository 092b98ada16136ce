"""The kernels of the weighted detector against the same in numpy."""

from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st

from labseq.detection.kernels import undo_neighbours, weigh_sites


@given(
    seed=st.integers(0, 2**32 - 1),
    n_sites=st.integers(1, 30),
    region=st.sampled_from([1, 3, 5, 9]),
    shape=st.tuples(st.integers(9, 40), st.integers(9, 40)),
)
def test_the_weighted_sums_are_numpys(seed: int, n_sites: int, region: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 65536, shape, np.uint16)
    image.flags.writeable = False
    corners = rng.integers(0, np.subtract(shape, region) + 1, (n_sites, 2))
    weights = rng.random((n_sites, region, region), np.float32)
    curve = rng.standard_normal(65536, np.float32)
    constant = rng.standard_normal(n_sites)
    odds = np.empty(n_sites)
    weigh_sites(image, corners, weights, curve, constant, odds)
    for site, (y, x) in enumerate(corners):
        worth = curve[image[y : y + region, x : x + region]].astype(float)
        expected = constant[site] + (weights[site] * worth).sum()
        assert abs(odds[site] - expected) < 1e-5 * region**2


@given(seed=st.integers(0, 2**32 - 1), n_sites=st.integers(1, 30), part=st.floats(0, 1))
def test_neighbours_with_atoms_are_taken_off(seed: int, n_sites: int, part: float) -> None:
    rng = np.random.default_rng(seed)
    effect = rng.random((n_sites, n_sites)) * (rng.random((n_sites, n_sites)) < part)
    starts = np.concatenate([[0], np.cumsum((effect > 0).sum(axis=1))])
    neighbours = np.ascontiguousarray(np.nonzero(effect)[1])
    odds = rng.standard_normal(n_sites)
    before, undone = odds.copy(), np.empty(n_sites)
    undo_neighbours(starts, neighbours, effect[effect > 0], odds, undone)
    np.testing.assert_array_equal(odds, before)
    np.testing.assert_allclose(undone, odds - effect @ (odds > 0), atol=1e-12)
