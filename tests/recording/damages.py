"""Damages to plant in a run, and what can be seen of it from outside."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from labseq.recording.doctor import Report
from labseq.recording.writer import RunWriter

from .records import make_run, make_shot

N_SHOTS = 4


def write_whole_run(root: Path) -> Path:
    """Write a finished run: four shots, and an attempt that failed."""
    writer = RunWriter.create(root, make_run(name="größer µ", n_shots=N_SHOTS))
    for index in range(N_SHOTS):
        if index == 2:
            writer.write_shot(make_shot(index, status="failed", error="no light"))
        writer.write_shot(make_shot(index, attempt=int(index == 2)))
    writer.event("done")
    writer.finish("complete")
    return writer.run_dir


def copied(template: Path, root: Path) -> Path:
    folder = root / template.parent.name / template.name
    shutil.copytree(template, folder)
    return folder


def contents(root: Path) -> list[bytes]:
    """What is in all files, but for what the doctor itself writes."""
    left_out = ("doctor.jsonl", "index.jsonl", "events.jsonl", "skipped.jsonl", "STATE", ".lock")
    return sorted(p.read_bytes() for p in root.rglob("*") if p.is_file() and p.name not in left_out)


def lines_of(root: Path) -> list[bytes]:
    """All lines of all indices and logs, those in quarantine among them."""
    names = ("index.jsonl", "events.jsonl", "skipped.jsonl")
    found = [line for p in root.rglob("*.jsonl") if p.name in names for line in p.read_bytes().split(b"\n")]
    return sorted(line for line in found if line)


def reported(report: Report) -> list[tuple[str, str]]:
    return [(one.what, one.where.name) for one in report.findings]


def rewrite_state(run_dir: Path, **changes: Any) -> None:
    path = run_dir / "STATE"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


# Each plants a damage.


def flipped_bit(run_dir: Path) -> None:
    path = run_dir / "shots" / "shot_000001.h5"
    with h5py.File(path) as file:
        dataset: Any = file["entry/camera/camera/frames"]
        offset = dataset.id.get_chunk_info(0).byte_offset
    data = bytearray(path.read_bytes())
    data[offset] ^= 1
    path.write_bytes(data)


def truncated_file(run_dir: Path) -> None:
    path = run_dir / "shots" / "shot_000001.h5"
    path.write_bytes(path.read_bytes()[:-100])


def empty_file(run_dir: Path) -> None:
    (run_dir / "shots" / "shot_000001.h5").write_bytes(b"")


def torn_index(run_dir: Path) -> None:
    path = run_dir / "index.jsonl"
    path.write_bytes(path.read_bytes()[:-40])


def unended_line(run_dir: Path) -> None:
    path = run_dir / "index.jsonl"
    path.write_bytes(path.read_bytes()[:-1])


def damaged_line(run_dir: Path) -> None:
    edit_index(run_dir, lambda lines: [lines[0], b"\0\xff" + lines[1][2:], *lines[2:]])


def line_of_no_shot(run_dir: Path) -> None:
    odd = json.dumps({"shot": 1, "file": "../../etc/passwd"}).encode()
    edit_index(run_dir, lambda lines: [odd, *lines])


def doubled_line(run_dir: Path) -> None:
    edit_index(run_dir, lambda lines: [*lines, lines[1]])


def two_lines_for_a_file(run_dir: Path) -> None:
    def add(lines: list[bytes]) -> list[bytes]:
        return [*lines, json.dumps({**json.loads(lines[1]), "sha256": "0" * 64}).encode()]

    edit_index(run_dir, add)


def lost_line(run_dir: Path) -> None:
    edit_index(run_dir, lambda lines: [lines[0], *lines[2:]])


def lost_index(run_dir: Path) -> None:
    (run_dir / "index.jsonl").unlink()


def lost_file(run_dir: Path) -> None:
    (run_dir / "shots" / "shot_000001.h5").rename(run_dir.parents[1] / "elsewhere.h5")


def part_left(run_dir: Path) -> None:
    (run_dir / "shots" / "shot_000009.h5.part").write_bytes(b"\x89HDF")
    (run_dir / "STATE.part").write_bytes(b"")


def torn_events(run_dir: Path) -> None:
    path = run_dir / "events.jsonl"
    path.write_bytes(b"{}x\n" + path.read_bytes() + b'{"eve')


def foreign_skip(run_dir: Path) -> None:
    (run_dir / "skipped.jsonl").write_bytes(b'{"shots": [4], "why": "no light"}\n{"shots": [true]}\n{"sho')


def no_state(run_dir: Path) -> None:
    (run_dir / "STATE").unlink()


def damaged_state(run_dir: Path) -> None:
    (run_dir / "STATE").write_bytes(b"\0\0")


def dead_run(run_dir: Path) -> None:
    rewrite_state(run_dir, state="running", pid=2**22 + 1, started=0.0)


def stop_left(run_dir: Path) -> None:
    (run_dir / "STOP").touch()


def alien_file(run_dir: Path) -> None:
    (run_dir / "shots" / "shot_000007.h5").write_bytes(b"\x89PNG\r\n")


def alien_hdf5(run_dir: Path) -> None:
    with h5py.File(run_dir / "shots" / "shot_000007.h5", "w") as file:
        file["x"] = np.zeros(3)


def shot_of_another_run(run_dir: Path) -> None:
    path = run_dir / "shots" / "shot_000001.h5"
    lost_line(run_dir)
    with h5py.File(path, "r+") as file:
        file["entry/run"].attrs["run_id"] = np.bytes_(b"2020-01-01/0001_other")


def misnamed_shot(run_dir: Path) -> None:
    lost_line(run_dir)
    (run_dir / "shots" / "shot_000001.h5").rename(run_dir / "shots" / "shot_000011.h5")


def edit_index(run_dir: Path, change: Callable[[list[bytes]], list[bytes]]) -> None:
    path = run_dir / "index.jsonl"
    lines = change(path.read_bytes().split(b"\n")[:-1])
    path.write_bytes(b"".join(line + b"\n" for line in lines))


REPAIRABLE = [
    torn_index, unended_line, doubled_line, two_lines_for_a_file, lost_line, lost_index, part_left,
    torn_events, no_state, damaged_state, dead_run, damaged_line, line_of_no_shot, stop_left,
    alien_file, alien_hdf5, foreign_skip,
]  # fmt: skip
LOST = [flipped_bit, truncated_file, empty_file, lost_file, shot_of_another_run, misnamed_shot]
