"""A scan over 3 x 4 points with 2 repeats, written with records that differ from shot to shot."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from labseq.recording.writer import RunWriter

from .records import make_run, make_shot

ADDRESSES = ["planner.degree_of_parallelism", "shot.2.rearrange.window"]
DEGREES = [1, 5, 15]
WINDOWS_S = [0.03, 0.06, 0.09, 0.12]
POINTS = [[degree, window] for degree, window in itertools.product(DEGREES, WINDOWS_S)]
N_REPEATS = 2


def scan(points: Sequence[Sequence[Any]], n_repeats: int = N_REPEATS) -> dict[str, Any]:
    """What run.json says of a scan whose order was shuffled."""
    order = np.random.default_rng(1).permutation(np.tile(np.arange(len(points)), n_repeats))
    return {
        "addresses": ADDRESSES,
        "points": [list(point) for point in points],
        "written": [[str(degree), f"{1e3 * window:g} ms"] for degree, window in points],
        "repeats": n_repeats,
        "order": "shuffled",
        "point_of_shot": [int(point) for point in order],
    }


def write_scan(
    root: Path, *, points: Sequence[Sequence[Any]] = POINTS, n_repeats: int = N_REPEATS, n_missing: int = 0
) -> Path:
    """Write the run; the last shots may be missing."""
    plan = scan(points, n_repeats)
    writer = RunWriter.create(root, make_run(scan=plan, n_shots=len(plan["point_of_shot"])))
    for index, point in list(enumerate(plan["point_of_shot"]))[: len(plan["point_of_shot"]) - n_missing]:
        shot = make_shot(
            index,
            n_images=2 + index % 2,
            success=index % 3 == 0,
            filling_fraction=index / 100,
            parameters=dict(zip(ADDRESSES, plan["points"][point], strict=True)),
            readings={"laser": {"power_w": 0.1 * index}, "simulation.n_defects_true": index},
        )
        writer.write_shot(shot)
    writer.finish("stopped" if n_missing else "complete")
    return writer.run_dir
