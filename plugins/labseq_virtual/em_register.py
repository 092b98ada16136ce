"""The register of an EMCCD camera: many stages, in each of which an electron may free another."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq_virtual.law import CountDistribution

Complex = NDArray[np.complex128]

N_ONE_BY_ONE: Final = 32
"""Up to so many electrons into the register, each one's output is drawn by itself."""


@dataclass(frozen=True)
class Register:
    """A register of equal stages.

    In a stage, each electron frees another with the probability p, where (1 + p)^n_stages is
    the gain. With the generating function of a stage, f(s) = (1 - p) s + p s^2, that of the
    whole register is f applied n_stages times, and its Fourier transform the exact law of what
    comes out.

    Attributes:
        n_stages: Number of stages.
        gain: Mean electrons out for one in; 1 is a plain CCD.
        spurious: Mean electrons that the stages add to each pixel read, before later stages multiply
            them, as clock-induced charge does (spread evenly over the stages).
    """

    n_stages: int
    gain: float
    spurious: float = 0.0

    @property
    def p(self) -> float:
        """Probability that an electron frees another in a stage."""
        return math.expm1(math.log(self.gain) / self.n_stages)

    @property
    def excess_noise(self) -> float:
        """F^2: variance of the output over gain^2 times that of a Poisson input.

        M. Robbins, B. Hadwen, IEEE Trans. Electron Devices 50, 1227 (2003).

        Example:
            >>> round(Register(536, 300.0).excess_noise, 3), Register(536, 1.0).excess_noise
            (1.976, 1.0)
        """
        return 2 * (self.gain - 1) * self.gain ** (-(self.n_stages + 1) / self.n_stages) + 1 / self.gain

    @cached_property
    def one(self) -> CountDistribution:
        """Law of the output for one electron in, without the spurious ones."""
        n_values = power_of_two(45 * self.gain + 64)
        return CountDistribution.of(
            np.fft.irfft(_transforms(self.n_stages, self.gain, n_values)[0], n_values)
        )

    @cached_property
    def _added(self) -> CountDistribution:
        """Law of what the spurious electrons add to the output."""
        return CountDistribution.of(
            self.output(0.0, power_of_two((self.spurious + 9 * self.spurious**0.5 + 45) * self.gain))
        )

    def output(self, mean_electrons: float, n_values: int) -> NDArray[np.float64]:
        """Law of the output for a Poisson number of electrons in, spurious ones included.

        Args:
            mean_electrons: Mean number of electrons in.
            n_values: A power of two; larger outputs must be as good as impossible.

        Returns:
            float64 (n_values,), probability of 0, 1, ... electrons out.
        """
        one, spurious = _transforms(self.n_stages, self.gain, n_values)
        return np.fft.irfft(np.exp(mean_electrons * (one - 1) + self.spurious * spurious), n_values)

    def multiply(self, n_electrons: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
        """Draw the output for each number of electrons in.

        Up to N_ONE_BY_ONE electrons it has the exact law. For more, what the stages free is
        drawn from a negative binomial law with the exact mean and variance, which is the exact
        law in the limit of many stages.

        Args:
            n_electrons: int64 (n,).
            rng: Random numbers.

        Returns:
            int64 (n,), electrons out.
        """
        out = n_electrons.copy()
        if self.p > 0:
            few = n_electrons <= N_ONE_BY_ONE
            out[few] = self.one.draw_sums(n_electrons[few], rng)
            many = n_electrons[~few]
            odds = math.expm1(math.log(self.gain) - 2 * math.atanh(self.p))
            out[~few] += rng.negative_binomial(many * ((self.gain - 1) / odds), 1 / (1 + odds))
        if self.spurious > 0:
            added = np.empty(len(out), np.int32)
            self._added.draw(added, rng)
            out += added
        return out


def power_of_two(least: float) -> int:
    """The first power of two that is not below a number."""
    return 1 << max(0, int(np.ceil(np.log2(least))))


@lru_cache(maxsize=16)
def _transforms(n_stages: int, gain: float, n_values: int) -> tuple[Complex, Complex]:
    """Fourier transforms of a register's output for one electron, and of the mean of f_m - 1 over m.

    f_m is the generating function of the last m stages.
    """
    p = Register(n_stages, gain).p
    s: Complex = np.exp(-2j * np.pi * np.fft.rfftfreq(n_values))
    total = np.zeros_like(s)
    for _ in range(n_stages):
        total += s
        s *= 1 - p + p * s
    return s, total / n_stages - 1
