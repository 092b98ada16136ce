"""How long a shot takes to reach the disk, and a run to be opened."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from labseq.data.reader import open_run
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
from labseq.recording.writer import RunWriter

START = "2026-11-20T10:00:00.000000+00:00"
GRID = (20, 20)
STAGES = ("plan", "check", "prepare", "play", "expose", "read", "detect")


def a_run() -> RunRecord:
    fill = np.zeros(GRID, np.bool_)
    fill[2:17, 2:17] = True
    return RunRecord(
        name="benchmark",
        n_shots=100,
        seed=1,
        simulated=True,
        t_start_utc=START,
        target=TargetPattern(fill, np.zeros_like(fill)),
        sequence_text="shot: []\n" * 40,
        profile_text="grid: {}\n" * 80,
        sequence_path="sequence.yaml",
        profile_path="profile.yaml",
        resolved={"planner": {"degree_of_parallelism": 7}},
        overrides={},
        devices={name: {"model": name} for name in ("camera", "static_tweezers", "mobile_tweezers")},
        plugins=({"name": "labseq_psca", "version": "0.1.0"},),
        provenance={"git_commit": "a" * 40, "packages": {f"package{i}": "1.0" for i in range(60)}},
        record_frames="all",
        grid_spacing_m=4.49e-6,
        lattice="triangular",
    )


def a_cycle(number: int, n_batches: int) -> CycleRecord:
    plan = Plan(np.zeros((7 * n_batches, 4), np.int16), np.arange(0, 7 * n_batches + 1, 7, dtype=np.int32))
    ends = np.linspace(0.0, 0.06, n_batches)
    report = PlanReport(np.ones(GRID, np.bool_), ends, np.full(n_batches, 7, np.int32), 0, 0)
    return CycleRecord(2, number, plan, report, n_batches, 0.06, 0.1 * number, 0.03)


def a_shot(index: int, frames: np.ndarray[tuple[int, ...], np.dtype[np.uint16]]) -> ShotRecord:
    """Twelve images and ten cycles, as in the paper's main experiment."""
    confidence = np.ones(GRID, np.float32)
    return ShotRecord(
        shot_index=index,
        attempt=0,
        seed=1,
        t_start_utc=START,
        t_end_utc=START,
        status="complete",
        images=[
            ImageRecord(Frame(frame, 0.045, 0.1 * i), confidence > 0, confidence, 1, i, 0.1 * i, 0.045)
            for i, frame in enumerate(frames)
        ],
        cycles=[a_cycle(number, 39 if number == 1 else 11) for number in range(1, 11)],
        timing=[
            StageTiming(stage, 2, c, 0.1 * c, 0.01, 0.01, 0.02) for c in range(1, 11) for stage in STAGES
        ],
    )


def test_write_shot_of_twelve_frames(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    frames = np.random.default_rng(0).poisson(100, (12, 512, 512)).astype(np.uint16)
    writer = RunWriter.create(tmp_path, a_run())
    indices = itertools.count()
    benchmark.pedantic(
        writer.write_shot,
        setup=lambda: ((a_shot(next(indices), frames),), {}),
        rounds=100,
        warmup_rounds=5,
    )
    assert len(open_run(writer.run_dir).shots) == writer.n_written


@pytest.fixture
def long_run(benchmark: BenchmarkFixture, tmp_path: Path) -> tuple[Path, int]:
    """A run whose index names 10,000 shots (100 where nothing is measured), and how many it names."""
    n_shots = 10_000 if benchmark.enabled else 100
    writer = RunWriter.create(tmp_path, a_run())
    writer.write_shot(a_shot(0, np.zeros((12, 8, 8), np.uint16)))
    index = writer.run_dir / "index.jsonl"
    row = json.loads(index.read_text("utf-8"))
    index.write_text("".join(json.dumps({**row, "shot": i}) + "\n" for i in range(n_shots)), "utf-8")
    return writer.run_dir, n_shots


def test_open_a_long_run(benchmark: BenchmarkFixture, long_run: tuple[Path, int]) -> None:
    run_dir, n_shots = long_run
    assert len(benchmark.pedantic(open_run, (run_dir,), rounds=5).shots) == n_shots


def test_table_of_a_long_run(benchmark: BenchmarkFixture, long_run: tuple[Path, int]) -> None:
    run_dir, n_shots = long_run
    table = benchmark.pedantic(open_run(run_dir).to_dataframe, rounds=5, warmup_rounds=1)
    assert len(table) == n_shots
