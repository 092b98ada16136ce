"""How planning, checking, tones, rendering and detection grow with the array: table and picture.

    python docs/make_scale.py [--loadings 5]

Arrays of 20 x 20 to 100 x 100 sites with a compact target of 0.7 of that width. The command replaces the
part of ``docs/explanation/scale.md`` between ``<!-- measured: scale -->`` and ``<!-- end -->``. Times are
medians of the processor's time of this process, all threads together.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import matplotlib.pyplot as plt
import numpy as np
from labseq_grid.planner import GridPlanner, GridSettings
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_scans.planners import Mta1Planner, Mta1Settings, TetrisPlanner, TetrisSettings

from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.geometry import pattern
from labseq.model.grid import centred_comb
from labseq.motion import check_plan, render, tone_program
from labseq.plugin import Context, Frame, MotionSpec, RfSpec, SiteGrid

PAGE: Final = Path(__file__).parent / "explanation" / "scale.md"
PICTURE: Final = Path(__file__).parent / "_static" / "planners" / "scale.png"
SIZES: Final = (20, 30, 45, 64, 100)
LOADINGS: Final = (0.55, 0.85)
BAND_HZ: Final = 35.4e6
"""All sites and an ejection slot at each end share it, as in the profile ``large``."""
RENDERED: Final = 64
"""Up to this size waveforms are rendered: longer ones need more memory than they tell."""
PLANNERS: Final[dict[str, tuple[Any, Any]]] = {
    "psca": (PscaPlanner, PscaSettings),
    "grid": (GridPlanner, GridSettings),
    "tetris": (TetrisPlanner, TetrisSettings),
    "mta1": (Mta1Planner, Mta1Settings),
}


def cpu_s(call: Callable[[], Any]) -> tuple[float, Any]:
    """Time of a call, and its result."""
    start_s = time.process_time()
    made = call()
    return time.process_time() - start_s, made


def measure(n: int, loading: float, n_loadings: int) -> dict[str, float]:
    """Medians for one size: seconds by kind of work, and batches by planner."""
    hz = centred_comb(n, step_hz=BAND_HZ / (n + 1))
    grid = SiteGrid(n, n, row_frequency_hz=hz, column_frequency_hz=hz)
    rf = RfSpec(min_spacing_hz=150e3)
    motion = MotionSpec(max_tweezers=n, max_row_tones=n, max_column_tones=n, overhead_per_cycle_s=0, rf=rf)
    width = round(0.7 * n)
    target = pattern(np.ones((width, width), np.bool_), grid, name="compact")
    found: defaultdict[str, list[float]] = defaultdict(list)
    rng = np.random.default_rng(1)
    planners = {
        name: planner(settings(degree_of_parallelism=n), Context(grid=grid, motion=motion))
        for name, (planner, settings) in PLANNERS.items()
    }
    frame = Frame(rng.poisson(530, (2048, 2048)).astype(np.uint16), 45e-3, 0.0)
    sensor = ThresholdSettings(frame=(2048, 2048), centre_px=(1023.5, 1023.5), region=5)
    detector = ThresholdDetector(sensor, Context("detector", grid))
    for k in range(n_loadings + 1):
        atoms = rng.random(grid.shape) < loading
        for name, planner in planners.items():
            took: dict[str, float] = {}
            took[f"plan, {name}"], plan = cpu_s(lambda p=planner, a=atoms: p.plan(a, target))
            took[f"batches, {name}"] = float(np.count_nonzero(~plan.linked))
            if name in ("psca", "grid"):
                took[f"check, {name}"], report = cpu_s(
                    lambda q=plan, a=atoms: check_plan(q, a, target, n, grid, motion)
                )
                assert report.meets_target or atoms.sum() < target.n_atoms
                took[f"tones, {name}"], program = cpu_s(lambda q=plan: tone_program(q, grid, motion))
                if n <= RENDERED and k < 2:
                    took[f"render, {name}"], _ = cpu_s(lambda p=program: render(p))
            for what, value in took.items():
                if k > 0:  # the first compiles
                    found[what].append(value)
        seconds, _ = cpu_s(lambda: detector.detect(frame))
        found["detect, 2048 x 2048"].append(seconds)
    return {what: float(np.median(values)) for what, values in found.items()}


def table(results: dict[float, dict[int, dict[str, float]]]) -> list[str]:
    """A line per kind of work, with the power of the number of sites."""
    head = ["work", "loading", *(f"{n} x {n}" for n in SIZES), "power of the sites"]
    lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head))]
    for loading, by_size in results.items():
        for what in by_size[SIZES[0]]:
            values = [by_size[n].get(what, np.nan) for n in SIZES]
            unit = 1.0 if what.startswith("batches") else 1e3
            texts = ["-" if np.isnan(v) else f"{unit * v:.3g}" + ("" if unit == 1 else " ms") for v in values]
            known = [(n * n, v) for n, v in zip(SIZES, values, strict=True) if v > 0]
            n_sites, seconds = np.log(np.array(known)).T
            power = float(np.polyfit(n_sites, seconds, 1)[0])
            lines.append("| " + " | ".join([what, f"{100 * loading:g} %", *texts, f"{power:.2f}"]) + " |")
    return lines


def draw(results: dict[float, dict[int, dict[str, float]]]) -> None:
    """The growth at the higher loading."""
    figure, axes = plt.subplots(figsize=(6, 4.4), layout="constrained")
    by_size = results[LOADINGS[-1]]
    for what in by_size[SIZES[0]]:
        if what.startswith("batches"):
            continue
        points = [(n * n, 1e3 * by_size[n][what]) for n in SIZES if what in by_size[n]]
        style = {"plan": "o-", "check": "s--", "tones": "^:", "render": "d-.", "detect": "k+-"}
        axes.loglog(*zip(*points, strict=True), style[what.partition(",")[0]], label=what, markersize=4)
    axes.set_xlabel("sites")
    axes.set_ylabel("processor time (ms)")
    axes.legend(frameon=False, fontsize=7, ncols=2)
    figure.savefig(PICTURE, dpi=110)


def main() -> None:
    """Measure, and write table and picture."""
    parser = argparse.ArgumentParser(description="Measure how labseq's work grows with the array.")
    parser.add_argument("--loadings", type=int, default=5)
    n_loadings = parser.parse_args().loadings
    results: dict[float, dict[int, dict[str, float]]] = {}
    for loading in LOADINGS:
        results[loading] = {}
        for n in SIZES:
            results[loading][n] = measure(n, loading, n_loadings)
            sys.stderr.write(f"{n} x {n} at {loading:g}: {results[loading][n]}\n")
    draw(results)
    text = PAGE.read_text(encoding="utf-8")
    part = re.compile(r"(?<=<!-- measured: scale -->\n).*?(?=<!-- end -->)", re.DOTALL)
    body = "\n".join(["", *table(results), "", ""])
    PAGE.write_text(part.sub(lambda _: body, text), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
