"""Sequences whose runs are interrupted and resumed, and what must hold of them."""

import hashlib
import json

import numpy as np

import labseq

N_SHOTS = 8
SEQUENCE = """
labseq: 1
name: scanned run
profile: PROFILE
seed: 7
target: {pattern: compact, rows: 6, cols: 6}
planner: {use: PLANNER}
SHOTS
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 2, window: 60 ms, exposure: 45 ms}
  - image: {exposure: 45 ms}
"""
SHOTS = {
    "run": f"shots: {N_SHOTS}",
    "scan": """scan:
  planner.degree_of_parallelism: [2, 6]
  profile.mobile_tweezers.speed: [100 um/ms, 130 um/ms]
repeats: 2
order: shuffled""",
    "climb": """scan:
  use: climb
  over:
    planner.degree_of_parallelism: {from: 2, to: 9}
    profile.mobile_tweezers.pick_up: {from: 20 us, to: 400 us}
  maximise: filling_fraction
  points: 4
repeats: 2""",
}
NAMES = ("shot", "status", "success", "filling_fraction", "n_batches", "n_atom_moves", "parameters")


def sequence_of(shots, *, profile, planner="psca"):
    """The text of a sequence: "run", "scan" or "climb"."""
    text = SEQUENCE.replace("SHOTS", SHOTS[shots])
    return text.replace("PROFILE", profile).replace("PLANNER", planner)


def table(run, names=NAMES):
    """What the shots of a run contain, apart from times."""
    return [
        (
            [getattr(shot.row, name) for name in names],
            shot.occupancies.tobytes(),
            [plan.moves.tobytes() for plan in shot.plans],
        )
        for shot in run.shots
    ]


def check_committed(run_dir, *, may_be_torn=False):
    """Every shot in the index of a run that was interrupted is there once, opens and reads back whole.

    Lines before the last may be torn only if the run was resumed after a line was left unfinished.
    """
    index_file = run_dir / "index.jsonl"
    lines = index_file.read_bytes().split(b"\n")[:-1] if index_file.exists() else []  # a torn line has no end
    run = labseq.open_run(run_dir)
    rows = [row for row in map(_parsed if may_be_torn else json.loads, lines) if row.get("counts")]
    assert len({row["shot"] for row in rows}) == len(rows) == len(run.shots), f"{run_dir}: {rows}"
    for row, shot in zip(sorted(rows, key=lambda row: row["shot"]), run.shots, strict=True):
        assert hashlib.sha256((run_dir / row["file"]).read_bytes()).hexdigest() == row["sha256"], shot
        assert shot.frames.shape[0] == len(shot.occupancies) == row["n_images"], shot
        assert shot.frames.dtype == np.uint16, shot
        assert [plan.n_batches for plan in shot.plans] == [c.plan.n_batches for c in shot.cycles], shot


def _parsed(line):
    """A line of the index; empty for one that was left unfinished."""
    try:
        return json.loads(line)
    except ValueError:
        return {}
