"""Compare the losses of the fast virtual lab with those of atoms that fly in the played samples.

    python docs/make_response_figures.py

At each point of a grid of speed, ramps, depth and displacement, the same batch is carried out by tables, in
``virtual``, and by integrated motion, as in ``bench_awg``; the loss that settings add is off. Further points
have one tweezer without an atom, which goes off on an atom or passes between two rows of them. The tables are
written to ``_static/virtual/responses.csv`` and ``empty_tweezers.csv``, the picture to ``responses.png``.
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
from labseq_virtual.atoms import Atoms
from labseq_virtual.flight import RfTransport
from labseq_virtual.rf_analysis import PulseReceiver
from labseq_virtual.settings import MobileLightSettings, SimulationSettings
from labseq_virtual.transport import Transport
from numpy.typing import NDArray

from labseq.model import AxisTones, MotionSpec, Plan, RfSamples, RfSpec, SiteGrid, ToneProgram
from labseq.motion import tone_program
from labseq.motion.rendering import render

FOLDER: Final = Path(__file__).parent / "_static" / "virtual"
SPEEDS: Final = (0.13, 0.25, 0.35, 0.5)
RAMPS_S: Final = (2e-6, 60e-6)
DEPTHS_K: Final = (1.0e-3, 2.1e-3)
AWAY_M: Final = (0.0, 0.5e-6, 0.8e-6, 1.1e-6)
ROW, COLUMNS, WAY = 9, range(0, 12, 2), 7
N_REPEATS: Final = 60
LANDING_DEPTHS_K, PASSING_DEPTHS_K, TEMPERATURES_K = (
    (0.4e-3, 0.6e-3, 1.0e-3, 2.1e-3),
    (1.0e-3, 2.1e-3),
    (15e-6, 30e-6),
)
LANDING_SITE, LANE_ROW, LANE_END, PASSED = 4, 9.5, 12, range(3, 10)
RATE_HZ, FULL_SCALE_V = 624e6, 0.2
GRID: Final = SiteGrid()


class Point(NamedTuple):
    """A point of the grid; in SI."""

    speed: float
    ramp_s: float
    depth_k: float
    away_m: float


class Empty(NamedTuple):
    """A tweezer without an atom; in SI."""

    lands: bool
    speed: float
    depth_k: float
    temperature_k: float

    @property
    def passed(self) -> list[tuple[int, int]]:
        """Sites of the atoms on its way."""
        return [(ROW, LANDING_SITE)] if self.lands else [(ROW + i, c) for i in (0, 1) for c in PASSED]

    def program(self) -> ToneProgram:
        """One tweezer that is ramped up in 60 us, moves along a row, and is ramped down."""
        row, end = (float(ROW), LANDING_SITE) if self.lands else (LANE_ROW, LANE_END)
        row_hz = float(np.interp(row, range(GRID.shape[0]), GRID.row_frequency_hz))
        column_hz = GRID.column_frequency_hz[[0, end]]
        duration_s = np.array([60e-6, end * GRID.spacing_m / self.speed, 60e-6])
        ramps = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]) / GRID.shape[0]

        def axis(hz: NDArray[np.float64], amplitude: NDArray[np.float64]) -> AxisTones:
            cycles = np.cumsum(hz.mean(axis=1) * duration_s) % 1.0
            phase = 2 * np.pi * np.concatenate([[0.0], cycles[:-1]])
            (hz_0, hz_1), (level_0, level_1) = hz.T, amplitude.T
            return AxisTones(np.arange(4, dtype=np.int32), hz_0, hz_1, level_0, level_1, phase)

        rows = axis(np.full((3, 2), row_hz), np.full((3, 2), 1 / GRID.shape[0]))
        columns = axis(column_hz[[[0, 0], [0, 1], [1, 1]]], ramps)
        return ToneProgram(rows, columns, duration_s, np.array([1, 2, 3], np.int8), np.zeros(3, np.int32))


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


def losses(point: Point | Empty) -> tuple[int, int, int]:
    """Atoms lost by the tables, by the integrated motion, and their number."""
    rf = RfSpec(full_scale_v=FULL_SCALE_V, max_peak_v=FULL_SCALE_V)
    motion = replace(MotionSpec(rf=rf), speed_m_s=point.speed)
    settings = SimulationSettings(transport_loss=0.0, depth_disorder=0.0)
    light = MobileLightSettings(depth=point.depth_k)
    if isinstance(point, Empty):
        settings = settings.model_copy(update={"temperature": point.temperature_k})
        sources = goals = point.passed
        program, repeats = point.program(), N_REPEATS * (5 if point.lands else 1)
    else:
        motion = replace(motion, pick_up_s=point.ramp_s, drop_off_s=point.ramp_s)
        light = light.model_copy(update={"offset": (0.0, point.away_m)})
        sources, goals = ([(ROW, column + way) for column in COLUMNS] for way in (0, WAY))
        program, repeats = tone_program(Plan.from_batches([(sources, goals)]), GRID, motion), N_REPEATS
    settings = settings.model_copy(update={"mobile_light": light})
    fast, slow = Transport(GRID, motion, settings), RfTransport(GRID, motion, settings)
    (pulse,) = PulseReceiver(Played(program), 60e-6).receive_until(100.0)
    depth, rng = np.ones(GRID.shape), np.random.default_rng(7)
    kept = [0, 0]
    for _ in range(repeats):
        occupied = np.zeros((2, *GRID.shape), np.bool_)
        occupied[(slice(None), *np.transpose(sources))] = True
        fast_atoms, slow_atoms = (Atoms(one, settings.temperature) for one in occupied)
        fast.carry(fast_atoms, program, program.n_segments, depth, rng, 1.0)
        slow.carry(slow_atoms, pulse, depth, rng, 1.0)
        kept = [n + int(one[tuple(np.transpose(goals))].sum()) for n, one in zip(kept, occupied, strict=True)]
    n = repeats * len(sources)
    return n - kept[0], n - kept[1], n


def error(lost: int, n: int) -> float:
    """Standard error of a fraction, never 0."""
    part = (lost + 0.5) / (n + 1)
    return math.sqrt(part * (1 - part) / n)


def draw(found: dict[Point | Empty, tuple[int, int, int]]) -> None:
    """Draw one against the other."""
    figure, axes = plt.subplots(figsize=(4.6, 4.4), layout="constrained")
    groups = {f"{each * 1e6:.1f} um beside the site": each for each in AWAY_M} | {"passes, landings": None}
    for label, away_m in groups.items():
        mine = [one for point, one in found.items() if getattr(point, "away_m", None) == away_m]
        x, y = (np.array([one[k] / one[2] for one in mine]) for k in (1, 0))
        bars = [[error(one[k], one[2]) for one in mine] for k in (1, 0)]
        axes.errorbar(x, y, bars[1], bars[0], "o", ms=4, label=label)
    axes.plot([0, 1], [0, 1], color="0.6", lw=1)
    axes.set(xlabel="loss, integrated motion (bench_awg)", ylabel="loss, tables (virtual)")
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(FOLDER / "responses.png", dpi=120)


def write(
    name: str,
    header: list[str],
    scales: tuple[float, ...],
    found: list[tuple[Point | Empty, tuple[int, int, int]]],
) -> None:
    """Write a table, and print it with the differences."""
    lines = [[*header, "virtual", "error", "bench_awg", "error"]]
    for point, (fast, slow, n) in found:
        numbers = fast / n, error(fast, n), slow / n, error(slow, n)
        scaled = [f"{each * scale:g}" for each, scale in zip(point, scales, strict=True)]
        lines.append([*scaled, *(f"{each:.3f}" for each in numbers)])
    with (FOLDER / name).open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)
    for line in lines:
        sys.stdout.write("| " + " | ".join(line) + " |\n")
    far = np.array([(fast - slow) / n for _, (fast, slow, n) in found])
    rms, greatest = np.sqrt(np.mean(far**2)), np.abs(far).max()
    sys.stdout.write(f"{len(far)} points: r.m.s. difference {rms:.3f}, greatest {greatest:.3f}\n")


def main() -> None:
    """Compute, write and draw all points."""
    moves = [Point(*each) for each in product(SPEEDS, RAMPS_S, DEPTHS_K, AWAY_M)]
    empty = [Empty(True, *each) for each in product(SPEEDS[:2], LANDING_DEPTHS_K, TEMPERATURES_K)]
    empty += [Empty(False, *each) for each in product(SPEEDS[:1], PASSING_DEPTHS_K, TEMPERATURES_K)]
    points = [*moves, *empty]
    with ProcessPoolExecutor(2) as pool:
        found = list(zip(points, pool.map(losses, points), strict=True))
    FOLDER.mkdir(exist_ok=True)
    header = ["speed_um_per_ms", "ramp_us", "depth_mK", "away_um"]
    write("responses.csv", header, (1e3, 1e6, 1e3, 1e6), found[: len(moves)])
    header = ["lands", "speed_um_per_ms", "depth_mK", "temperature_uK"]
    write("empty_tweezers.csv", header, (1, 1e3, 1e3, 1e6), found[len(moves) :])
    draw(dict(found))


if __name__ == "__main__":
    main()
