"""Makes a small run with whichever labseq is imported; ``test_past_formats.py`` reads those of past versions.

Run it with the new labseq whenever the version of a format grows, and commit what it makes::

    python tests/recording/old_runs.py tests/recording/data
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

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
from labseq.recording import RunWriter, schema as layout

START = "2026-11-20T10:00:00.000000+00:00"
END = "2026-11-20T10:00:01.250000+00:00"
FULL = np.ones((2, 2), np.bool_)
CALIBRATIONS = {"sites": "f102b3cd999c"}
JUMPS = np.array([(0.25, b"phase", 1.0)], [("t_s", "f8"), ("kind", "S5"), ("row", "f4")])

T = TypeVar("T")


def known(kind: type[T], **values: Any) -> T:
    """A record, without the fields that this labseq does not know yet."""
    names = {field.name for field in dataclasses.fields(kind)}  # pyright: ignore[reportArgumentType]
    return kind(**{name: value for name, value in values.items() if name in names})


def a_run() -> RunRecord:
    return known(
        RunRecord,
        name="old µ",
        n_shots=2,
        seed=7,
        simulated=True,
        t_start_utc=START,
        target=TargetPattern(
            np.array([[1, 1], [0, 0]], np.bool_), np.array([[0, 0], [0, 1]], np.bool_), "row"
        ),
        sequence_text="labseq: 1\nname: old µ\n",
        profile_text="labseq: 1\n",
        sequence_path="old.yaml",
        profile_path="profile.yaml",
        resolved={"planner": {"degree_of_parallelism": 2}},
        overrides={},
        devices={"camera": {"model": "EMCCD"}},
        plugins=({"name": "labseq_psca", "version": "0.1.0"},),
        provenance={"labseq": "0.1.0", "packages": {"numpy": "2"}},
        record_frames="all",
        grid_spacing_m=4.49e-6,
        lattice="square",
        scan={
            "addresses": ["shot.1.rearrange.window"],
            "points": [[0.06], [0.09]],
            "written": [["60 ms"], ["90 ms"]],
            "repeats": 1,
            "order": "sorted",
            "point_of_shot": [0, 1],
        },
        calibrations=CALIBRATIONS,
    )


def a_shot(index: int) -> ShotRecord:
    before = np.array([[1, 0], [1, 0]], np.bool_)
    after = np.array([[1, 1], [0, 0]], np.bool_)
    plan = Plan(np.array([[1, 0, 0, 1]], np.int16), np.array([0, 1], np.int32))
    report = PlanReport(after, np.array([0.004]), np.array([1], np.int32), 0, 0)
    return known(
        ShotRecord,
        shot_index=index,
        attempt=0,
        seed=7,
        t_start_utc=START,
        t_end_utc=END,
        status="complete",
        images=[an_image(0, before, 0), an_image(1, after, 1), an_image(2, after, 0)],
        cycles=[CycleRecord(1, 1, plan, report, 1, (0.06, 0.09)[index], 0.1, 0.004)],
        timing=[
            StageTiming("plan", 1, 1, 0.1, 0.002, 0.002, 0.01),
            StageTiming("step 1 rearrange", 1, 0, 0.1, 0.15, 0.01),
        ],
        seen_defect_free_cycle=1,
        success=True,
        filling_fraction=1.0,
        n_missing_atoms=0,
        readings={"laser.power_w": 0.125, "simulation.n_defects_true": 0},
        parameters={"shot.1.rearrange.window": (0.06, 0.09)[index]},
        calibrations=CALIBRATIONS,
        atom_events={"jumps": JUMPS},
    )


def an_image(number: int, occupancy: np.ndarray[Any, np.dtype[np.bool_]], cycle: int) -> ImageRecord:
    pixels = np.arange(12, dtype=np.uint16).reshape(3, 4) + 100 * number
    frame = known(
        Frame,
        image=pixels,
        exposure_s=0.045,
        t_start_s=5.0 + number,
        camera="EMCCD",
        number=number,
        device_time_s=1.5,
    )
    return ImageRecord(frame, occupancy, FULL.astype(np.float32), number, cycle, 0.1 * number, 0.045)


def make(folder: Path) -> Path:
    """Write a run, and bring it to ``<folder>/shot_<format version>``."""
    with tempfile.TemporaryDirectory() as root:
        writer = RunWriter.create(Path(root), a_run())
        for index in range(2):
            writer.write_shot(a_shot(index))
        writer.finish("complete")
        state = {"state": "complete", "pid": 1, "started": 0.0, "host": "lab", "error": ""}  # nobody's process
        (writer.run_dir / "STATE").write_text(json.dumps(state) + "\n", "utf-8")
        made = folder / f"shot_{layout.FORMAT_VERSION}"
        shutil.rmtree(made, ignore_errors=True)
        shutil.move(writer.run_dir, made)
    return made


if __name__ == "__main__":
    print(make(Path(sys.argv[1])))
