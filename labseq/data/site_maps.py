"""Maps of the sites: a quantity of images at each site, over the shots of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.data.quantities import find_quantity
from labseq.data.reader import Run
from labseq.data.shot import Shot
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import clean
from labseq.model.image_quantities import OF_IMAGES, at_sites, parse_name

Floats = NDArray[np.float64]

MIN_TRIALS: Final = 5
"""Number of trials (atoms or shots) below which a site has no value."""


@dataclass(frozen=True, slots=True, eq=False)
class SiteMap:
    """A quantity at each site. Every array has the shape (n_rows, n_cols).

    Attributes:
        name: Name of the quantity.
        n: int64, number of events, such as atoms that survived or shots in which the site was filled.
        n_trials: int64, number of trials, such as atoms before or shots.
        n_shots: Number of shots that were read.
    """

    name: str
    n: NDArray[np.int64]
    n_trials: NDArray[np.int64]
    n_shots: int

    @property
    def mean(self) -> float:
        """The share of events in all trials at all sites. nan without trials."""
        return float(self.n.sum() / n_trials) if (n_trials := self.n_trials.sum()) else math.nan

    @property
    def values(self) -> Floats:
        """float64, the share of events at each site. nan where there are fewer than 5 trials."""
        return np.where(self.n_trials >= MIN_TRIALS, self.n / np.maximum(self.n_trials, 1), np.nan)

    @property
    def errors(self) -> Floats:
        """float64, standard error of ``values``, with half an event of either kind added. nan as there."""
        share = (self.n + 0.5) / (self.n_trials + 1)
        errors = np.sqrt(share * (1 - share) / np.maximum(self.n_trials, 1))
        return np.where(self.n_trials >= MIN_TRIALS, errors, np.nan)

    @property
    def deviations(self) -> Floats:
        """float64, difference from the mean of all sites, in standard errors of that mean at the site."""
        n, n_trials = int(self.n.sum()), int(self.n_trials.sum())
        mean = (n + 0.5) / (n_trials + 1)
        errors = np.sqrt(mean * (1 - mean) / np.maximum(self.n_trials, 1))
        return (self.values - self.mean) / errors


def site_map(run: Run, name: str, shots: Sequence[Shot] | None = None) -> SiteMap:
    """Map a quantity of images over the sites.

    Args:
        name: A quantity of images: "survival:before,after", "loading", "filling:before@corner".
        shots: Some of its shots. Default: all. Every shot's file is read, and damaged ones are left out.

    Raises:
        ConfigError: The run has no such quantity, or it has no value for a site.
    """
    find_quantity(run, name)  # raises for a name that the run does not have
    if parse_name(name).kind not in OF_IMAGES:
        problem = f"'{clean(name)}' has one value per shot, not one per site"
        raise ConfigError(Problem(problem, clean(run.path.name), expected=f"one of {', '.join(OF_IMAGES)}"))
    n, n_trials = np.zeros(run.target.shape, np.int64), np.zeros(run.target.shape, np.int64)
    n_shots = 0
    for shot in run.shots if shots is None else shots:
        try:
            happened, tried = at_sites(name, shot, run.target)
        except RecordingError:
            continue
        n, n_trials, n_shots = n + happened, n_trials + tried, n_shots + 1
    return SiteMap(name, n, n_trials, n_shots)
