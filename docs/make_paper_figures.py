"""Simulate the paper's figures 4 and 5 with many shots, and write their tables and pictures.

    python docs/make_paper_figures.py --shots-4 20000 --shots-5 10000

The shots are those of ``sequences/figure4_dop_scan.yaml`` and ``figure5_multicycle.yaml``, taken by
labseq's own sequencer; instead of a file for each, their sums are kept. Every point of figure 4 that is
done is appended to its table at once, and skipped when it is there already: a long simulation can be
stopped and goes on.
"""

from __future__ import annotations

import argparse
import csv
import math
import secrets
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from labseq import Session, ShotRecord
from labseq.analysis.paper import (
    PAPERS_DEFECT_FREE,
    PAPERS_FILLING,
    PAPERS_LIFETIME_S,
    CyclesDrawing,
    ParallelismDrawing,
    save_cycles,
    save_parallelism,
    survival,
)
from labseq.analysis.statistics import Rate
from labseq.pictures.figures import Series
from labseq.sequencer import Sequencer
from labseq.sequencer.policies import RunPolicy

DOCS = Path(__file__).parent
SEQUENCES = DOCS.parent / "sequences"
FIGURES = DOCS / "_static" / "paper"

FIGURE_4, FIGURE_5 = "figure4_dop_scan.yaml", "figure5_multicycle.yaml"

WINDOWS_MS = {2: 94, 3: 68}
"""The windows of figure 4 that are longer than the shortest, 60 ms; see the sequence."""
POINTS = [(dop, 200) for dop in range(2, 16)] + [(dop, WINDOWS_MS.get(dop, 60)) for dop in range(2, 16)]
"""Degree of parallelism and window in ms of each point of figure 4."""
UNTUNED = (
    "profile.simulation.transport_loss=2.12 %",
    "profile.simulation.transport_loss_per_tone=0 %",
    "profile.simulation.transport_loss_spread=0",
    "profile.simulation.mobile_light.depth_drop_per_tone=0 %",
    "profile.simulation.mobile_light.adiabatic_depth=0 uK",
    "profile.simulation.imaging_loss=0.314 %",
    "planner.repair_below=0",
)
"""What makes the fitted profile one with nothing fitted but the loss of a moved atom."""


@dataclass
class Tally:
    """A sink for shots: what the figures need of each."""

    defects: list[list[int]] = field(default_factory=list[list[int]])
    n_atom_moves: list[list[int]] = field(default_factory=list[list[int]])
    target: Any = None

    def write_shot(self, shot: ShotRecord) -> None:
        images = [image for image in shot.images if image.cycle]
        self.defects.append([int(self.target.n_defects(image.occupancy)) for image in images])
        played = [cycle.plan.batch_offsets[cycle.n_batches_played] for cycle in shot.cycles]
        self.n_atom_moves.append([int(n) for n in played])
        shot.images.clear()


class Nobody:
    """Watches a run without a word."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        del name, values


def take(sequence: str, n_shots: int, overrides: Sequence[str], seed: int) -> Tally:
    """Take the shots of a sequence, and keep what the figures need."""
    session = Session.open(SEQUENCES / sequence, overrides=overrides, seed=seed)
    lab = session.build_lab()
    session.warm(lab)
    tally = Tally(target=lab.target)
    first = session.scan_run.first
    sequencer = Sequencer(
        lab,
        first.steps,
        session.stop_flag,
        tally,
        Nobody(),
        seed=seed,
        policy=RunPolicy(attempts=1),
        parameters={},
    )
    try:
        sequencer.open()
        sequencer.run(range(n_shots))
    finally:
        sequencer.shut_down()
    return tally


def point(dop: int, window_ms: int, n_shots: int, seed: int) -> dict[str, Any]:
    """One point of figure 4."""
    overrides = [
        f"scan={{planner.degree_of_parallelism: [{dop}]}}",
        f"repeats={n_shots}",
        f"shot.2.rearrange.window={window_ms} ms",
    ]
    filling = 1 - np.array(take(FIGURE_4, n_shots, overrides, seed).defects)[:, 0] / 225
    error = filling.std(ddof=1) / math.sqrt(n_shots)
    return {
        "dop": dop,
        "window_ms": window_ms,
        "shots": n_shots,
        "filling": f"{filling.mean():.6f}",
        "error": f"{error:.6f}",
    }


def rows_of(path: Path) -> list[dict[str, str]]:
    """The rows of a table; none if there is no such file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def append(path: Path, row: Mapping[str, Any]) -> None:
    """Add a row to a table."""
    is_new = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row), lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def simulate_4(n_shots: int, n_processes: int, points: Iterable[tuple[int, int]]) -> None:
    """Take the points of figure 4 that are missing in its table."""
    path = FIGURES / "figure4.csv"
    done = {(int(row["dop"]), int(row["window_ms"])) for row in rows_of(path)}
    with ProcessPoolExecutor(n_processes) as pool:
        left = [key for key in points if key not in done]
        tasks = [pool.submit(point, *key, n_shots, secrets.randbits(63)) for key in left]
        for task in as_completed(tasks):
            append(path, task.result())


