"""Compare the losses of the fast virtual lab with those of atoms that fly in the played samples.

    python docs/make_response_figures.py

At each point of a grid of speed, ramps, depth and displacement, the same batch is carried out by tables, in
``virtual``, and by integrated motion, as in ``bench_awg``; the loss that settings add is off. The table is
written to ``_static/virtual/responses.csv`` and printed for the page, the picture to ``responses.png``.
"""

from __future__ import annotations

import csv
import math
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from labseq_virtual.flight import RfTransport
from labseq_virtual.rf_analysis import PulseReceiver
from labseq_virtual.settings import MobileLightSettings, SimulationSettings
from labseq_virtual.transport import Transport
from numpy.typing import NDArray

from labseq.model import MotionSpec, Plan, RfSamples, RfSpec, SiteGrid, ToneProgram
from labseq.motion import tone_program
from labseq.motion.rendering import render

FOLDER: Final = Path(__file__).parent / "_static" / "virtual"
SPEEDS: Final = (0.13, 0.25, 0.35, 0.5)
RAMPS_S: Final = (2e-6, 60e-6)
DEPTHS_K: Final = (1.0e-3, 2.1e-3)
AWAY_M: Final = (0.0, 0.5e-6, 0.8e-6, 1.1e-6)
ROW, COLUMNS, WAY = 9, range(0, 12, 2), 7
N_REPEATS: Final = 60
RATE_HZ, FULL_SCALE_V = 624e6, 0.2
GRID: Final = SiteGrid()


class Point(NamedTuple):
    """A point of the grid; in SI."""

    speed: float
    ramp_s: float
    depth_k: float
    away_m: float


class Played:
    """Outputs that have played a program."""

    def __init__(self, program: ToneProgram) -> None:
        samples = render(program, RATE_HZ).samples
        self._spans = tuple([RfSamples(1.0, RATE_HZ, one, FULL_SCALE_V / 32767)] for one in samples)

    def played(self, until_s: float) -> tuple[list[RfSamples], list[RfSamples]]:
        """All of it, at the first call."""
        del until_s
        (row, column), self._spans = self._spans, ([], [])
        return row, column


def losses(point: Point) -> tuple[int, int, int]:
    """Atoms lost by the tables, by the integrated motion, and their number."""
    rf = RfSpec(full_scale_v=FULL_SCALE_V, max_peak_v=FULL_SCALE_V)
    motion = replace(
        MotionSpec(rf=rf), speed_m_s=point.speed, pick_up_s=point.ramp_s, drop_off_s=point.ramp_s
    )
    light = MobileLightSettings(depth=point.depth_k, offset=(0.0, point.away_m))
    settings = SimulationSettings(transport_loss=0.0, depth_disorder=0.0, mobile_light=light)
    sources, goals = ([(ROW, column + way) for column in COLUMNS] for way in (0, WAY))
    program = tone_program(Plan.from_batches([(sources, goals)]), GRID, motion)
    depth, rng = np.ones(GRID.shape), np.random.default_rng(7)
    fast, slow = Transport(GRID, motion, settings), RfTransport(GRID, motion, settings)
    (pulse,) = PulseReceiver(Played(program), 60e-6).receive_until(100.0)
    kept = [0, 0]
    for _ in range(N_REPEATS):
        each: list[NDArray[np.bool_]] = []
        for _ in kept:
            occupied = np.zeros(GRID.shape, np.bool_)
            occupied[tuple(np.transpose(sources))] = True
            each.append(occupied)
        fast.carry(each[0], program, program.n_segments, depth, rng, 1.0)
        slow.carry(each[1], pulse, depth, rng, 1.0)
        kept = [n + int(one[tuple(np.transpose(goals))].sum()) for n, one in zip(kept, each, strict=True)]
    n = N_REPEATS * len(sources)
    return n - kept[0], n - kept[1], n


def error(lost: int, n: int) -> float:
    """Standard error of a fraction, never 0."""
    part = (lost + 0.5) / (n + 1)
    return math.sqrt(part * (1 - part) / n)


def draw(found: list[tuple[Point, tuple[int, int, int]]]) -> None:
    """Draw one against the other."""
    figure, axes = plt.subplots(figsize=(4.6, 4.4), layout="constrained")
    for away_m in AWAY_M:
        mine = [one for point, one in found if point.away_m == away_m]
        x, y = (np.array([one[k] / one[2] for one in mine]) for k in (1, 0))
        bars = [[error(one[k], one[2]) for one in mine] for k in (1, 0)]
        axes.errorbar(x, y, bars[1], bars[0], "o", ms=4, label=f"{away_m * 1e6:.1f} um beside the site")
    axes.plot([0, 1], [0, 1], color="0.6", lw=1)
    axes.set(xlabel="loss, integrated motion (bench_awg)", ylabel="loss, tables (virtual)")
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(FOLDER / "responses.png", dpi=120)


def main() -> None:
    """Compute, write and draw all points."""
    points = [Point(*each) for each in product(SPEEDS, RAMPS_S, DEPTHS_K, AWAY_M)]
    with ProcessPoolExecutor(2) as pool:
        found = list(zip(points, pool.map(losses, points), strict=True))
    FOLDER.mkdir(exist_ok=True)
    lines = [["speed_um_per_ms", "ramp_us", "depth_mK", "away_um", "virtual", "error", "bench_awg", "error"]]
    far: list[float] = []
    for point, (fast, slow, n) in found:
        errors = error(fast, n), error(slow, n)
        far.append((fast - slow) / n)
        numbers = [fast / n, errors[0], slow / n, errors[1]]
        scaled = point.speed * 1e3, point.ramp_s * 1e6, point.depth_k * 1e3, point.away_m * 1e6
        lines.append([f"{each:g}" for each in scaled] + [f"{each:.3f}" for each in numbers])
    with (FOLDER / "responses.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)
    for line in lines:
        sys.stdout.write("| " + " | ".join(line) + " |\n")
    rms = math.sqrt(np.mean(np.square(far)))
    sys.stdout.write(f"{len(far)} points: r.m.s. difference {rms:.3f}, greatest {max(map(abs, far)):.3f}\n")
    draw(found)


if __name__ == "__main__":
    main()
