"""Compare the predicted survival of plans with the simulation, and write the tables of its page.

    python docs/make_survival_table.py --shots 1000
    python docs/make_survival_table.py --shots 400 --played

In each setting, shots are loaded, planned on the true occupancy, played, and followed by one
exposure. Counted are the atoms that the moves, the exposure and the vacuum take until its end,
and the shots whose target is then whole; predicted are both for the same plans.

With ``--played``, `labseq run` takes shots of one cycle on `bench_awg`, where atoms fly in the samples
that the driver of the AWG plays. Counted are the atoms that the moves take.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from labseq_grid.planner import GridPlanner, GridSettings
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq import Session
from labseq.assembly.recorded import machine_of_shot
from labseq.model import LossSpec, MotionSpec
from labseq.model.estimate import Estimate, mean
from labseq.motion import check_plan, predict_survival, tone_program
from labseq.plugin import Context, DepthRamp, RandomStream, SiteGrid
from labseq.plugin.geometry import pattern

PAGE: Final = Path(__file__).parent / "explanation" / "survival.md"
EXPOSURE_S: Final = 45e-3
PLANNERS: Final[dict[str, Any]] = {"psca": (PscaPlanner, PscaSettings), "grid": (GridPlanner, GridSettings)}


@dataclass(frozen=True)
class Setting:
    """What one line of the table is about."""

    planner: str
    parallel: int
    losses: dict[str, float] = field(default_factory=dict)
    loading: float = 0.75
    lanes: str = "weaving"
    path_depth: float = 1.0
    lattice: Literal["triangular", "square"] = "triangular"

    @property
    def name(self) -> str:
        """The line's first column."""
        changed = [f"{key} {value:g}" for key, value in self.losses.items()]
        changed += [f"loading {self.loading:g}"] * (self.loading != 0.75)
        changed += [self.lanes] * (self.planner == "grid" and self.lattice == "triangular")
        changed += [f"path_depth {self.path_depth:g}"] * (self.path_depth != 1.0)
        changed += [self.lattice] * (self.lattice != "triangular")
        return ", ".join([f"`{self.planner}`, {self.parallel} tweezers", *changed])


SETTINGS: Final = (
    Setting("psca", 7),
    Setting("psca", 15),
    Setting("grid", 2),
    Setting("grid", 7),
    Setting("grid", 15),
    Setting("grid", 15, path_depth=0.8),
    Setting("grid", 15, lanes="straight"),
    Setting("grid", 15, lanes="straight", path_depth=0.8),
    Setting("grid", 15, lanes="straight", path_depth=0.6),
    Setting("psca", 7, lattice="square"),
    Setting("grid", 15, lattice="square"),
    Setting("grid", 15, {"move": 0.005}),
    Setting("grid", 15, {"spread": 0.0}),
    Setting("grid", 15, {"lifetime_s": 15.0}),
    Setting("psca", 15, {"move": 0.005}, loading=0.9),
)

SHOWN: Final = (0, 4, 5, 6, 7, 8, 10, 13, 14)
"""Those in the table of the page, by their index."""


def measure(setting: Setting, n_shots: int) -> dict[str, tuple[Estimate, Estimate]]:
    """Simulated and predicted, for atoms lost and shots without a defect."""
    losses = replace(LossSpec(image=0.00314), **setting.losses)
    motion, grid = MotionSpec(losses=losses, path_depth=setting.path_depth), SiteGrid(lattice=setting.lattice)
    target = pattern(np.ones((15, 15), np.bool_), grid, name="compact 15 x 15")
    settings = SimulationSettings.model_validate(
        {
            "transport_loss": losses.move,
            "transport_loss_spread": losses.spread,
            "lifetime": losses.lifetime_s,
            "loading": setting.loading,
            "image": {"frame": (2, 2), "background": 0.0},
        }
    )
    random = RandomStream(1)
    simulation = VirtualSimulation(settings, Context("simulation", grid, motion, random=random))
    simulation.open()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    planner_class, settings_class = PLANNERS[setting.planner]
    options: dict[str, Any] = {"degree_of_parallelism": setting.parallel}
    if setting.planner == "grid":
        options["lanes"] = setting.lanes
    planner = planner_class(settings_class.model_validate(options), Context(grid=grid, motion=motion))
    found: list[tuple[float, ...]] = []
    for shot in range(n_shots):
        now_s = 100.0 * shot
        random.begin_shot(shot, 0)
        simulation.begin_shot()
        simulation.load(now_s, 1.0)
        before = simulation.truth()
        if before.sum() < target.n_atoms:
            continue
        plan = planner.plan(before, target)
        report = check_plan(plan, before, target, setting.parallel, grid, motion)
        start_s = now_s + 1.0 + motion.overhead_per_cycle_s
        simulation.play("mobile_tweezers", tone_program(plan, grid=grid, motion=motion), start_s)
        simulation.expose(now_s + 1.0 + report.duration_s, EXPOSURE_S)
        after = simulation.truth()
        predicted = predict_survival(plan, report, before, target, grid, motion, EXPOSURE_S)
        found.append(
            (
                float(before.sum() - after.sum()),
                predicted.n_lost,
                float(after[target.fill].all()),
                predicted.p_defect_free,
            )
        )
    lost, lost_predicted, whole, whole_predicted = np.array(found, np.float64).T
    return {"lost": (mean(lost), mean(lost_predicted)), "whole": (mean(whole), mean(whole_predicted))}


