"""The weighted detector."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.detection.sites import site_pixels
from labseq.detection.weighted import WeightedDetector, WeightedSettings
from labseq.model import Frame, SiteGrid
from labseq.roles import Context, NeedsWarmUp
from labseq.testing import DetectorContract

Bools = NDArray[np.bool_]
Images = NDArray[np.uint16]

GRID = SiteGrid(3, 4)
SMALL: dict[str, Any] = {"frame": (60, 90), "centre_px": (29.5, 44.5)}
CLOSE = SiteGrid(3, 4, spacing_m=1.9e-6)
SQUARE = SiteGrid(3, 4, spacing_m=2.2e-6, lattice="square")
LIGHT = 3600.0  # counts of 60 photoelectrons


class TestWeightedDetector(DetectorContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], WeightedDetector]:
        return partial(WeightedDetector, WeightedSettings())


@cache
def detector(grid: SiteGrid = GRID, **settings: Any) -> WeightedDetector:
    """One for equal arguments: the weights take a while."""
    return WeightedDetector(WeightedSettings(**SMALL | settings), Context("detector", grid))


def mean_image(atoms: Bools, grid: SiteGrid = GRID, light: float = LIGHT) -> Images:
    """Mean counts, without noise."""
    y, x = np.indices((60, 90))
    image = np.full((60, 90), 500 + 0.375 * 60)
    for place_y, place_x in site_pixels(grid, 0.35e-6, (29.5, 44.5))[atoms]:
        spot = np.exp(-((y - place_y) ** 2 + (x - place_x) ** 2) / (2 * 1.2**2))
        image += light * spot / spot.sum()
    return image.astype(np.uint16)


def noisy(image: Images, rng: np.random.Generator) -> Images:
    """The same with the noise of an EMCCD."""
    electrons = rng.poisson(np.maximum(image - 500.0, 0.0) / 60)
    return (500.5 + 60 * rng.gamma(electrons) + rng.normal(0, 16, image.shape)).astype(np.uint16)


def frame(image: Images) -> Frame:
    return Frame(image, 45e-3, 0.0)


def naive(known: WeightedDetector, image: Images) -> NDArray[np.float64]:
    """The same sums, site by site in numpy."""
    w, region = known._ready(), known._settings.region
    odds = w.constant.copy()
    for site, (y, x) in enumerate(known._corners):
        odds[site] += (w.pixels[site] * w.curve[image[y : y + region, x : x + region]]).sum(dtype=float)
    undone = odds + w.expected
    for site in range(len(odds)):
        for k in range(w.starts[site], w.starts[site + 1]):
            undone[site] -= w.effects[k] * (odds[w.neighbours[k]] > 0)
    return undone.reshape(known._grid.shape)


PATTERNS = st.lists(st.booleans(), min_size=12, max_size=12).map(lambda x: np.array(x).reshape(3, 4))


@settings(max_examples=10)
@given(PATTERNS, st.sampled_from([GRID, CLOSE, SQUARE]))
def test_bright_sites_hold_atoms(atoms: Bools, grid: SiteGrid) -> None:
    occupancy, confidence, *_ = detector(grid).detect(frame(mean_image(atoms, grid)))
    np.testing.assert_array_equal(occupancy, atoms)
    assert occupancy.flags.c_contiguous
    assert (confidence > 0.99).all()


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), brightest=st.integers(1, 65536), grid=st.sampled_from([GRID, CLOSE]))
def test_the_log_odds_are_numpys(seed: int, brightest: int, grid: SiteGrid) -> None:
    image = np.random.default_rng(seed).integers(0, brightest, (60, 90), np.uint16)
    known = detector(grid)
    np.testing.assert_allclose(known.signals(frame(image)), naive(known, image), rtol=1e-4, atol=1e-3)


def test_neighbours_light_is_undone() -> None:
    """An empty site among six atoms at 4.5 spot widths looks like one that is alone."""
    known, rng = detector(CLOSE), np.random.default_rng(1)
    alone, among = np.zeros((3, 4), np.bool_), np.ones((3, 4), np.bool_)
    among[1, 1] = False
    few, many = (
        np.mean([known.signals(frame(noisy(mean_image(atoms, CLOSE), rng)))[1, 1] for _ in range(100)])
        for atoms in (alone, among)
    )
    weights = known._ready()
    from_neighbours = weights.effects[weights.starts[5] : weights.starts[6]]
    assert len(from_neighbours) == 6
    assert abs(many - few) < from_neighbours.sum() / 4


def test_the_log_odds_of_dim_overlapping_spots_are_right_on_average() -> None:
    """At one width and a half apart, each site has as many atoms as the probabilities promise."""
    grid, n, rng = SiteGrid(3, 4, spacing_m=1.2e-6), 100, np.random.default_rng(3)
    known = detector(grid, filling=0.5, photoelectrons=20.0)
    surplus: list[float] = []
    for _ in range(n):
        atoms = rng.random(grid.shape) < 0.5
        image = noisy(mean_image(atoms, grid, LIGHT / 3), rng)
        surplus.append(float((1 / (1 + np.exp(-known.signals(frame(image)))) - atoms).mean()))
    assert abs(np.mean(surplus)) < 4 * np.std(surplus) / np.sqrt(n)


def test_the_place_between_the_pixels_counts() -> None:
    weights = detector(SiteGrid(1, 1), centre_px=(29.7, 45.0))._ready().pixels[0]
    above, below = weights[:4].sum(), weights[5:].sum()
    assert above > 1.1 * below


def test_the_confidence_is_the_probability_of_being_right() -> None:
    known = detector()
    image = np.random.default_rng(5).integers(480, 800, (60, 90), np.uint16)
    log_odds = known.signals(frame(image))
    _, confidence, *_ = known.detect(frame(image))
    probability = 1 / (1 + np.exp(-np.abs(log_odds)))
    np.testing.assert_allclose(confidence, 2 * probability - 1, rtol=1e-5)


def test_log_odds_at_the_threshold_are_no_atom_and_no_confidence() -> None:
    image = mean_image(np.eye(3, 4, dtype=np.bool_))
    log_odds = detector().signals(frame(image))
    occupancy, confidence, *_ = detector(threshold=tuple(map(tuple, log_odds.tolist()))).detect(frame(image))
    assert not occupancy.any()
    assert (confidence == 0).all()


def test_a_black_frame_has_no_atoms_and_a_saturated_one_has_all() -> None:
    for grid in (GRID, CLOSE):
        assert not detector(grid).detect(frame(np.zeros((60, 90), np.uint16)))[0].any()
        assert detector(grid).detect(frame(np.full((60, 90), 65535, np.uint16)))[0].all()


def test_one_saturated_pixel_at_the_edge_is_no_atom() -> None:
    """A cosmic ray: the curve is bounded."""
    image = mean_image(np.zeros((3, 4), np.bool_))
    (y, x) = np.rint(site_pixels(GRID, 0.35e-6, (29.5, 44.5))[1, 1]).astype(int)
    image[y, x + 3] = 65535
    assert not detector().detect(frame(image))[0].any()


def test_warming_leaves_nothing_for_the_first_frame() -> None:
    known = detector(background=0.4)
    assert isinstance(known, NeedsWarmUp)
    known.warm()
    before = known._weights
    known.detect(frame(mean_image(np.zeros((3, 4), np.bool_))))
    assert known._weights is before is not None
