"""What counts say about light, against laws worked out in another way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.detection.weighted import LightLikelihood, WeightedSettings, evidence

Floats = NDArray[np.float64]
N = 8192


def known(**settings: Any) -> WeightedSettings:
    return WeightedSettings(**settings)


def law(sensor: WeightedSettings, light: float) -> Floats:
    """Probability of the counts 0 to N: the Fourier transform of the characteristic function."""
    t = 2 * np.pi * np.fft.rfftfreq(N)
    gain = sensor.counts_per_photoelectron
    single = 1 / (1 + 1j * gain * t) if sensor.em_register else np.exp(-1j * gain * t)
    transform = light * (single - 1) - (sensor.read_noise * t) ** 2 / 2 - 1j * sensor.offset * t
    return np.fft.irfft(np.exp(transform) * np.sinc(t / 2 / np.pi), N)


def log_ratio(found: LightLikelihood, light: float) -> Floats:
    """Log-likelihood over that of the darkest light, for the counts 0 to N."""
    weight, constant = (np.interp(light, found.light, values) for values in (found.weight, found.constant))
    weight, constant = weight - found.weight[0], constant - found.constant[0]
    return np.asarray(weight * found.curve[:N] + constant)


@settings(max_examples=4)
@given(
    light=st.floats(0.5, 8.0),
    gain=st.floats(30, 90),
    noise=st.floats(0.05, 0.35),
    em_register=st.booleans(),
)
def test_log_likelihoods_are_those_of_the_law(
    light: float, gain: float, noise: float, em_register: bool
) -> None:
    sensor = known(counts_per_photoelectron=gain, read_noise=noise * gain, em_register=em_register)
    found = evidence(sensor, 0.375, 9.0)
    with_atom, without = law(sensor, light), law(sensor, 0.375)
    solid = (with_atom > 1e-9) & (without > 1e-9)
    often = ((with_atom + without) / 2)[solid]
    exact = np.log(with_atom[solid] / without[solid])
    off = log_ratio(found, light)[solid] - exact
    assert np.sqrt((often * off**2).sum()) < 0.15 * np.sqrt((often * exact**2).sum()) + 0.02


@pytest.mark.parametrize("em_register", [True, False])
def test_the_mean_of_the_curve_is_that_of_the_law(em_register: bool) -> None:
    sensor = known(em_register=em_register)
    found = evidence(sensor, 0.375, 9.0)
    for light, mean in zip(found.light[::10], found.mean[::10], strict=True):
        assert mean == pytest.approx((law(sensor, float(light)) * found.curve[:N]).sum(), rel=0.02)


@settings(max_examples=4)
@given(
    darkest=st.floats(1e-4, 10),
    more=st.floats(0.01, 30),
    gain=st.floats(1, 500),
    noise=st.floats(0, 100),
    em_register=st.booleans(),
)
def test_more_counts_never_say_less(
    darkest: float, more: float, gain: float, noise: float, em_register: bool
) -> None:
    sensor = known(counts_per_photoelectron=gain, read_noise=noise, em_register=em_register)
    found = evidence(sensor, darkest, darkest + more)
    assert np.isfinite(found.curve).all()
    assert np.diff(found.curve).min() > -1e-2
    assert np.diff(found.weight).min() > -1e-6


def test_without_an_em_register_each_photoelectron_says_as_much() -> None:
    sensor = known(em_register=False, counts_per_photoelectron=20.0, read_noise=2.0)
    found = evidence(sensor, 0.3, 6.0)
    assert found.curve[[500, 520, 540, 600]] == pytest.approx([0, 1, 2, 5], abs=0.02)
    assert found.weight - found.weight[0] == pytest.approx(np.log(found.light / 0.3), abs=0.01)