def table(n_shots: int) -> list[str]:
    """The table, and how far the predictions are off in all."""
    header = ("setting", "atoms lost", "predicted", "defect-free", "predicted")
    lines, deviations = [], list[float]()
    for setting in SETTINGS:
        cells = [setting.name]
        for simulated, predicted in measure(setting, n_shots).values():
            cells += [str(simulated), f"{predicted.value:.3g}"]
            if simulated.error > 0:  # not where no shot of all is whole
                deviations.append((simulated.value - predicted.value) / simulated.error)
        sys.stderr.write(" | ".join(cells) + "\n")
        if SETTINGS.index(setting) in SHOWN:
            lines.append("| " + " | ".join(cells) + " |")
    spread = float(np.sqrt(np.mean(np.square(deviations))))
    head = ["| " + " | ".join(row) + " |" for row in (header, ["---"] * len(header))]
    largest = max(map(abs, deviations))
    n = len(deviations)
    what = f"{n} values of {len(SETTINGS)} settings"
    note = f"The {what} deviate by {spread:.2f} standard errors (r.m.s.), by {largest:.1f} at most."
    return [*head, *lines, "", note]


PLAYED: Final = (0, 4, 5, 6, 10)
"""The settings that are played, by their index."""
BY_MOVES: Final = ("hand_over", "transport", "collision", "heat", "program")
"""Causes of losses that the moves are to blame for, as the simulation counts them."""
SEQUENCE: Final = """
labseq: 1
name: survival
profile: bench_awg
target: {pattern: compact, rows: 15, cols: 15}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1, window: 60 ms, exposure: 45 ms}
"""


def play(setting: Setting, n_shots: int, folder: Path) -> tuple[Estimate, Estimate]:
    """Atoms that the moves of one cycle took on `bench_awg`, and those predicted for the same plans."""
    sequence = folder / "survival.yaml"
    sequence.write_text(SEQUENCE, encoding="utf-8")
    lanes = f", lanes: {setting.lanes}" if setting.planner == "grid" else ""
    overrides = [
        f"planner={{use: {setting.planner}, degree_of_parallelism: {setting.parallel}{lanes}}}",
        f"profile.mobile_tweezers.path_depth={setting.path_depth}",
        f"profile.grid.lattice={setting.lattice}",
    ]
    with Session.open(sequence, shots=n_shots, seed=1, overrides=overrides, output=folder) as session:
        run = session.run()
    lost, predicted = list[float](), list[float]()
    losses = LossSpec(image=0.0, lifetime_s=2.592e6)
    for shot in run.shots:
        (cycle,) = shot.cycles
        before, machine = shot.images[0].occupancy, machine_of_shot(shot)
        motion = replace(machine.motion, losses=losses)
        checked = before, shot.target, setting.parallel, machine.grid, motion
        report = check_plan(cycle.plan, *checked)
        survival = predict_survival(cycle.plan, report, before, shot.target, machine.grid, motion)
        lost.append(sum(shot.row.simulation[f"lost.{cause}"] for cause in BY_MOVES))
        predicted.append(survival.n_lost)
    return mean(lost), mean(predicted)


def played_table(n_shots: int) -> list[str]:
    """What `bench_awg` played, and what was predicted."""
    lines = ["| setting | atoms lost | predicted |", "| --- | --- | --- |"]
    for number in PLAYED:
        with tempfile.TemporaryDirectory() as folder:
            played, predicted = play(SETTINGS[number], n_shots, Path(folder))
        lines.append(f"| {SETTINGS[number].name} | {played} | {predicted.value:.3g} |")
        sys.stderr.write(lines[-1] + "\n")
    return lines


def main() -> None:
    """Measure, and replace a table of the page."""
    parser = argparse.ArgumentParser(description="Compare predicted and simulated survival.")
    parser.add_argument("--shots", type=int, default=1000)
    parser.add_argument("--played", action="store_true")
    arguments = parser.parse_args()
    n_shots = arguments.shots
    command = f"python docs/make_survival_table.py --shots {n_shots}" + " --played" * arguments.played
    made = (played_table if arguments.played else table)(n_shots)
    body = ["", "<!-- not run: takes minutes -->", "```console", command, "```", "", *made, ""]
    text = PAGE.read_text(encoding="utf-8")
    name = "played" if arguments.played else "survival"
    part = re.compile(rf"(?<=<!-- measured: {name} -->\n).*?(?=<!-- end -->)", re.DOTALL)
    PAGE.write_text(part.sub(lambda _: "\n".join(body) + "\n", text), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
