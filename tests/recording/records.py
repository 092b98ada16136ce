"""Records to write, and a comparison that knows arrays and nan."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from labseq.data.reader import Run, open_run
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
from labseq.model.records import LineEdge
from labseq.recording.writer import RunWriter

START = "2026-11-20T10:00:00.000000+00:00"
SHAPE = (4, 5)


def make_run(**changes: Any) -> RunRecord:
    fill = np.zeros(SHAPE, np.bool_)
    fill[1:3, 1:4] = True
    clear = np.zeros(SHAPE, np.bool_)
    clear[0] = True
    run = RunRecord(
        name="compact-225",
        n_shots=20,
        seed=7,
        simulated=True,
        t_start_utc=START,
        target=TargetPattern(fill, clear, "compact µ"),
        sequence_text="labseq: 1\r\nname: compact-225  # größer\n",
        profile_text="labseq: 1\n",
        sequence_path="sequences/compact_225.yaml",
        profile_path="hardware_profiles/virtual.yaml",
        resolved={"planner": {"use": "psca", "degree_of_parallelism": 7}},
        overrides={"planner.degree_of_parallelism": {"value": 7, "unit": "", "written": "7"}},
        units={"shot.2.rearrange.window": "s"},
        devices={"camera": {"model": "EMCCD"}, "laser/780 nm": {"power_w": np.float64(0.1)}},
        plugins=({"name": "labseq_psca", "version": "0.1.0", "origin": "entry point"},),
        provenance={
            "labseq": "0.1.0",
            "git_commit": "a" * 40,
            "git_dirty": True,
            "packages": {"numpy": "2"},
            "none": None,
        },
        record_frames="all",
        grid_spacing_m=4.49e-6,
        lattice="triangular",
        steps=("load", "step_1_image", "rearrange", "step_3_image"),
    )
    return dataclasses.replace(run, **changes)


def _plan(n_moves_per_batch: tuple[int, ...], rng: np.random.Generator) -> Plan:
    offsets = np.cumsum([0, *n_moves_per_batch])
    moves = rng.integers(-1, 6, (int(offsets[-1]), 4)).astype(np.int16)
    linked = rng.random(len(n_moves_per_batch)) < 0.5
    if len(linked) < 3:
        return Plan(moves, offsets, linked)
    shapes = np.array([(0, 0, 0), (3, 2, 1), (0, 0, 0)], np.int32)  # rows and columns move at once
    return Plan(moves, offsets, linked, shapes, rng.random(9), np.array([1, 2, 2], np.int32))


def _cycle(number: int, n_moves_per_batch: tuple[int, ...], rng: np.random.Generator) -> CycleRecord:
    n = len(n_moves_per_batch)
    report = PlanReport(
        predicted=rng.random(SHAPE) < 0.5,
        batch_end_s=rng.random(n).cumsum(),
        n_tweezers=rng.integers(0, 20, n).astype(np.int32),
        n_defects=1,
        n_surplus=2,
    )
    plan = _plan(n_moves_per_batch, rng)
    return CycleRecord(2, number, plan, report, max(0, n - 1), 0.06, 1.5 + number, 0.0123)


def _image(number: int, cycle: int, rng: np.random.Generator, frame_shape: tuple[int, int]) -> ImageRecord:
    pixels = rng.integers(0, 65536, frame_shape).astype(np.uint16)
    return ImageRecord(
        frame=Frame(pixels, 0.045, 100.0 + number, "camera"),
        occupancy=rng.random(SHAPE) < 0.5,
        confidence=rng.random(SHAPE, dtype=np.float32),
        step=1 + number,
        cycle=cycle,
        t_start_s=0.1 * number,
        exposure_s=0.0451,
        name=f"image_{number}",
        signal=rng.normal(1000.0, 500.0, SHAPE),
    )


def make_shot(
    index: int = 0,
    *,
    n_images: int = 3,
    batches: tuple[tuple[int, ...], ...] = ((2, 1, 3), (), (1,)),
    frame_shape: tuple[int, int] = (6, 8),
    **changes: Any,
) -> ShotRecord:
    rng = np.random.default_rng(index)
    shot = ShotRecord(
        shot_index=index,
        attempt=0,
        seed=7,
        t_start_utc=START,
        t_end_utc="2026-11-20T10:00:01.250000+00:00",
        status="complete",
        images=[_image(i, i - 1, rng, frame_shape) for i in range(n_images)],
        cycles=[_cycle(i, sizes, rng) for i, sizes in enumerate(batches)],
        timing=[
            StageTiming("load", 0, -1, 0.0, 0.5, 0.001),
            StageTiming("plan", 2, 0, 0.5, 0.003, 0.003, 0.001),
            StageTiming("plan", 2, 1, 0.6, 0.001, 0.003, 0.001),
            StageTiming("prüfen", 2, 0, 0.5, 1e-9, 0.0, 0.01),
        ],
        edges=[LineEdge(2, "microwave", True, 0.0, 0.5), LineEdge(2, "prüfen", False, 12.5e-6, 0.5)],
        seen_defect_free_cycle=1,
        success=True,
        filling_fraction=0.875,
        n_missing_atoms=3,
        readings={"laser": {"power_w": 0.1, "locked": True}},
        parameters={"shot.2.rearrange.window": 0.06, "ümlaut": [1, None]},
        calibrations={"sites": "f102b3cd999c", "overlay": "a18d1601661e"},
        thresholds=rng.random(SHAPE),
        sites_px=rng.random((*SHAPE, 2)),
        signal_unit="counts",
    )
    return dataclasses.replace(shot, **changes)


def assert_same(a: Any, b: Any, where: str = "") -> None:
    assert type(a) is type(b), (where, a, b)
    if dataclasses.is_dataclass(a):
        for item in dataclasses.fields(a):
            assert_same(getattr(a, item.name), getattr(b, item.name), f"{where}.{item.name}")
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, where
        np.testing.assert_array_equal(a, b, where)
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}[{i}]")
    elif isinstance(a, float) and math.isnan(a):
        assert math.isnan(b), where
    else:
        assert a == b, where


def write(root: Path, *shots: ShotRecord, **changes: Any) -> Run:
    """Write shots as a run that has not ended, and open it; keywords change the record of the run."""
    writer = RunWriter.create(root, make_run(**changes))
    for shot in shots:
        writer.write_shot(shot)
    return open_run(writer.run_dir)
