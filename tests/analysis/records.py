"""Shots that are known in every detail, on a grid of 4 x 5 sites."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from labseq.data.reader import Run
from labseq.model import (
    CycleRecord,
    Frame,
    ImageRecord,
    Plan,
    PlanReport,
    RunRecord,
    ShotRecord,
    StageTiming,
    TargetPattern,
)

ROOT = Path(__file__).parents[2]
SHAPE = (4, 5)
START = "2026-11-20T10:00:00+00:00"

Write = Callable[..., Run]


def target() -> TargetPattern:
    fill = np.zeros(SHAPE, np.bool_)
    fill[1:3, 1:4] = True
    return TargetPattern(fill, np.zeros(SHAPE, np.bool_), "compact 2 x 3")


def make_run(n_shots: int, **changes: Any) -> RunRecord:
    run = RunRecord(
        name="made up",
        n_shots=n_shots,
        seed=7,
        simulated=True,
        t_start_utc=START,
        target=target(),
        sequence_text="",
        profile_text="",
        sequence_path="",
        profile_path="",
        resolved={"shot": [{"load": {}}, {"image": {}}, {"rearrange": {}}, {"image": {}}]},
        overrides={},
        devices={},
        plugins=(),
        provenance={},
        record_frames="all",
        grid_spacing_m=4e-6,
        lattice="triangular",
    )
    return dataclasses.replace(run, **changes)


def image(
    atoms: np.ndarray[Any, Any], step: int, cycle: int, at_s: float, *, kept: bool = False
) -> ImageRecord:
    frame = Frame(np.arange(600, dtype=np.uint16).reshape(20, 30), 0.045, at_s, "camera") if kept else None
    name = "image" if cycle < 0 else f"rearrange_cycle_{cycle}"
    return ImageRecord(frame, atoms, np.ones(SHAPE, np.float32), step, cycle, at_s, 0.045, name)


def make_shot(
    index: int,
    *,
    n_defects: int = 0,
    n_cycles: int = 1,
    judged: bool = True,
    kept: bool = False,
    **changes: Any,
) -> ShotRecord:
    """A shot whose cycles bring the atom of (0, 1) to (1, 1); its last image has so many defects."""
    before = target().fill.copy()
    before[1, 1], before[0, 1] = False, True
    after = target().fill.copy()
    after[tuple(np.argwhere(after)[-n_defects:].T)] = n_defects == 0
    timing = [StageTiming("step_0_load", 0, -1, 0.0, 0.5, 0.001, 0.5)]
    images = [image(before, 1, -1, 0.5, kept=kept)]
    cycles: list[CycleRecord] = []
    for cycle in range(n_cycles):
        plan = Plan.from_batches([([(0, 1)], [(1, 1)])]) if cycle == 0 else Plan.from_batches([])
        n = plan.n_batches
        report = PlanReport(target().fill, np.full(n, 0.001), np.ones(n, np.int32), 0, 0)
        cycles.append(CycleRecord(2, cycle, plan, report, n, 0.06, 0.55, 0.001))
        timing.append(StageTiming("plan", 2, cycle, 0.55, 0.0, 0.002))
        timing.append(StageTiming("move", 2, cycle, 0.55, 0.02 * (cycle + 1), 0.003, 0.03))
        images.append(image(after, 2, cycle, 0.7 + 0.1 * cycle))
    timing.append(StageTiming("step_2_rearrange", 2, -1, 0.55, 0.5, 0.01, 0.6))
    if judged:
        images.append(image(after, 3, -1, 1.8))
    shot = ShotRecord(index, 0, 7, START, "2026-11-20T10:00:01+00:00", "complete")
    shot.images, shot.cycles, shot.timing = images, cycles, timing
    shot.success = judged and not n_defects
    shot.filling_fraction = 1 - n_defects / 6 if judged else math.nan
    return dataclasses.replace(shot, **changes)
