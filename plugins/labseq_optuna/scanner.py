"""Chooses points by a sampler of Optuna, as a pure function of the visited points.

Optuna's own samplers keep their state from draw to draw. Here each point has its own sampler, seeded by the
run's seed and the number of points before it, and a study that is given everything from the start. So a
resumed run asks for the same points.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from pydantic import Field

from labseq.plugin import ConfigError, ScanRange, ScanSpace, Settings, VisitedPoint
from labseq.plugin.messages import install_hint


class OptunaSettings(Settings):
    """The sampler, and how it starts."""

    sampler: Literal["tpe", "random"] = Field(
        default="tpe",
        description="tree-structured Parzen estimators, which learn from the scores, or random points",
    )
    n_random: int = Field(
        default=10, ge=1, le=10_000, description="points that `tpe` draws at random before it learns"
    )


class OptunaScanner:
    """Chooses points by a sampler of Optuna, a package for optimisation.

    Raises:
        ConfigError: Optuna is not installed.
    """

    def __init__(self, settings: OptunaSettings, space: ScanSpace) -> None:
        self._settings = settings
        self._space = space
        self._optuna = _optuna()
        self._distributions = {one.address: self._distribution(one) for one in space.ranges}

    def next_point(self, visited: Sequence[VisitedPoint]) -> Mapping[str, float]:
        """The point of the files first, if known, then the points of the sampler."""
        if not visited and all(not math.isnan(one.start) for one in self._space.ranges):
            return {one.address: one.at(one.fraction(one.start)) for one in self._space.ranges}
        optuna = self._optuna
        study = optuna.create_study(direction="maximize", sampler=self._sampler(len(visited)))
        study.add_trials([self._trial(point) for point in visited])
        params: dict[str, float] = study.ask(self._distributions).params
        return {one.address: one.at(params[one.address] / _n_steps(one)) for one in self._space.ranges}

    def _sampler(self, n_visited: int) -> Any:
        samplers = self._optuna.samplers
        seed = int(self._space.random(n_visited).integers(2**31))
        if self._settings.sampler == "random":
            return samplers.RandomSampler(seed=seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", self._optuna.exceptions.ExperimentalWarning)
            return samplers.TPESampler(seed=seed, n_startup_trials=self._settings.n_random, multivariate=True)

    def _distribution(self, one: ScanRange) -> Any:
        """A range with steps counts them. Any other range goes from 0 to 1."""
        if one.is_whole or one.n_steps:
            return self._optuna.distributions.IntDistribution(0, _n_steps(one))
        return self._optuna.distributions.FloatDistribution(0.0, 1.0)

    def _trial(self, point: VisitedPoint) -> Any:
        params: dict[str, float] = {}
        for one in self._space.ranges:
            part = min(max(one.fraction(point.values[one.address]), 0.0), 1.0)
            params[one.address] = round(part * _n_steps(one)) if one.is_whole or one.n_steps else part
        states = self._optuna.trial.TrialState
        is_known = not math.isnan(point.score)
        return self._optuna.trial.create_trial(
            params=params,
            distributions=self._distributions,
            value=point.score if is_known else None,
            state=states.COMPLETE if is_known else states.FAIL,
        )


def _n_steps(one: ScanRange) -> int:
    """Number of steps of a range, or 1 if any value is allowed."""
    return one.n_steps or (int(one.high - one.low) if one.is_whole else 1)


def _optuna() -> Any:
    """Optuna with its log switched off.

    Raises:
        ConfigError: It is not installed.
    """
    try:
        optuna = importlib.import_module("optuna")
    except ImportError as error:
        text = f"the scanner 'optuna' needs the package 'optuna' ({error})"
        raise ConfigError(f"{text}; install it with {install_hint('optuna')}") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
