"""The model of the EMCCD against frames of a real one.

The frames (5,000 of 3 x 3 pixels at three gains, from github.com/fatmac78/EMCCD-calibration) are not part of
this repository; the tests read them from the folder LABSEQ_EMCCD_DATA, else from ``shared/data/emccd``
next to the checkout. Offset, read noise, light and counts per electron of that camera are not known, so the
compared figures do not depend on them. ``-s`` prints the figures of ``docs/explanation/virtual-images.md``.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import tifffile
from labseq_virtual.sensors import Register, power_of_two
from numpy.typing import NDArray
from scipy.special import chdtri, ndtr

from tests.needs import EMCCD_FRAMES

Floats = NDArray[np.float64]
FILES = {
    1: "ADU__1x-gain_level-03.tif",
    100: "gain-IS__100x-gain_level-03.tif",
    300: "gain-GS__300x-gain.tif",
}
N_BINS = 50
pytestmark = pytest.mark.needs("emccd-frames")


@cache
def frames(gain: int) -> Floats:
    """Measured counts (n_frames, 3, 3)."""
    return tifffile.imread(EMCCD_FRAMES / FILES[gain]).astype(np.float64)


class Moments:
    """Mean, variance within a pixel, skewness and excess kurtosis."""

    def __init__(self, counts: Floats) -> None:
        deviation = counts - counts.mean(axis=0)  # the pixels do not get quite the same light
        self.mean = float(counts.mean())
        self.variance = float((deviation**2).mean())
        self.skewness = float((deviation**3).mean() / self.variance**1.5)
        self.kurtosis = float((deviation**4).mean() / self.variance**2 - 3)


def spread(counts: Floats, statistic: Any) -> float:
    """Standard error of a statistic, by bootstrap over frames."""
    rng = np.random.default_rng(0)
    values = [statistic(Moments(counts[rng.integers(0, len(counts), len(counts))])) for _ in range(40)]
    return float(np.std(values))


@cache
def cumulants(gain: int) -> Floats:
    """Second to fourth cumulant of the output over those powers of the gain, for 1 electron on average."""
    n = np.arange(power_of_two(60 * gain + 64))
    p = Register(536, float(gain)).output(1.0, len(n))
    second, third, fourth = (float(p @ (n / gain - 1) ** k) for k in (2, 3, 4))
    return np.array([second, third, fourth - 3 * second**2])


def fitted_offset(gain: int, moments: Moments) -> float:
    """Where the model puts the dark counts, from skewness and variance."""
    second, third, _ = cumulants(gain)
    return moments.mean - third / second**2 * moments.variance**0.5 / moments.skewness


def probability(counts: Floats, gain: int, offset: float) -> Floats:
    """Distribution function of the model at the counts; its light and scale are from mean and variance."""
    moments = Moments(counts)
    electrons = (moments.mean - offset) ** 2 * cumulants(gain)[0] / moments.variance
    per_electron = (moments.mean - offset) / electrons
    n_values = power_of_two((electrons + 9 * (2 * electrons) ** 0.5 + 45) * gain)
    below = np.cumsum(Register(536, float(gain)).output(electrons, n_values))
    same_light = counts - counts.mean(axis=0) + moments.mean
    print(f"gain {gain}, offset {offset:.0f}: {electrons:.1f} electrons, {per_electron:.2f} counts each")
    return np.interp((same_light - offset) / per_electron * gain, np.arange(n_values) + 0.5, below)


def setting_error(probabilities: Floats) -> tuple[float, float]:
    """Kolmogorov-Smirnov distance and chi-square of numbers that should be even from 0 to 1."""
    found = np.sort(probabilities.ravel())
    distance = np.abs(found - np.arange(0.5, len(found)) / len(found)).max() + 0.5 / len(found)
    expected = len(found) / N_BINS
    often = np.histogram(found, np.linspace(0, 1, N_BINS + 1))[0]
    print(f"  KS distance {distance:.5f}, chi-square {((often - expected) ** 2 / expected).sum():.1f}")
    return float(distance), float(((often - expected) ** 2 / expected).sum())


def test_without_gain_the_counts_are_normal() -> None:
    counts = frames(1)
    moments = Moments(counts)
    assert abs(moments.skewness) < 0.04
    assert abs(moments.kurtosis) < 0.08
    even = np.random.default_rng(0).uniform(-0.5, 0.5, counts.shape)  # whole numbers, spread out
    scaled = (counts + even - counts.mean(axis=0)) / np.sqrt(moments.variance + 1 / 12)
    distance, square = setting_error(ndtr(scaled))
    assert distance * counts.size**0.5 < 1.36
    assert square < chdtri(N_BINS - 3, 0.001)


@pytest.mark.parametrize("gain", [100, 300])
def test_with_gain_the_histogram_has_the_models_shape(gain: int) -> None:
    counts = frames(gain)
    offset = fitted_offset(gain, Moments(counts))
    distance, square = setting_error(probability(counts, gain, offset))
    assert distance * counts.size**0.5 < 1.36
    assert square < chdtri(N_BINS - 4, 0.001)
    normal = (counts - counts.mean(axis=0)) / Moments(counts).variance ** 0.5
    assert setting_error(ndtr(normal))[1] > 3 * square  # a normal distribution is refused


def test_the_kurtosis_is_the_one_that_the_skewness_predicts() -> None:
    for gain in (100, 300):
        counts, (second, third, fourth) = frames(gain), cumulants(gain)
        moments = Moments(counts)
        predicted = fourth * second / third**2 * moments.skewness**2
        error = spread(counts, lambda m: m.kurtosis)
        print(f"gain {gain}: excess kurtosis {moments.kurtosis:.3f}({error:.3f}), predicted {predicted:.3f}")
        assert abs(moments.kurtosis - predicted) < 3 * error


def test_one_offset_for_both_gains_gives_the_excess_noise_of_the_model() -> None:
    """Skewness times signal over noise is 1 for Poisson light alone and 1.49 in the model, in any unit."""
    low, high = frames(100), frames(300)
    offset = fitted_offset(100, Moments(low))
    offset_error = spread(low, lambda m: fitted_offset(100, m))
    assert 0 < offset < low.min()

    def ratio(m: Moments) -> float:
        return m.skewness * (m.mean - offset) / m.variance**0.5

    second, third, _ = cumulants(300)
    found, error = ratio(Moments(high)), spread(high, ratio)
    print(f"offset {offset:.0f}({offset_error:.0f}), ratio {found:.2f}({error:.2f}) at gain 300")
    assert abs(found - third / second**2) < 2 * error
    assert found - 1 > 3 * error
    _, square = setting_error(probability(high, 300, offset))
    assert square < chdtri(N_BINS - 3, 0.001)


def test_the_variance_without_gain_gives_a_gain_of_the_right_size() -> None:
    """Read noise put aside, variance at gain 1 gives the electrons per count, and that the true gain."""
    counts, low = frames(1), frames(100)
    offset = fitted_offset(100, Moments(low))
    moments = Moments(counts)
    electrons_per_count = (moments.mean - offset) / moments.variance
    counts_per_electron = Moments(low).variance / cumulants(100)[0] / (Moments(low).mean - offset)
    gain = electrons_per_count * counts_per_electron
    print(f"at least {electrons_per_count:.2f} electrons per count, a gain of at least {gain:.0f} for 100")
    assert 1 < electrons_per_count < 5
    assert 40 < gain < 100
