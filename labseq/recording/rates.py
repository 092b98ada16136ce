"""How often something happened, with its error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

ONE_SIGMA: Final = math.erf(math.sqrt(0.5))
"""Probability within one standard deviation of a normal distribution, 68.3 %."""


@dataclass(frozen=True, slots=True)
class Rate:
    """How many of how many."""

    n: int
    n_trials: int

    @property
    def value(self) -> float:
        """The fraction; nan of nothing."""
        return self.n / self.n_trials if self.n_trials else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Its 1 sigma interval, see :func:`jeffreys`."""
        return jeffreys(self.n, self.n_trials)


def jeffreys(n: int, n_trials: int, level: float = ONE_SIGMA) -> tuple[float, float]:
    """The equal-tailed interval of a probability, after Jeffreys' prior.

    Between the quantiles of the beta distribution with ``n + 1/2`` and ``n_trials - n + 1/2``. The
    lower end is 0 if it never happened, and the upper end 1 if it always did (Brown, Cai, DasGupta,
    Statist. Sci. 16, 101, 2001).

    Args:
        n: How often it happened.
        n_trials: Of how many times.
        level: Probability of the interval, between 0 and 1.

    Returns:
        Its lower and upper end; 0 and 1 without trials.

    Raises:
        ValueError: ``n`` is negative, or more than ``n_trials``.

    Example:
        >>> [round(end, 4) for end in jeffreys(33, 100)]
        [0.2849, 0.3785]
        >>> [round(end, 4) for end in jeffreys(0, 10)]
        [0.0, 0.0923]
    """
    if not 0 <= n <= n_trials:
        raise ValueError(f"{n} of {n_trials}; expected at least 0, and at most all")
    if not n_trials:
        return 0.0, 1.0
    from scipy.special import betaincinv  # takes 0.3 s to import

    a, b, tail = n + 0.5, n_trials - n + 0.5, (1.0 - level) / 2
    low = float(betaincinv(a, b, tail)) if n else 0.0
    high = float(betaincinv(a, b, 1.0 - tail)) if n < n_trials else 1.0
    return low, high
