"""The weighted detector."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from labseq.config.profile import load_profile
from labseq.detection.sites import site_pixels
from labseq.detection.weighted import WeightedDetector, WeightedSettings
from labseq.errors import ConfigError, DeviceError, LimitError
from labseq.model import Frame, SiteGrid
from labseq.roles import Context, NeedsWarmUp
from labseq.testing import DetectorContract

Bools = NDArray[np.bool_]
Images = NDArray[np.uint16]

GRID = SiteGrid(3, 4)
SMALL: dict[str, Any] = {"frame": (60, 90), "centre_px": (29.5, 44.5)}
CLOSE = SiteGrid(3, 4, spacing_m=1.9e-6)
LIGHT = 3600.0  # counts of 60 photoelectrons


class TestWeightedDetector(DetectorContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], WeightedDetector]:
        return partial(WeightedDetector, WeightedSettings())


def detector(grid: SiteGrid = GRID, **settings: Any) -> WeightedDetector:
    return WeightedDetector(WeightedSettings(**SMALL | settings), Context("detector", grid))


def mean_image(atoms: Bools, grid: SiteGrid = GRID) -> Images:
    """Mean counts, without noise."""
    y, x = np.indices((60, 90))
    image = np.full((60, 90), 500 + 0.375 * 60)
    for place_y, place_x in site_pixels(grid, 0.35e-6, (29.5, 44.5))[atoms]:
        spot = np.exp(-((y - place_y) ** 2 + (x - place_x) ** 2) / (2 * 1.2**2))
        image += LIGHT * spot / spot.sum()
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


@settings(max_examples=30)
@given(PATTERNS, st.sampled_from([GRID, CLOSE, SiteGrid(3, 4, spacing_m=2.2e-6, lattice="square")]))
def test_bright_sites_hold_atoms(atoms: Bools, grid: SiteGrid) -> None:
    occupancy, confidence = detector(grid).detect(frame(mean_image(atoms, grid)))
    np.testing.assert_array_equal(occupancy, atoms)
    assert occupancy.flags.c_contiguous
    assert (confidence > 0.99).all()


@settings(max_examples=30)
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
        np.mean([known.signals(frame(noisy(mean_image(atoms, CLOSE), rng)))[1, 1] for _ in range(300)])
        for atoms in (alone, among)
    )
    weights = known._ready()
    from_neighbours = weights.effects[weights.starts[5] : weights.starts[6]]
    assert len(from_neighbours) == 6
    assert abs(many - few) < from_neighbours.sum() / 4


def test_far_neighbours_are_left_alone() -> None:
    assert len(detector()._ready().neighbours) == 0


def test_the_place_between_the_pixels_counts() -> None:
    weights = detector(SiteGrid(1, 1), centre_px=(29.7, 45.0))._ready().pixels[0]
    above, below = weights[:4].sum(), weights[5:].sum()
    assert above > 1.1 * below


def test_the_confidence_is_the_probability_of_being_right() -> None:
    known = detector()
    image = np.random.default_rng(5).integers(480, 800, (60, 90), np.uint16)
    log_odds = known.signals(frame(image))
    _, confidence = known.detect(frame(image))
    probability = 1 / (1 + np.exp(-np.abs(log_odds)))
    np.testing.assert_allclose(confidence, 2 * probability - 1, rtol=1e-5)


def test_log_odds_at_the_threshold_are_no_atom_and_no_confidence() -> None:
    image = mean_image(np.eye(3, 4, dtype=np.bool_))
    log_odds = detector().signals(frame(image))
    occupancy, confidence = detector(threshold=log_odds.tolist()).detect(frame(image))
    assert not occupancy.any()
    assert (confidence == 0).all()


def test_each_site_can_have_its_own_threshold(tmp_path: Path) -> None:
    atoms = np.ones((3, 4), np.bool_)
    odds = np.where(np.eye(3, 4), 1e6, 0.0)
    np.save(tmp_path / "odds.npy", odds)
    for threshold in (odds.tolist(), str(tmp_path / "odds.npy")):
        occupancy, _ = detector(threshold=threshold).detect(frame(mean_image(atoms)))
        np.testing.assert_array_equal(occupancy, odds == 0)


def test_thresholds_of_another_grid_are_refused() -> None:
    with pytest.raises(LimitError, match="3 x 4 sites"):
        detector(threshold=[[1.0, 2.0]])


def test_a_thresholds_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"odds\.npy"):
        detector(threshold=str(tmp_path / "odds.npy"))


def test_a_region_over_the_edge_of_the_frame_names_the_site() -> None:
    with pytest.raises(LimitError, match=r"region of interest of site \(0, 0\)"):
        detector(centre_px=(14.0, 44.5))


def test_a_frame_of_another_size_names_both_sizes() -> None:
    with pytest.raises(DeviceError, match=r"uint16 \(90, 60\).*\(60, 90\)"):
        detector().detect(frame(np.zeros((90, 60), np.uint16)))


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
    known = detector()
    assert isinstance(known, NeedsWarmUp)
    known.warm()
    before = known._weights
    known.detect(frame(mean_image(np.zeros((3, 4), np.bool_))))
    assert known._weights is before is not None


@pytest.mark.parametrize(
    "settings",
    [
        {"region": 4},
        {"spot": 0.0},
        {"photoelectrons": 0.0},
        {"background": 0.0},
        {"filling": 1.2},
        {"counts_per_photoelectron": 0.0},
        {"read_noise": -1.0},
        {"shape": "disc"},
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        WeightedSettings(**settings)


def test_a_profile_can_name_it_and_mistakes_are_shown_with_their_lines(tmp_path: Path) -> None:
    text = (
        "labseq: 1\nname: x\ngrid: {rows: 3, cols: 4, spacing: 4 um}\ncamera: {use: virtual}\n"
        "static_tweezers: {use: virtual}\nmobile_tweezers: {use: virtual}\n"
        "detector:\n  use: weighted\n  spot: 400 nm\n  region: 8\n  threshold: odds.npy\n"
    )
    path = tmp_path / "x.yaml"
    path.write_text(text)
    document, profile = load_profile("x.yaml", beside=tmp_path)
    assert profile.detector.use == "weighted"
    with pytest.raises(ConfigError, match=r"x\.yaml:10:\d+.*8 is even"):
        document.validate(WeightedSettings, ("detector",), drop={"use"})
    path.write_text(text.replace("region: 8", "region: 7"))
    document, _ = load_profile("x.yaml", beside=tmp_path)
    read = document.validate(WeightedSettings, ("detector",), drop={"use"})
    assert (read.spot, read.region, read.threshold) == (pytest.approx(4e-7), 7, tmp_path / "odds.npy")
