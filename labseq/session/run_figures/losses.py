"""Survival by site, defects that are left, and what atoms are lost to."""

from __future__ import annotations

import math

import numpy as np

from labseq.drawing import Series
from labseq.drawing.charts import LossCausesChart, CurvesChart, DefectsChart, SitesChart, StageBar, StagesChart
from labseq.model.estimate import mean
from labseq.recording import Run
from labseq.recording.rates import Rate, jeffreys
from labseq.recording.statistics import Statistics
from labseq.session.run_figures.measures import series_of
from labseq.session.run_figures.sampling import part_of
from labseq.session.run_figures.survival import Survival, SurvivalCounts
from labseq.session.run_figures.timing import STEP, RunTiming
from labseq.session.shot_grid import grid_of

HIDDEN = 1e-6
"""Shorter times than this, in seconds, are those of a model that counts a stage as nothing."""


def survival_charts(run: Run, survival: Survival) -> tuple[SitesChart, ...]:
    """Maps of the sites: atoms that were moved there, and atoms that stayed."""
    part = part_of(survival.n_read, run)
    return tuple(
        _map(run, tracked, f"{title}: {_percent(tracked.rate)}{part}")
        for title, tracked in (("moved atoms", survival.moved), ("atoms that stayed", survival.kept))
        if tracked.rate.n_trials
    )


def _map(run: Run, tracked: SurvivalCounts, title: str) -> SitesChart:
    target = run.target
    return SitesChart(title, "there on the next image (%)", grid_of(run), tracked.fractions, target.fill)


def _percent(rate: Rate) -> str:
    low, high = rate.interval
    return f"{100 * rate.value:.2f} % ({100 * low:.2f} to {100 * high:.2f})"


def lost_by_cycle(run: Run, survival: Survival) -> CurvesChart | None:
    """The share of the atoms that the next image does not show, for each cycle; None without cycles."""
    cycles = range(1, len(survival.by_cycle) + 1)
    if not cycles:
        return None
    series = [
        series_of(name, cycles, [_lost(pair[kind]) for pair in survival.by_cycle])
        for kind, name in enumerate(("moved", "stayed"))
    ]
    title = f"atoms lost by cycle{part_of(survival.n_read, run)}"
    shown = tuple(one for one in series if len(one.x))
    return CurvesChart(title, "cycle", "lost (%)", shown, whole=True, from_zero=True) if shown else None


def _lost(tracked: SurvivalCounts) -> Rate:
    rate = tracked.rate
    return Rate(rate.n_trials - rate.n, rate.n_trials)


def causes_chart(statistics: Statistics) -> LossCausesChart | None:
    """What a simulation's atoms were lost to; None where that is not known, or none were lost."""
    worst = sorted(statistics.losses.items(), key=lambda item: -item[1].value)
    shown = [(cause.replace("_", " "), loss) for cause, loss in worst if loss.value > 0]
    if not shown:
        return None
    causes, losses = zip(*shown, strict=True)
    means, errors = np.array([[loss.value, loss.error] for loss in losses]).T
    return LossCausesChart("lost in a shot, by cause", "atoms (the simulation's truth)", causes, means, errors)


def defects_chart(run: Run, statistics: Statistics) -> DefectsChart | None:
    """How many shots have how many defects in the end, and what independent sites would give."""
    cycles, n_sites = statistics.cycles, run.target.n_atoms
    counts = statistics.defects or (cycles[-1].defects if cycles else ())
    n_shots = sum(counts)
    if not n_shots or not n_sites:
        return None
    where = "on the last image" if statistics.defects else f"after cycle {len(cycles)}"
    number = np.arange(len(counts), dtype=np.float64)
    low, high = np.array([jeffreys(count, n_shots) for count in counts]).T
    shares = Series("shots" if n_shots > 1 else "shot", number, np.array(counts) / n_shots, low, high)
    empty = float(np.dot(counts, number)) / n_shots / n_sites
    title = f"{mean(np.repeat(number, counts))} defects in a shot, {n_shots} of {len(run.shots)} shots"
    return DefectsChart(title, f"defects {where}", shares, binomial(n_sites, empty, len(counts)))


def binomial(n: int, p: float, least: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Probabilities of 0, 1, 2, ... of n independent things that each happen with probability p.

    They go on as far as there is anything to see, and at least so far.

    Example:
        >>> binomial(2, 0.5, 1).tolist()
        [0.25, 0.5, 0.25]
    """
    if p <= 0.0 or p >= 1.0:
        return np.array([float(k == round(n * p)) for k in range(max(least, round(n * p) + 1))])
    steps = [math.log((n - k) / (k + 1)) + math.log(p / (1 - p)) for k in range(n)]
    terms = np.exp(np.concatenate([[0.0], np.cumsum(steps)]) + n * math.log1p(-p))
    seen = np.flatnonzero(terms > 1e-3)
    return terms[: min(n + 1, max(least, int(seen[-1]) + 1 if len(seen) else 0))]


def stages_chart(run: Run, timing: RunTiming) -> StagesChart | None:
    """The stages of a shot against their budgets; None if there is nothing to show."""
    clocks = ("modelled", "this computer") if run.simulated else ("measured",)
    bars: list[StageBar] = []
    for stage in timing.stages:
        if not stage.stage.startswith(STEP):
            session_s = stage.session_s if stage.session_s[0] > HIDDEN else (math.nan, math.nan)
            of = (session_s, stage.host_s) if run.simulated else (session_s,)
            bars.append(StageBar(stage.stage, of, stage.budget_s))
    if not bars:
        return None
    return StagesChart(f"stages of a shot{part_of(timing.n_read, run)}", clocks, tuple(bars))