def simulate_5(n_shots: int, n_processes: int) -> None:
    """Take the shots of figure 5, fitted and untuned, and write its tables."""
    parts = [n_shots // n_processes] * n_processes
    for name, overrides in (("figure5", ()), ("figure5_untuned", UNTUNED)):
        with ProcessPoolExecutor(n_processes) as pool:
            tasks = [
                pool.submit(take, "figure5_multicycle.yaml", n, overrides, secrets.randbits(63))
                for n in parts
            ]
            tallies = [task.result() for task in tasks]
        defects = np.concatenate([tally.defects for tally in tallies])
        moves = np.concatenate([tally.n_atom_moves for tally in tallies])
        path = FIGURES / f"{name}.csv"
        path.unlink(missing_ok=True)
        for cycle in range(defects.shape[1]):
            counts = np.bincount(np.minimum(defects[:, cycle], 9), minlength=10)
            append(
                path,
                {
                    "cycle": cycle + 1,
                    "shots": len(defects),
                    **{f"defects_{n}": int(counts[n]) for n in range(10)},
                    "filling": f"{1 - defects[:, cycle].mean() / 225:.6f}",
                    "atom_moves": f"{moves[:, cycle].mean():.3f}",
                },
            )


def draw_4(path: Path) -> None:
    rows = rows_of(FIGURES / "figure4.csv")
    by_key = {(int(row["dop"]), int(row["window_ms"])): row for row in rows}
    series: list[Series] = []
    for label, keys in (("window 200 ms", POINTS[:14]), ("windows 60 to 94 ms", POINTS[14:])):
        found = [(dop, by_key[dop, window]) for dop, window in keys if (dop, window) in by_key]
        x = np.array([float(dop) for dop, _ in found])
        y = np.array([float(row["filling"]) for _, row in found])
        error = np.array([float(row["error"]) for _, row in found])
        series.append(Series(label, x, y, y - error, y + error))
    x = np.array([float(dop) for dop, _ in POINTS[14:]])
    left = np.array([survival(window / 1e3, PAPERS_LIFETIME_S) for _, window in POINTS[14:]])
    nan = np.full(len(x), np.nan)
    shots = min(int(row["shots"]) for row in rows)
    drawing = ParallelismDrawing(
        title="figure 4: filling after one cycle",
        note=f"profile paper, {shots} shots for each point",
        fixed=(series[0],),
        optimised=(series[1],),
        survival=Series("survival of the windows 60 to 94 ms (lifetime 33 s)", x, left, nan, nan),
        quoted=quoted(PAPERS_FILLING),
    )
    save_parallelism(path, drawing)


def draw_5(path: Path) -> None:
    series: list[Series] = []
    defects: list[Any] = []
    for name, label in (("figure5", "profile paper"), ("figure5_untuned", "only the loss per atom fitted")):
        rows = rows_of(FIGURES / f"{name}.csv")
        rates = [Rate(int(row["defects_0"]), int(row["shots"])) for row in rows]
        low, high = np.array([rate.interval for rate in rates]).T
        x = np.arange(1.0, len(rates) + 1)
        values = np.array([rate.value for rate in rates])
        series.append(Series(f"{label}, {rows[0]['shots']} shots", x, values, low, high))
        defects.append(np.array([int(rows[-1][f"defects_{n}"]) for n in range(10)]))
    drawing = CyclesDrawing(
        title="figure 5: defect-free probability after n cycles",
        note="15 x 15 atoms, degree of parallelism 7",
        series=tuple(series),
        defects=tuple(defects),
        quoted=quoted(PAPERS_DEFECT_FREE),
    )
    save_cycles(path, drawing)


def quoted(points: Sequence[tuple[int, float, float]]) -> Series:
    """Points that the paper states."""
    x, y, error = (np.array(column, np.float64) for column in zip(*points, strict=True))
    return Series("Tian et al.", x, y, y - error, y + error)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--shots-4", type=int, default=0, help="shots of each point of figure 4; 0: draw only"
    )
    parser.add_argument("--shots-5", type=int, default=0, help="shots of figure 5; 0: draw only")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    FIGURES.mkdir(parents=True, exist_ok=True)
    if given.shots_4:
        simulate_4(given.shots_4, given.processes, POINTS)
    if given.shots_5:
        simulate_5(given.shots_5, given.processes)
    draw_4(FIGURES / "figure4.png")
    draw_5(FIGURES / "figure5.png")


if __name__ == "__main__":
    main()
