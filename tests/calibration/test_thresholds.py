"""Thresholds from two peaks, against laws that are known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray
from scipy.special import ndtr

from labseq.calibration.thresholds import FittedThresholds, Peak, analyse_thresholds, fit_thresholds
from labseq.errors import DeviceError, LimitError

Floats = NDArray[np.float64]

N_SITES = 144
LADDER = np.arange(-2000.0, 14_384.0, 2.0)


class Emccd:
    """Sums over regions: 60 counts a photoelectron, exponential gain, read noise of 16 counts a pixel."""

    def __init__(self, rng: np.random.Generator, spread: float = 0.05) -> None:
        self.rng = rng
        self.dark, self.light = (mean * np.exp(rng.normal(0, spread, N_SITES)) for mean in (9.4, 56.0))

    def counts(self, light: Floats) -> Floats:
        electrons = self.rng.poisson(light)
        signal = 60 * self.rng.gamma(np.maximum(electrons, 1e-9)) * (electrons > 0)
        return signal + self.rng.normal(0, 80, light.shape)

    def draw(self, n: int, loading: float, lost: float = 0.0) -> Floats:
        shape = (n, N_SITES)
        shone = np.where(self.rng.random(shape) < lost, self.rng.random(shape), 1.0)
        return self.counts(self.dark + self.light * shone * (self.rng.random(shape) < loading))

    def law(self, light: Floats) -> Floats:
        """Probability of less than each of the ``LADDER``, exact: (n_sites, n_steps)."""
        t = 2 * np.pi * np.fft.rfftfreq(len(LADDER), LADDER[1] - LADDER[0])
        transform = light[:, None] * (1 / (1 + 60j * t) - 1) - (80 * t) ** 2 / 2 + 1j * t * LADDER[0]
        return np.fft.irfft(np.exp(transform), len(LADDER), axis=1).cumsum(axis=1)

    def cost(self, thresholds: Floats, miss_cost: float) -> tuple[float, float]:
        """Mean cost at the thresholds, and at the best of each site."""
        costs = miss_cost * self.law(self.dark + self.light) + 1 - self.law(self.dark)
        ours = [np.interp(at, LADDER, of_site) for at, of_site in zip(thresholds, costs, strict=True)]
        return float(np.mean(ours)), float(costs.min(axis=1).mean())


def fitted(signals: Floats, miss_cost: float = 3.0) -> FittedThresholds:
    return fit_thresholds(signals.reshape(-1, 12, 12), miss_cost)


@pytest.mark.parametrize(
    ("n_frames", "loading", "lost", "miss_cost"),
    [(100, 0.6, 0.0, 3.0), (150, 0.75, 0.0045, 10.0), (300, 0.5, 0.0045, 1.0)],
)
def test_errors_cost_at_most_a_fifth_more_than_at_the_best_thresholds(
    n_frames: int, loading: float, lost: float, miss_cost: float
) -> None:
    lab = Emccd(np.random.default_rng(n_frames))
    found = fitted(lab.draw(n_frames, loading, lost), miss_cost)
    ours, best = lab.cost(found.thresholds.ravel(), miss_cost)
    assert ours < 1.2 * best
    expected = (miss_cost * found.false_negative + found.false_positive).mean()
    assert 0.6 * ours < expected < 1.6 * ours


def test_thresholds_of_calibrated_log_odds_are_minus_the_log_of_the_cost() -> None:
    """Two Gaussians of the same width, a distance d^2 apart: their log-odds are the signal itself."""
    rng, d = np.random.default_rng(2), 7.0
    full = rng.random((300, N_SITES)) < 0.6
    signals = rng.normal(np.where(full, d**2 / 2, -(d**2) / 2), d)
    for cost in (1.0, 10.0):  # a missed atom that costs more is missed less
        found = fitted(signals, cost)
        assert np.median(found.thresholds) == pytest.approx(-np.log(cost), abs=0.8)
        assert found.lost < 1e-3


@settings(max_examples=2)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(0.3, 0.85),
    st.floats(1e-3, 1e3),
    st.floats(-1e4, 1e4),
    st.floats(5, 9),
)
def test_any_unit_will_do(seed: int, loading: float, unit: float, zero: float, apart: float) -> None:
    rng = np.random.default_rng(seed)
    full = rng.random((100, 36)) < loading
    signals = rng.normal(np.where(full, apart + 1, 0.0), np.where(full, 1.2, 1.0))
    found = fit_thresholds((zero + unit * signals).reshape(-1, 6, 6))
    thresholds = (found.thresholds - zero) / unit
    assert ((thresholds > 0.5) & (thresholds < apart + 0.5)).all()
    np.testing.assert_allclose(found.loading.ravel(), full.mean(axis=0), atol=0.1)


def test_atoms_lost_during_the_exposure_are_counted() -> None:
    lab = Emccd(np.random.default_rng(4))
    found = fitted(lab.draw(1000, 0.6, lost=0.02))
    assert found.lost == pytest.approx(0.012, abs=0.005)


def test_a_site_with_one_peak_follows_its_neighbours_and_not_the_far_ones() -> None:
    rng = np.random.default_rng(8)
    step = np.linspace(20.0, 60.0, 12)[:, None] * np.ones(12)  # the light falls across the array
    full = rng.random((200, 12, 12)) < 0.6
    full[:, 2, 5] = full[:, 9, 5] = False
    found = fit_thresholds(rng.normal(step * full, 1.0))
    assert np.argwhere(found.never_loaded).tolist() == [[2, 5], [9, 5]]
    for row in (2, 9):
        assert found.thresholds[row, 5] == pytest.approx(found.thresholds[row, 4], rel=0.15)


def test_one_site_is_enough() -> None:
    rng = np.random.default_rng(9)
    full = rng.random((200, 1, 1)) < 0.6
    found = fit_thresholds(rng.normal(np.where(full, 9.0, 0.0), 1.0))
    assert 3.0 < found.thresholds[0, 0] < 6.0
    with pytest.raises(DeviceError, match="1 of 1 sites show only one peak"):
        fit_thresholds(rng.normal(0.0, 1.0, (200, 1, 1)))


def test_sites_with_one_peak_are_listed_and_get_the_others_threshold() -> None:
    lab = Emccd(np.random.default_rng(5))
    signals = lab.draw(200, 0.6)
    signals[:, 7] = lab.counts(np.tile(lab.dark, (200, 1)))[:, 7]
    signals[:, 90] = lab.counts(np.tile(lab.dark + lab.light, (200, 1)))[:, 90]
    found = fitted(signals)
    assert np.flatnonzero(found.never_loaded).tolist() == [7]
    assert np.flatnonzero(found.always_loaded).tolist() == [90]
    others = np.median(found.thresholds)
    for site in (7, 90):
        assert found.thresholds.ravel()[site] == pytest.approx(others, rel=0.15)
    assert found.loading.ravel()[7] < 0.02
    assert found.loading.ravel()[90] > 0.98


def gaussian(n_frames: int = 200, seed: int = 10) -> tuple[Floats, NDArray[np.bool_]]:
    """Signals of 6 x 6 equal sites, 9 widths between the peaks; and which atoms there were."""
    rng = np.random.default_rng(seed)
    full = rng.random((n_frames, 6, 6)) < 0.6
    return rng.normal(9.0 * full, 1.0), full


def test_a_site_with_little_light_and_one_with_a_few_bright_frames_have_one_peak() -> None:
    signals, full = gaussian(100)
    full[:, 1, 1] = full[:, 4, 4] = False
    signals[:, 1, 1] = np.random.default_rng(1).normal(np.where(full[:, 1, 2], 1.8, 0.0), 0.2)
    signals[:, 4, 4] = np.random.default_rng(2).normal(0.0, 1.0, 100)
    signals[::30, 4, 4] += 9.0  # cosmic rays
    found = fit_thresholds(signals)
    assert np.argwhere(found.never_loaded | found.always_loaded).tolist() == [[1, 1], [4, 4]]
    assert found.thresholds[4, 4] == pytest.approx(np.median(found.thresholds), abs=1.0)


class Signals:
    """A detector whose frames are the signals."""

    signal_unit = "counts"
    sites_px = thresholds = np.zeros((6, 6))

    def signals(self, frame: Floats) -> Floats:
        return frame


@pytest.mark.parametrize(("n_frames", "n_atoms", "n_counted"), [(40, 3, 0), (200, 0, 1)])
def test_a_site_that_has_few_atoms_by_chance_does_not_count_as_one_without(
    n_frames: int, n_atoms: int, n_counted: int
) -> None:
    rng = np.random.default_rng(6)
    full = rng.random((n_frames, 6, 6)) < 0.3
    full[:, 2, 2] = np.arange(n_frames) < n_atoms
    signals = rng.normal(9.0 * full, 1.0)
    chosen = SimpleNamespace(entry=SimpleNamespace(name="mine"), dump=dict)
    data: Any = SimpleNamespace(
        detector=Signals, frames=lambda: signals, hardware=SimpleNamespace(chosen={"detector": chosen})
    )
    found = analyse_thresholds(data)
    assert found.quality["n_one_peak"] == n_counted
    assert any("site (2, 2)" in line for line in found.summary_lines)


def test_cosmic_rays_hardly_change_the_thresholds() -> None:
    signals, full = gaussian()
    before = fit_thresholds(signals).thresholds
    for row, col in np.ndindex(6, 6):
        signals[np.flatnonzero(full[:, row, col])[:2], row, col] = 300.0
    np.testing.assert_allclose(fit_thresholds(signals).thresholds, before, atol=0.3)


def test_what_is_on_the_outer_side_of_a_peak_hardly_changes_the_thresholds() -> None:
    """A tenth of the atoms is much brighter, as where two are in a tweezer."""
    rng = np.random.default_rng(0)
    full, bright = rng.random((300, N_SITES)) < 0.6, rng.random((300, N_SITES)) < 0.1
    found = fitted(rng.normal(np.where(full, np.where(bright, 16.0, 10.0), 0.0), np.where(full, 2.0, 1.0)))
    assert cost(found.thresholds, 10.0, 2.0, 1.0) < 1.7 * best(10.0, 2.0, 1.0)[0]


def test_each_site_has_a_threshold_for_its_own_noise() -> None:
    rng = np.random.default_rng(1)
    width = np.tile([1.0, 2.5], N_SITES // 2)  # of the empty site
    full = rng.random((300, N_SITES)) < 0.6
    thresholds = fitted(rng.normal(np.where(full, 14.0, 0.0), np.where(full, 2.0, width))).thresholds.ravel()
    narrow, wide = (float(np.median(thresholds[width == own])) for own in (1.0, 2.5))
    best_narrow, best_wide = (best(14.0, 2.0, own)[1] for own in (1.0, 2.5))
    assert wide - narrow == pytest.approx(best_wide - best_narrow, rel=0.5)


def cost(at: Floats, full: float, width_full: float, width_empty: float) -> float:
    """Mean cost of thresholds between Gaussians at 0 and ``full``, a missed atom counted three times."""
    missed, imagined = ndtr((at - full) / width_full), ndtr(-at / width_empty)
    return float(np.mean(3 * missed + imagined))


def best(full: float, width_full: float, width_empty: float) -> tuple[float, float]:
    """The lowest cost, and the threshold with it."""
    ladder = np.linspace(0, full, 1000)
    return min((cost(np.array(at), full, width_full, width_empty), float(at)) for at in ladder)


def test_the_one_site_that_differs_from_all_others_keeps_its_own_threshold() -> None:
    signals, _ = gaussian()
    expected = fit_thresholds(signals).thresholds[3, 2] + 2.0
    signals[:, 3, 2] += 2.0  # stray light
    assert fit_thresholds(signals).thresholds[3, 2] == pytest.approx(expected, abs=0.5)


def test_a_site_without_atoms_but_with_stray_light_has_a_higher_threshold() -> None:
    signals, _ = gaussian()
    signals[:, 3, 2] = np.random.default_rng(3).normal(2.0, 1.0, 200)
    found = fit_thresholds(signals)
    assert found.never_loaded[3, 2]
    assert found.thresholds[3, 2] == pytest.approx(2.0 + np.median(found.thresholds), abs=0.5)


def test_a_fifth_of_the_sites_may_have_one_peak() -> None:
    signals, _ = gaussian()
    dark = np.random.default_rng(4).normal(0.0, 1.0, signals.shape)
    for n_dark in (7, 8):
        mixed = np.where(np.arange(36).reshape(6, 6) < n_dark, dark, signals)
        if n_dark == 7:
            assert np.count_nonzero(fit_thresholds(mixed).never_loaded) == 7
        else:
            with pytest.raises(DeviceError, match="8 of 36 sites"):
                fit_thresholds(mixed)
    mixed = np.where(np.arange(4).reshape(2, 2) < 1, dark[:, :2, :2], signals[:, :2, :2])
    assert np.count_nonzero(fit_thresholds(mixed).never_loaded) == 1  # one is always allowed


@pytest.mark.parametrize("loading", [0.0, 1.0])
def test_one_peak_on_all_sites_is_an_error(loading: float) -> None:
    signals = Emccd(np.random.default_rng(6)).draw(200, loading)
    with pytest.raises(
        DeviceError,
        match=r"of 144 sites show only one peak in the histogram of the counts; check the loading",
    ):
        fitted(signals)


def test_equal_frames_say_that_they_are_black_or_saturated() -> None:
    with pytest.raises(DeviceError, match=r"144 of 144 sites show only one peak.* black or saturated"):
        fitted(np.zeros((50, N_SITES)))


def test_signals_that_cannot_be_fitted_are_refused() -> None:
    with pytest.raises(LimitError, match="number of frames"):
        fitted(np.zeros((10, N_SITES)))
    with pytest.raises(DeviceError, match="not finite"):
        fitted(np.full((50, N_SITES), np.nan))
    for cost in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(LimitError, match="cost of a missed atom"):
            fitted(Emccd(np.random.default_rng(7)).draw(50, 0.6), cost)


@settings(max_examples=15)
@given(st.floats(-5, 5), st.floats(0.1, 3), st.floats(-1.5, 1.5))
def test_a_peak_has_its_moments(mean: float, width: float, skewness: float) -> None:
    peak, at = Peak(mean, width, skewness), mean + width * np.linspace(-15, 25, 40_001)
    p = np.exp(peak.log_density(at))
    p /= p.sum()
    assert p @ at == pytest.approx(mean, abs=0.01 * width)
    assert p @ (at - mean) ** 2 == pytest.approx(width**2, rel=0.02)
    np.testing.assert_allclose(peak.below(at)[::2000], np.cumsum(p)[::2000], atol=0.01)
    np.testing.assert_allclose(peak.below(at) + peak.above(at), 1.0, atol=1e-9)
