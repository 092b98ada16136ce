"""Advice of `labseq check` next to its warnings, about a planner that is expected to do better."""

from __future__ import annotations

from typing import Final

from labseq.assembly.lab import WARM_S, choice_of
from labseq.assembly.planning import construct_planner
from labseq.assembly.plugin_choice import ChosenPlugin
from labseq.errors import LabseqError, StopRequested
from labseq.guard import Guard
from labseq.motion.expectation import Expected, expect, random_loadings
from labseq.roles import Context, loading_of
from labseq.sequencer.lab import Lab
from labseq.session.prepared import PreparedRun
from labseq.session.rehearsal import first_window_s

N_LOADINGS: Final = 12
"""Number of random loadings for which the two planners are compared."""


def better_planner(run: PreparedRun, lab: Lab) -> str:
    """A line if the planner `auto` should leave clearly fewer defects than the run's planner, else "".

    Args:
        run: The run, which has been checked.
        lab: The lab at its first point, with warm kernels.
    """
    assembly = run.assembly
    entry = assembly.hardware.host.registry.find("planner", "auto")
    if entry is None or entry.settings_model is None or assembly.sequence.planner.use == "auto":
        return ""
    window_s = first_window_s(assembly.steps)
    # the points of a scan are compared by taking it
    if (
        assembly.target.is_none
        or window_s is None
        or assembly.scanned is not None
        or assembly.search is not None
    ):
        return ""
    chosen = ChosenPlugin(entry, entry.settings_model())
    guard = Guard(run.stop_flag)
    try:
        now, then, choice = guard.call("planner", WARM_S, _compare, lab, chosen, window_s)
    except StopRequested:
        raise
    except LabseqError:  # the check itself reports problems of a planner
        return ""
    finally:
        guard.end()
    # another planner is worth a line if it leaves at most 80 % of the defects, and half a defect less
    if then.n_defects > min(0.8 * now.n_defects, now.n_defects - 0.5):
        return ""
    there, here = f"{then.n_defects:.1f} defects after one cycle", f"{now.n_defects:.1f}, {now}"
    return f"`auto`, which is {choice}: {there}, {then}; here {here}"


def _compare(lab: Lab, auto: ChosenPlugin, window_s: float) -> tuple[Expected, Expected, str]:
    """The expected results of the lab's planner and of `auto`, and the choice of `auto`."""
    planner, most = construct_planner(
        auto, Context(grid=lab.grid, motion=lab.motion, simulation=lab.simulation)
    )
    choice, *_ = choice_of(planner, lab.target, window_s)
    loadings = random_loadings(lab.target.shape, loading_of(lab.simulation), N_LOADINGS)
    limits = (lab.planner, lab.degree_of_parallelism), (planner, most)
    now, then = (
        expect(one.plan, loadings, lab.target, n, lab.grid, lab.motion, window_s) for one, n in limits
    )
    return now, then, choice.partition(":")[0]
