"""How detection, planning, checking, tones, rendering and recording grow with the array: table and picture.

    python docs/make_scale.py [--loadings 5]

Arrays of 20 x 20 to 100 x 100 sites with a compact target of 0.7 of that width. The command replaces the
part of ``docs/explanation/scale.md`` between ``<!-- measured: scale -->`` and ``<!-- end -->``. Times are
medians of the processor's time of this process, all threads together.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import matplotlib.pyplot as plt
import numpy as np
from labseq_grid.planner import GridPlanner, GridSettings
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_rivals.planners import LineSettings, Mta1Planner, TetrisPlanner

from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.model import CycleRecord, ImageRecord, PlanReport, RunRecord, ShotRecord
from labseq.model.grid import centred_comb
from labseq.motion import check_plan, tone_program
from labseq.motion.rendering import Renderer
from labseq.plain import now_utc
from labseq.plugin import Context, Frame, MotionSpec, Occupancy, Plan, SiteGrid, TargetPattern, ToneProgram
from labseq.plugin.geometry import pattern
from labseq.plugin.motion import RfSpec
from labseq.recording.writer import RunWriter

PAGE: Final = Path(__file__).parent / "explanation" / "scale.md"
PICTURE: Final = Path(__file__).parent / "_static" / "planners" / "scale.png"
SIZES: Final = (20, 30, 45, 64, 100)
LOADINGS: Final = (0.55, 0.85)
SHOWN: Final = (20, 45, 100)
"""Sizes in the table; the power is fitted to all."""
BAND_HZ: Final = 35.4e6
"""All sites and an ejection slot at each end share it, as in the profile ``large``."""
CHUNK: Final = 1 << 18
"""Samples that are rendered at a time, as by a card's driver."""
PLANNERS: Final[dict[str, tuple[Any, Any]]] = {
    "psca": (PscaPlanner, PscaSettings),
    "grid": (GridPlanner, GridSettings),
    "tetris": (TetrisPlanner, LineSettings),
    "mta1": (Mta1Planner, LineSettings),
}


def cpu_s(call: Callable[[], Any]) -> tuple[float, Any]:
    """Time of a call, and its result."""
    start_s = time.process_time()
    made = call()
    return time.process_time() - start_s, made


def render_chunks(program: ToneProgram) -> None:
    """Render both channels, into the same memory again and again."""
    renderer, out = Renderer(program), np.empty(CHUNK, np.int16)
    for start in range(0, renderer.n_samples, CHUNK):
        for channel in (0, 1):
            renderer.write(channel, start, out)


def record(frame: Frame, atoms: Occupancy, target: TargetPattern, plan: Plan, report: PlanReport) -> float:
    """Processor time of writing a shot with two frames and one cycle to the disk."""
    now = now_utc()
    run = RunRecord(
        name="scale",
        n_shots=1,
        seed=1,
        simulated=True,
        t_start_utc=now,
        target=target,
        sequence_text="",
        profile_text="",
        sequence_path="",
        profile_path="",
        resolved={},
        overrides={},
        devices={},
        plugins=(),
        provenance={},
        record_frames="all",
        grid_spacing_m=4.49e-6,
        lattice="triangular",
    )
    signal = np.ones(atoms.shape, np.float32)
    images = [ImageRecord(frame, atoms, signal, 1, cycle, 0.0, 45e-3) for cycle in (-1, 0)]
    cycle = CycleRecord(2, 0, plan, report, plan.n_batches, 0.06, 0.1, 0.03)
    shot = ShotRecord(0, 0, 1, now, now, "complete", images=images, cycles=[cycle])
    with tempfile.TemporaryDirectory() as folder:
        writer = RunWriter.create(Path(folder), run)
        return cpu_s(lambda: writer.write_shot(shot))[0]


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
                if k < 2:
                    took[f"render, {name}"], _ = cpu_s(lambda p=program: render_chunks(p))
                took[f"record, {name}"] = record(frame, atoms, target, plan, report)
            for what, value in took.items():
                if k > 0:  # the first compiles
                    found[what].append(value)
        seconds, _ = cpu_s(lambda: detector.detect(frame))
        found["detect, 2048 x 2048"].append(seconds)
    return {what: float(np.median(values)) for what, values in found.items()}


def table(results: dict[float, dict[int, dict[str, float]]]) -> list[str]:
    """A line per kind of work, with the power of the number of sites."""
    head = ["work", "loading", *(f"{n} x {n}" for n in SHOWN), "power of the sites"]
    lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head))]
    for loading, by_size in results.items():
        for what in by_size[SIZES[0]]:
            if what.startswith(("record", "check", "tones")) or what.endswith(("tetris", "mta1")):
                continue
            values = [by_size[n].get(what, np.nan) for n in SIZES]
            unit = 1.0 if what.startswith("batches") else 1e3
            shown = [v for n, v in zip(SIZES, values, strict=True) if n in SHOWN]
            texts = ["-" if np.isnan(v) else f"{unit * v:.3g}" + ("" if unit == 1 else " ms") for v in shown]
            known = [(n * n, v) for n, v in zip(SIZES, values, strict=True) if v > 0]
            n_sites, seconds = np.log(np.array(known)).T
            power = float(np.polyfit(n_sites, seconds, 1)[0])
            lines.append("| " + " | ".join([what, f"{100 * loading:g} %", *texts, f"{power:.2f}"]) + " |")
    return lines


def draw(results: dict[float, dict[int, dict[str, float]]]) -> None:
    """The growth at the higher loading."""
    figure, axes = plt.subplots(figsize=(6, 4.4), layout="constrained")
    axes.set_prop_cycle(color=plt.get_cmap("tab20").colors)  # type: ignore[attr-defined]
    by_size = results[LOADINGS[-1]]
    for what in by_size[SIZES[0]]:
        if what.startswith("batches"):
            continue
        points = [(n * n, 1e3 * by_size[n][what]) for n in SIZES if what in by_size[n]]
        style = {
            "plan": "o-",
            "check": "s--",
            "tones": "^:",
            "render": "d-.",
            "detect": "k+-",
            "record": "x-",
        }
        axes.loglog(*zip(*points, strict=True), style[what.partition(",")[0]], label=what, markersize=4)
    axes.set_xlabel("sites")
    axes.set_ylabel("processor time (ms)")
    figure.legend(loc="outside lower center", frameon=False, fontsize=7, ncols=4)
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
