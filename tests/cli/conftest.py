"""The command line in this process, and a run's events without a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from labseq.model import ImageRecord, RunRecord, ShotRecord, StageTiming, TargetPattern
from labseq.recording.index import IndexRow, row_of_record

Event = tuple[str, Mapping[str, Any]]
Call = Callable[..., tuple[int, str, str]]


def make_target(n: int = 20, filled: int = 15) -> TargetPattern:
    fill = np.zeros((n, n), np.bool_)
    start = (n - filled) // 2
    fill[start : start + filled, start : start + filled] = True
    return TargetPattern(fill, np.zeros((n, n), np.bool_), "compact")


def make_run(
    n_shots: int = 20,
    target: TargetPattern | None = None,
    *,
    simulated: bool = True,
    lattice: str = "triangular",
    shear: int = 1,
) -> RunRecord:
    return RunRecord(
        name="compact-225",
        n_shots=n_shots,
        seed=1,
        simulated=simulated,
        t_start_utc="2026-01-02T03:04:05+00:00",
        target=target or make_target(),
        sequence_text="",
        profile_text="",
        sequence_path="sequences/compact_225.yaml",
        profile_path="hardware_profiles/virtual.yaml",
        resolved={"profile": {"grid": {"shear": shear}}},
        overrides={},
        devices={},
        plugins=(),
        provenance={},
        record_frames="all",
        grid_spacing_m=4.49e-6,
        lattice=lattice,
    )


def make_image(occupancy: np.ndarray[Any, np.dtype[np.bool_]], cycle: int = -1) -> ImageRecord:
    confidence = np.ones(occupancy.shape, np.float32)
    return ImageRecord(None, occupancy, confidence, 2, cycle, 0.6, 0.045)


def make_shot(
    index: int = 0,
    *,
    success: bool = True,
    seen: int = 1,
    filling: float = 1.0,
    status: Literal["complete", "interrupted", "failed"] = "complete",
    error: str = "",
    attempt: int = 0,
) -> ShotRecord:
    shot = ShotRecord(index, attempt, 1, "2026-01-02T03:04:05+00:00")
    shot.success, shot.seen_defect_free_cycle, shot.filling_fraction = success, seen, filling
    shot.status, shot.error = status, error
    shot.t_end_utc = "2026-01-02T03:04:07+00:00"
    shot.timing.append(StageTiming("step_0_load", 0, -1, 0.0, 1.9, 0.01))
    return shot


def make_row(index: int = 0, **changes: Any) -> IndexRow:
    """A shot as the index lists it."""
    file = "shots/shot_000000.h5"
    return row_of_record(make_shot(index, **changes), make_target(), file=file, sha256="", n_bytes=0)


@dataclass
class Script:
    """The events of a run of ``n_shots`` with ``n_cycles`` cycles each."""

    run: RunRecord
    n_shots: int = 2
    n_cycles: int = 2

    def __iter__(self) -> Iterator[Event]:
        run_dir = "data/2026-01-02/0001_compact-225"
        yield "compiling", {"about_s": 6.4}
        yield "compiled", {"duration_s": 6.0}
        yield "run_starting", {"record": self.run, "run_dir": run_dir}
        yield "run_started", {"record": self.run, "run_dir": run_dir}
        for shot in range(self.n_shots):
            yield from self.shot(shot)
        for device in ("mobile_tweezers", "camera", "static_tweezers"):
            yield "safe_state", {"device": device, "ok": True, "error": ""}
        yield "run_finished", {"record": self.run, "status": "complete", "error": ""}

    def shot(self, index: int) -> Iterator[Event]:
        target, rng = self.run.target, np.random.default_rng(index)
        yield "shot_started", {"shot": index, "attempt": 0}
        occupancy = rng.random(target.shape) < 0.75
        yield "image", {"image": make_image(occupancy), "filling_fraction": 0.75}
        for cycle in range(self.n_cycles):
            for stage, budget_s in (("plan", math.nan), ("check", math.nan), ("play", 8e-3), ("move", 60e-3)):
                timing = StageTiming(stage, 2, cycle, 0.6, 7.5e-3, 0.8e-3, budget_s)
                yield "stage", {"timing": timing}
            occupancy = target.fill | (occupancy & (rng.random(target.shape) < 0.3))
            occupancy[target.shape[0] // 2, target.shape[1] // 2] = cycle == self.n_cycles - 1
            for stage in ("expose", "detect"):
                yield "stage", {"timing": StageTiming(stage, 2, cycle, 0.6, 45e-3, 1.2e-3)}
            yield "image", {"image": make_image(occupancy, cycle), "filling_fraction": 1.0}
        yield "shot_finished", {"row": make_row(index)}


@pytest.fixture
def fake() -> SimpleNamespace:
    """Makers of records and events: run, target, image, shot, row, script."""
    return SimpleNamespace(
        run=make_run,
        target=make_target,
        image=make_image,
        shot=make_shot,
        row=make_row,
        script=Script,
    )
