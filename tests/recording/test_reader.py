"""A run read back, finished, damaged or in progress."""

from __future__ import annotations

import json
import math
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from labseq.data.reader import open_run
from labseq.errors import RecordingError
from labseq.recording.writer import RunWriter

from .records import make_run, make_shot, write


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A finished run of three shots, one of them a success."""
    writer = RunWriter.create(tmp_path, make_run())
    for index, (success, filling) in enumerate([(True, 1.0), (False, 0.5), (False, math.nan)]):
        writer.write_shot(make_shot(index, success=success, filling_fraction=filling))
    writer.finish("complete")
    return writer.run_dir


def rewrite_json(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text("utf-8")), **changes}), "utf-8")


def test_a_run_tells_what_it_was(run_dir: Path) -> None:
    run = open_run(str(run_dir / "run.json"))
    assert run.path == run_dir
    assert (run.name, run.n_shots, run.seed, run.simulated) == ("compact-225", 20, 7, True)
    assert run.target.n_atoms == 6
    assert run.defect_free == 0.5  # of the two that were judged
    assert run.filling_fraction == 0.75
    assert run.status == "complete"
    assert run.changes == {"planner.degree_of_parallelism": "7"}
    assert run.summary() == {
        "run_dir": str(run_dir),
        "shots": 3,
        "skipped": 0,
        "defect_free": 0.5,
        "filling_fraction": 0.75,
        "status": "complete",
    }
    assert "3 of 20 shots, complete" in repr(run)
    shot = run.shots[1]
    assert (shot.index, shot.attempt, shot.status, shot.success) == (1, 0, "complete", False)
    assert (shot.filling_fraction, shot.seen_defect_free_cycle) == (0.5, 1)
    assert math.isnan(run.shots[2].filling_fraction)
    assert "Shot 1" in repr(shot)


def test_the_index_is_enough_to_open_a_run(run_dir: Path) -> None:
    for path in (run_dir / "shots").iterdir():
        path.unlink()
    row = json.loads((run_dir / "index.jsonl").read_text("utf-8").splitlines()[0])
    lines = [json.dumps({**row, "shot": i, "file": f"shots/shot_{i:06d}.h5"}) for i in reversed(range(1_000))]
    (run_dir / "index.jsonl").write_text("\n".join(lines) + "\n")
    run = open_run(run_dir)
    assert [shot.index for shot in run.shots] == list(range(1_000))
    assert run.defect_free == 1.0
    with pytest.raises(RecordingError, match=r"shot_000017.h5: is missing; restore"):
        _ = run.shots[17].plans
    with pytest.raises(RecordingError, match=r"shot_000017.h5: is missing"):
        _ = run.shots[17].frames
    with pytest.raises(RecordingError, match=r"shot_000017.h5: cannot be read"):
        run.shots[17].verify()


def test_what_a_kill_left_is_ignored(run_dir: Path) -> None:
    index = run_dir / "index.jsonl"
    index.write_bytes(index.read_bytes() + b'{"shot": 3, "counts": true, "fi')
    (run_dir / "shots" / "shot_000003.h5.part").write_bytes(b"\x89HDF")
    (run_dir / "events.jsonl").write_bytes(b'{"event": "a"}\n{"ev')
    run = open_run(run_dir)
    assert len(run.shots) == 3
    assert run.n_damaged_lines == 0
    assert run.events == ({"event": "a"},)


def test_damaged_lines_are_counted_and_do_not_hide_the_others(run_dir: Path) -> None:
    index = run_dir / "index.jsonl"
    lines = index.read_bytes().splitlines()
    odd = json.dumps({**json.loads(lines[0]), "shot": "x"}).encode()
    index.write_bytes(b"\n".join([lines[0], b"\0\0", b"{}", odd, lines[2], b""]))
    run = open_run(run_dir)
    assert [shot.index for shot in run.shots] == [0, 2]
    assert run.n_damaged_lines == 3


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("attempt", []),
        ("counts", "x"),
        ("success", {}),
        ("filling_fraction", "x"),
        ("seen_defect_free_cycle", "x"),
    ],
)
def test_a_line_with_a_value_of_the_wrong_kind_is_damaged(run_dir: Path, name: str, value: Any) -> None:
    index = run_dir / "index.jsonl"
    lines = index.read_text("utf-8").splitlines()
    odd = json.dumps({**json.loads(lines[0]), name: value})
    index.write_text("\n".join([odd, *lines[1:], ""]), "utf-8")
    run = open_run(run_dir)
    assert [shot.index for shot in run.shots] == [1, 2]
    assert run.n_damaged_lines == 1


def test_a_shot_written_again_counts_once(tmp_path: Path) -> None:
    (shot,) = write(tmp_path, make_shot(0, success=False), make_shot(0, success=True)).shots
    assert shot.success
    shot.verify()


def test_a_run_on_another_computer_is_taken_to_be_running(run_dir: Path) -> None:
    rewrite_json(run_dir / "STATE", state="running", started=1.0, host="another")
    assert open_run(run_dir).status == "running"


def test_a_run_whose_process_is_gone_has_failed(run_dir: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        rewrite_json(run_dir / "STATE", state="running", pid=child.pid, started=0.0)
        assert open_run(run_dir).status == "running"
    run = open_run(run_dir)
    assert (run.status, run.error) == ("failed", "the process that ran it is gone")
    assert len(run.shots) == 3


@pytest.mark.parametrize("content", [b"", b'{"state": {}}', None])
def test_a_run_without_a_state_has_failed(run_dir: Path, content: bytes | None) -> None:
    (run_dir / "STATE").unlink()
    if content is not None:
        (run_dir / "STATE").write_bytes(content)
    run = open_run(run_dir)
    assert (run.status, run.error) == ("failed", "STATE is missing or damaged")


@pytest.mark.parametrize("content", [b"[]", b"\xff", b'{"format": "other"}'])
def test_a_damaged_run_file_is_explained(run_dir: Path, content: bytes) -> None:
    (run_dir / "run.json").write_bytes(content)
    with pytest.raises(RecordingError, match=r"run.json: is damaged.*restore"):
        open_run(run_dir)


def test_a_run_file_that_lacks_something_is_explained(run_dir: Path) -> None:
    record = json.loads((run_dir / "run.json").read_text("utf-8"))
    del record["seed"]
    for damaged in (record, {**record, "seed": "x"}, {**record, "seed": None}):
        (run_dir / "run.json").write_text(json.dumps(damaged), "utf-8")
        with pytest.raises(RecordingError, match=r"run.json: is damaged: it has no valid 'seed'"):
            open_run(run_dir)


def test_a_damaged_target_is_explained(run_dir: Path) -> None:
    rewrite_json(run_dir / "run.json", target={"fill": ["01", "0"], "clear": [], "name": ""})
    with pytest.raises(RecordingError, match="damaged target"):
        _ = open_run(run_dir).target


def test_a_run_of_a_newer_labseq_is_refused(run_dir: Path) -> None:
    rewrite_json(run_dir / "run.json", format_version="4.9")  # a newer minor version only adds things
    open_run(run_dir)
    rewrite_json(run_dir / "run.json", format_version="5.0")
    with pytest.raises(RecordingError, match=r"version 5\.0, .* 4\.0; update labseq"):
        open_run(run_dir)
    rewrite_json(run_dir / "run.json", format_version="1.3")
    with pytest.raises(RecordingError, match=r"format version 1\.3, .* 4\.0; use labseq 0\.1\.0 to read it"):
        open_run(run_dir)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"format_version": "5.0"}, r"has format version 5\.0, this labseq reads 4\.2; update labseq"),
        ({"format_version": "x"}, "has the format version 'x'; expected a version like 4.2"),
        ({"format": "nexus"}, "is not a shot's file of labseq"),
    ],
)
def test_other_shot_files_are_refused(run_dir: Path, attributes: dict[str, str], message: str) -> None:
    shot = open_run(run_dir).shots[0]
    with h5py.File(shot.file, "r+") as file:
        file.attrs.update({name: np.bytes_(text.encode()) for name, text in attributes.items()})
    with pytest.raises(RecordingError, match=message):
        _ = shot.plans
    with pytest.raises(RecordingError, match="has changed since it was written"):
        shot.verify()


@pytest.mark.parametrize("part", [0.0, 0.3])
def test_a_damaged_shot_file_is_explained(run_dir: Path, part: float) -> None:
    shot = open_run(run_dir).shots[0]
    data = shot.file.read_bytes()
    shot.file.write_bytes(data[: int(part * len(data))])
    with pytest.raises(RecordingError, match=r"shot_000000.h5: is damaged: .*; restore"):
        _ = shot.occupancies
    with pytest.raises(RecordingError, match="is damaged"):
        _ = shot.frames


def test_several_values_of_a_shot_read_its_file_once(run_dir: Path) -> None:
    shot = open_run(run_dir).shots[0]
    assert len(shot.plans) == 3
    shot.file.unlink()
    assert len(shot.timing) == 4


@pytest.mark.parametrize("path", [None, b"data"])
def test_what_is_no_path_is_no_run(path: Any) -> None:
    with pytest.raises(RecordingError, match="is not a path; give a run's folder, name or number"):
        open_run(path)


def test_only_shots_of_the_run_are_skipped(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path, make_run(n_shots=3))
    writer.skip([2], "no light")
    with (writer.run_dir / "skipped.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"shots": [0, 3], "why": ""}\n{"shots": [true], "why": ""}\n{"shots": 1}\n{"sho')
    assert open_run(writer.run_dir).skipped == {2: "no light"}


def test_another_process_can_be_given_a_run_and_its_shots(run_dir: Path) -> None:
    run = pickle.loads(pickle.dumps(open_run(run_dir).select("shot < 2")))
    assert [shot.index for shot in run.shots] == [0, 1]
    assert run.shots[1].images[0] is run.shots[1].images[0]  # the file is read once, as before
