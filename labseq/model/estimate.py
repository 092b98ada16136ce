"""Means and rates with errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.units import with_error


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its standard error, which may be NaN for unknown.

    Attributes:
        n: Number of values in the mean. 0 if the value is not a mean.
    """

    value: float
    error: float
    n: int = field(default=0, compare=False, repr=False)

    def __str__(self) -> str:
        """The value with the error of its last digit in brackets, ``29.61(3)``."""
        return with_error(self.value, self.error)

    @property
    def interval(self) -> tuple[float, float]:
        """The value minus and plus its standard error."""
        return self.value - self.error, self.value + self.error

    def as_json(self) -> dict[str, float]:
        """The value under the key "mean", with its error."""
        return {"mean": self.value, "error": self.error}

    def scaled(self, factor: float) -> Estimate:
        """The estimate in another unit."""
        return Estimate(self.value * factor, self.error * factor, self.n)


def mean(values: ArrayLike) -> Estimate:
    """The mean and its standard error, which is NaN for a single value.

    Example:
        >>> mean([1.0, 3.0])
        Estimate(value=2.0, error=1.0)
    """
    array: NDArray[np.float64] = np.asarray(values, np.float64)
    n = len(array)
    if n == 0:
        return Estimate(math.nan, math.nan)
    error = float(array.std(ddof=1)) / math.sqrt(n) if n > 1 else math.nan
    return Estimate(float(array.mean()), error, n)


ONE_SIGMA: Final = math.erf(math.sqrt(0.5))
"""Probability within one standard deviation of a normal distribution, 68.3 %."""


@dataclass(frozen=True, slots=True)
class Rate:
    """A rate: ``n`` events in ``n_trials`` trials."""

    n: int
    n_trials: int

    @property
    def value(self) -> float:
        """The fraction of events, or nan without trials."""
        return self.n / self.n_trials if self.n_trials else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """The 1 sigma interval (see :func:`jeffreys`)."""
        return jeffreys(self.n, self.n_trials)

    def as_json(self) -> dict[str, Any]:
        """The numbers of events and trials, the rate and its interval."""
        return {"n": self.n, "n_trials": self.n_trials, "rate": self.value, "interval": self.interval}


Estimated: TypeAlias = Estimate | Rate
"""A mean with its standard error, or a rate with its Jeffreys interval."""


@lru_cache(maxsize=4096)
def jeffreys(n: int, n_trials: int, level: float = ONE_SIGMA) -> tuple[float, float]:
    """The equal-tailed interval of a probability, with Jeffreys' prior.

    The ends are quantiles of the beta distribution with ``n + 1/2`` and ``n_trials - n + 1/2``. The lower end
    is 0 without events, and the upper end is 1 if every trial is an event (Brown, Cai, DasGupta, Statist.
    Sci. 16, 101, 2001).

    Args:
        level: Probability of the interval, between 0 and 1.

    Returns:
        Lower and upper end. 0 and 1 without trials.

    Raises:
        ValueError: ``n`` is negative, or more than ``n_trials``.

    Example:
        >>> [round(end, 4) for end in jeffreys(33, 100)]
        [0.2849, 0.3785]
        >>> [round(end, 4) for end in jeffreys(0, 10)]
        [0.0, 0.0923]
    """
    if not 0 <= n <= n_trials:
        raise ValueError(f"{n} events in {n_trials} trials; expected at least 0 and at most all")
    if not n_trials:
        return 0.0, 1.0
    from scipy.special import betaincinv  # takes 0.3 s to import

    a, b, tail = n + 0.5, n_trials - n + 0.5, (1.0 - level) / 2
    low = float(betaincinv(a, b, tail)) if n else 0.0
    high = float(betaincinv(a, b, 1.0 - tail)) if n < n_trials else 1.0
    return low, high
