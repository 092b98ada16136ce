"""What the counts of a pixel say about the light that fell on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

N_LIGHTS: Final = 64
N_COUNTS: Final = 65_536


class SensorLike(Protocol):
    """What is known of the camera."""

    @property
    def em_register(self) -> bool:
        """Whether photoelectrons are multiplied with the excess noise of an EM register."""
        ...

    @property
    def offset(self) -> float:
        """Counts of a dark pixel."""
        ...

    @property
    def counts_per_photoelectron(self) -> float:
        """Mean counts of one photoelectron."""
        ...

    @property
    def read_noise(self) -> float:
        """Read noise, counts r.m.s."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LightLikelihood:
    """The log-likelihood of counts x under light lam, as ``weight(lam) * curve(x) + constant(lam)``.

    A term that depends on x alone is left out: it says nothing about the light.

    Attributes:
        light: float64 (n,), mean photoelectrons of a pixel, rising.
        weight: float64 (n,), at each of them.
        constant: float64 (n,), at each of them.
        mean: float64 (n,), mean of the curve at each of them.
        curve: float32 (65536,), by counts; 0 at the offset, 1 higher for the counts of one photoelectron.
    """

    light: Floats
    weight: Floats
    constant: Floats
    mean: Floats
    curve: NDArray[np.float32]


def evidence(sensor: SensorLike, darkest: float, brightest: float) -> LightLikelihood:
    """Work out what counts say about light between two limits.

    The number of photoelectrons is Poisson; with an EM register of high gain each
    is multiplied by an exponential law, so that k of them follow a gamma law of
    order k (Basden, Haniff, Mackay, MNRAS 345, 985, 2003); read noise is Gaussian.
    The log-likelihood over that of the darkest light is a function of light and
    counts; its best approximation by one product and a constant is the first term
    of its singular value decomposition, counts weighted by how often they occur.
    Without EM register and read noise it is exact: the product is k log(light).

    Args:
        sensor: See :class:`SensorLike`.
        darkest: Least mean photoelectrons of a pixel, more than 0.
        brightest: Most.
    """
    light = np.concatenate(
        [[darkest], darkest + np.geomspace(1e-3, 1.0, N_LIGHTS - 1) * (brightest - darkest)]
    )
    noise = np.hypot(sensor.read_noise, np.sqrt(1 / 12)) / sensor.counts_per_photoelectron  # rounding
    n_most = int(np.ceil(brightest + 8 * np.sqrt(brightest) + 10))
    signal = _signals(sensor.em_register, noise, n_most)
    log_p = _log_likelihoods(light, _log_responses(sensor.em_register, noise, n_most, signal))
    p = np.exp(log_p) * np.gradient(signal)
    p /= p.sum(axis=1, keepdims=True)
    often = p.mean(axis=0)
    ratio = log_p - log_p[0]
    constant = ratio @ often
    ratio -= constant[:, None]
    left, values, _ = np.linalg.svd(ratio * np.sqrt(often), full_matrices=False)
    weight = left[:, 0] * values[0]
    curve = weight @ ratio / (weight @ weight)
    zero, one = np.interp([0.0, 1.0], signal, curve)
    constant += weight * zero
    curve, weight = (curve - zero) / (one - zero), weight * (one - zero)
    counts = (np.arange(N_COUNTS) - sensor.offset) / sensor.counts_per_photoelectron
    table = np.interp(counts, signal, curve).astype(np.float32)
    return LightLikelihood(light, weight, constant, p @ curve, table)


def _signals(em_register: bool, noise: float, n_most: int) -> Floats:
    """Signals to work with, in photoelectrons: fine where read noise matters, up to any that occurs."""
    low = 5 * noise
    if em_register:
        high = n_most + 6 * np.sqrt(2 * n_most) + low
        return np.concatenate([np.linspace(-low, low, 61), np.geomspace(low, high, 120)[1:]])
    n = int(np.clip((n_most + 2 * low) / noise * 4, 200, 1500))
    return np.linspace(-low, n_most + low, n)


def _log_responses(em_register: bool, noise: float, n_most: int, signal: Floats) -> Floats:
    """Log density of each signal if there were k photoelectrons, (n_most + 1, n_signals)."""
    k = np.arange(n_most + 1.0)
    if not em_register:
        return _log_normal(signal - k[:, None], noise)
    nodes, parts = np.polynomial.legendre.leggauss(48 * max(1, int(np.ceil(noise))))
    low = np.maximum(signal - 6 * noise, 0.0)
    half = (signal + 6 * noise - low) / 2
    before = low + half * (1 + nodes[:, None])  # signal before the read noise, (n_nodes, n_signals)
    kernel = _log_normal(signal - before, noise) + np.log(parts[:, None] * half) - before
    log_before = np.log(before)
    log_p = np.empty((n_most + 1, len(signal)))
    log_p[0] = _log_normal(signal, noise)
    log_factorial = 0.0
    for order in range(1, n_most + 1):
        log_p[order] = _log_sum(kernel + (order - 1) * log_before, axis=0) - log_factorial
        log_factorial += np.log(order)
    return log_p


def _log_likelihoods(light: Floats, log_responses: Floats) -> Floats:
    """Log density of each signal at each light, (n_lights, n_signals)."""
    k = np.arange(len(log_responses))
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(k[1:]))])
    log_poisson = k * np.log(light[:, None]) - light[:, None] - log_factorial
    return np.stack([_log_sum(row[:, None] + log_responses, axis=0) for row in log_poisson])


def _log_normal(distance: Floats, width: float) -> Floats:
    return -0.5 * (distance / width) ** 2 - np.log(width * np.sqrt(2 * np.pi))


def _log_sum(log_terms: Floats, axis: int) -> Floats:
    highest = log_terms.max(axis=axis)
    return highest + np.log(np.exp(log_terms - highest).sum(axis=axis))
