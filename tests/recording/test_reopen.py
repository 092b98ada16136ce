"""A run's folder that is written to again by a later process."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from labseq.errors import RecordingError
from labseq.model import RunRecord, ShotRecord
from labseq.recording import RunWriter, open_run

MakeRun = Callable[..., RunRecord]
MakeShot = Callable[..., ShotRecord]
ONCE = {"t_utc": "2026-11-21T08:00:00+00:00", "first_shot": 1, "changes": [], "provenance": {}}


@pytest.fixture
def run_dir(tmp_path: Path, make_run: MakeRun, make_shot: MakeShot) -> Path:
    """A run of which shot 0 is done and shot 1 was interrupted."""
    writer = RunWriter.create(tmp_path, make_run())
    writer.set_devices({"camera": {"model": "first"}})
    writer.write_shot(make_shot(0))
    writer.write_shot(make_shot(1, status="interrupted"))
    writer.finish("stopped", "stopped by Ctrl-C")
    return writer.run_dir


def reopen(run_dir: Path, run: RunRecord, n_written: int = 1) -> RunWriter:
    return RunWriter.reopen(run_dir, replace(run, resumed=(ONCE,)), n_written=n_written)


def test_a_run_goes_on_in_its_folder(run_dir: Path, make_run: MakeRun, make_shot: MakeShot) -> None:
    writer = reopen(run_dir, make_run())
    assert open_run(run_dir).status == "running"
    writer.write_shot(make_shot(1))
    assert writer.n_written == 2
    writer.finish("complete")
    run = open_run(run_dir)
    assert [shot.index for shot in run.shots] == [0, 1]
    assert [(shot.index, shot.status) for shot in run.attempts] == [(1, "interrupted")]
    assert run.status == "complete"
    assert [e["values"]["n_shots"] for e in run.events if e["event"] == "run_finished"] == [1, 2]


def test_run_json_keeps_what_it_said(run_dir: Path, make_run: MakeRun) -> None:
    file = run_dir / "run.json"
    file.write_text(json.dumps({**json.loads(file.read_text(encoding="utf-8")), "of_later": 5}))
    before = open_run(run_dir).record
    reopen(run_dir, make_run(seed=8, plugins=())).set_devices({"camera": {"model": "second"}})
    assert open_run(run_dir).record == {**before, "resumed": [ONCE]}


def test_devices_of_a_run_that_had_not_come_so_far_are_noted(tmp_path: Path, make_run: MakeRun) -> None:
    run_dir = RunWriter.create(tmp_path, make_run(devices={})).run_dir
    reopen(run_dir, make_run(), 0).set_devices({"camera": {"model": "second"}})
    assert open_run(run_dir).record["devices"] == {"camera": {"model": "second"}}


def test_the_shots_know_what_is_true_of_them(run_dir: Path, make_run: MakeRun, make_shot: MakeShot) -> None:
    writer = reopen(run_dir, make_run(provenance={"labseq": "later"}))
    writer.write_shot(make_shot(1))
    first, second = open_run(run_dir).shots
    assert (first.provenance["labseq"], second.provenance["labseq"]) == ("0.1.0", "later")


def test_no_file_is_overwritten(run_dir: Path, make_run: MakeRun, make_shot: MakeShot) -> None:
    before = {path: path.read_bytes() for path in (run_dir / "shots").iterdir()}
    for _ in range(2):
        writer = reopen(run_dir, make_run())
        writer.write_shot(make_shot(1, status="failed"))
        writer.write_shot(make_shot(0))  # its line might have been lost
    names = sorted(path.name for path in (run_dir / "shots").iterdir())
    first, attempt = "shot_000000", "shot_000001.attempt_0"
    assert names == sorted(
        f"{stem}{take}.h5" for stem in (first, attempt) for take in ("", ".take_2", ".take_3")
    )
    assert before.items() <= {path: path.read_bytes() for path in (run_dir / "shots").iterdir()}.items()
    run = open_run(run_dir)
    assert [shot.file.name for shot in run.shots] == [f"{first}.take_3.h5"]
    assert len(run.attempts) == 3
    for shot in (*run.shots, *run.attempts):
        shot.verify()


def test_a_stop_that_was_asked_for_is_over(run_dir: Path, make_run: MakeRun) -> None:
    (run_dir / "STOP").touch()
    writer = reopen(run_dir, make_run())
    assert not (run_dir / "STOP").exists()
    (run_dir / "STOP").touch()
    writer.finish("stopped")
    assert not (run_dir / "STOP").exists()


def test_a_damaged_run_is_left_alone(run_dir: Path, make_run: MakeRun) -> None:
    (run_dir / "run.json").write_text("{")
    state = (run_dir / "STATE").read_bytes()
    with pytest.raises(RecordingError, match="is damaged"):
        reopen(run_dir, make_run())
    assert (run_dir / "STATE").read_bytes() == state
