"""What `labseq check` advises beside its warnings: a planner that is expected to do better."""

from __future__ import annotations

from typing import Final

from labseq.assembly.lab import WARM_S, construct_planner
from labseq.assembly.plugin_choice import ChosenPlugin
from labseq.guard import Guard
from labseq.kernels.kernel import load_kernels
from labseq.motion.expectation import Expected, expect, random_loadings
from labseq.roles import NeedsWarmUp
from labseq.sequencer.lab import Lab
from labseq.session.prepared import PreparedRun
from labseq.session.rehearsal import loading_of, windows_of

CLEARLY: Final = 0.8
"""Another planner is worth a line if it leaves at most this part of the defects, and half a defect less."""
N_LOADINGS: Final = 12
"""Number of random loadings for which the two are compared."""


def better_planner(run: PreparedRun) -> str:
    """A line if the planner `auto` is expected to leave clearly fewer defects than that of a run; else "".

    Args:
        run: The run; it has been checked.
    """
    assembly = run.assembly
    entry = assembly.hardware.host.registry.find("planner", "auto")
    if entry is None or entry.settings_model is None or assembly.sequence.planner.use == "auto":
        return ""
    if assembly.target.is_none or not windows_of(assembly.steps):
        return ""
    chosen = ChosenPlugin(entry, entry.settings_model())
    guard = Guard(run.stop_flag)
    try:
        run.warm(lab := run.build_lab(), devices=False)
        now, then = guard.call("planner", WARM_S, _compare, lab, chosen)
    finally:
        guard.end()
    if then.n_defects > min(CLEARLY * now.n_defects, now.n_defects - 0.5):
        return ""
    return f"`auto`: {then.n_defects:.1f} defects after one cycle, {then}; here {now.n_defects:.1f}, {now}"


def _compare(lab: Lab, auto: ChosenPlugin) -> tuple[Expected, Expected]:
    """What the lab's planner and `auto` are expected to leave."""
    planner, most = construct_planner(auto, lab.grid, lab.motion)
    if isinstance(planner, NeedsWarmUp):
        planner.warm()
        load_kernels()
    loadings = random_loadings(lab.target.shape, loading_of(lab), N_LOADINGS)
    limits = (lab.planner, lab.degree_of_parallelism), (planner, most)
    now, then = (expect(one.plan, loadings, lab.target, n, lab.grid, lab.motion) for one, n in limits)
    return now, then
