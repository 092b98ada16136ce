"""Plans for random loadings, as in the rearrangements of a shot."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LabseqError, Problem, StopRequested
from labseq.guard import Guard
from labseq.model import Plan, PlanReport
from labseq.motion import check_plan, fitting_batches
from labseq.roles import Step, loading_of
from labseq.sequencer.lab import Lab

SURVIVAL: Final = 0.98
"""Fraction of the atoms that survive a cycle of a rehearsal (in the paper 97.66 % of the target do)."""


class FirstCycle(NamedTuple):
    """The first cycle of a rearrangement, with plan, report, and whether there were enough atoms."""

    plan: Plan
    report: PlanReport
    has_enough: bool


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """The planner's results for random loadings.

    Attributes:
        n_loadings: Number of loadings.
        n_enough: Number of loadings with enough atoms for the target.
        n_filled: Number of loadings with a plan that fills the target.
        duration_s: float64 (n_loadings,), from the start of a cycle to the end of its last batch.
        first_batch_s: float64 (n_loadings,), the same for its first batch.
    """

    n_loadings: int
    n_enough: int
    n_filled: int
    duration_s: NDArray[np.float64]
    first_batch_s: NDArray[np.float64]

    def quantile_s(self, share: float) -> float:
        """Duration within which a share of the plans end."""
        return quantile(self.duration_s, share)


def quantile(values: NDArray[np.float64], share: float) -> float:
    """Quantile of at least one value, because numpy's imports ``numpy.ma`` in 40 ms."""
    ranks = np.arange(len(values))
    return float(np.interp(share * ranks[-1], ranks, np.sort(values)))


def windows_of(steps: Sequence[tuple[str, Step]]) -> dict[int, tuple[float, ...]]:
    """Step number -> window per cycle, of each rearrangement."""
    windows = {number: step.windows_s for number, (_, step) in enumerate(steps)}
    return {number: windows_s for number, windows_s in windows.items() if windows_s}


def first_window_s(steps: Sequence[tuple[str, Step]]) -> float | None:
    """Window of the first cycle of a shot, in seconds. None without a rearrangement."""
    return next((windows_s[0] for windows_s in windows_of(steps).values()), None)


def rehearse(
    guard: Guard, lab: Lab, windows: Sequence[Sequence[float]], n_loadings: int, deadline: float
) -> tuple[list[Rehearsal], list[Plan], Problem | None]:
    """Plan for random loadings. The seed of each is its number, as in `labseq plan random:... --seed N`.

    Returns:
        The results of each rearrangement, some of the plans, and the planner's failure.
    """
    loading = loading_of(lab.simulation)
    shots: list[list[FirstCycle]] = []
    cycles: list[FirstCycle] = []

    def plan() -> None:
        """All in one guarded call, because handing each plan over to a thread takes longer than planning."""
        while len(shots) < n_loadings and (not shots or time.monotonic() < deadline):
            cycles.clear()
            for cycle in _first_cycles(lab, windows, loading, len(shots)):
                cycles.append(cycle)  # noqa: PERF402 - those before a failure are kept
            shots.append([*cycles])

    failure: Problem | None = None
    try:
        guard.call("planner", lab.timeouts.plan_s + max(0.0, deadline - time.monotonic()), plan)
    except StopRequested:
        raise
    except LabseqError as error:
        drawn, seed = f"random:{lab.grid.n_rows}x{lab.grid.n_cols}@{loading:g}", len(shots)
        what = f"it fails on a random loading of {100 * loading:.0f} % (seed {seed}): {error}"
        # only the first plan is made for the loading itself
        failure = Problem(what, hint="" if cycles else f"see it with: labseq plan {drawn} --seed {seed}")
    # the tones of at most five plans are computed
    plans = [cycle.plan for shot in shots for cycle in shot if cycle.plan.n_batches][:5]
    rehearsals = [_summary(first_cycles) for first_cycles in zip(*shots, strict=True)]
    return rehearsals, plans, failure


def _first_cycles(
    lab: Lab, windows: Sequence[Sequence[float]], loading: float, seed: int
) -> Iterator[FirstCycle]:
    """The first cycle of each rearrangement, which begins where the previous rearrangement ends."""
    rng = np.random.default_rng(seed)
    occupancy = rng.random(lab.grid.shape) < loading

    def checked(plan: Plan) -> PlanReport:
        dop, name = lab.degree_of_parallelism, lab.planner_name
        return check_plan(plan, occupancy, lab.target, dop, lab.grid, lab.motion, name)

    for number, windows_s in enumerate(windows):
        for cycle, window_s in enumerate(windows_s):
            plan = lab.planner.plan(occupancy.copy(), lab.target)
            report = checked(plan)
            if cycle == 0:
                yield FirstCycle(plan, report, int(occupancy.sum()) >= lab.target.n_atoms)
            # later cycles are planned only to know where the next rearrangement begins
            if number == len(windows) - 1:
                break
            n_played = fitting_batches(report, plan, window_s)
            after = report if n_played == plan.n_batches else checked(plan.first(n_played))
            occupancy = after.predicted & (rng.random(lab.grid.shape) < SURVIVAL)
            if lab.target.is_met_by(occupancy):
                break


def _summary(cycles: Sequence[FirstCycle]) -> Rehearsal:
    reports = [cycle.report for cycle in cycles]
    durations = np.array([report.duration_s for report in reports])
    firsts = np.array(
        [float(report.batch_end_s[0]) if len(report.batch_end_s) else 0.0 for report in reports]
    )
    n_enough = sum(cycle.has_enough for cycle in cycles)
    n_met = sum([report.meets_target for report in reports])
    return Rehearsal(len(reports), n_enough, n_met, durations, firsts)
