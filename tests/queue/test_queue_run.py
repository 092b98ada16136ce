"""What is queued is run in order."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.assembly.calibrations import open_store
from labseq.data.reader import open_run
from labseq.errors import ConfigError, RecordingError, StopRequested
from labseq.model import CalibrationEntry, SiteGrid, grid_facts
from labseq.plain import now_utc
from labseq.processes import Process
from labseq.queue.queue import Entry, Queue, Rules
from labseq.queue.running import Opening, QueueRun
from labseq.session.session import Session
from labseq.session.stopping import ask_to_stop

from .queued import PROFILE, SEQUENCE, Taking, add, queue, states

__all__ = ["queue"]


def test_entries_are_run_in_order_and_leave_the_queue(queue: Queue) -> None:
    first, second = add(queue), add(queue, shots=1)
    assert states(queue) == {1: "waiting", 2: "waiting"}
    taking = Taking()
    assert taking.run(queue).first_error is None
    assert taking.begun == [first.id, second.id]
    assert [len(open_run(run).shots) for run in taking.runs] == [3, 1]
    assert queue.entries() == []
    done = queue.done(timedelta(hours=1))
    assert [(entry.id, entry.run_dir) for entry in done] == [(1, taking.runs[0]), (2, taking.runs[1])]
    assert queue.done(timedelta(0)) == []
    assert add(queue).id == 3  # no number comes again


def test_what_is_queued_is_what_will_be_run(queue: Queue) -> None:
    entry = add(queue)
    assert not entry.has_changed
    Path("s.yaml").write_text(SEQUENCE.replace("shots: 3", "shots: 9"), encoding="utf-8")
    assert queue.entries()[0].has_changed
    Path("s.yaml").unlink()
    assert queue.entries()[0].has_changed
    taking = Taking()
    taking.run(queue)
    run = open_run(taking.runs[0])
    assert (run.n_shots, run.record["sequence_text"]) == (3, SEQUENCE)
    assert run.record["sequence_path"] == str(Path("s.yaml").absolute())


def test_options_are_kept(queue: Queue, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    add(
        queue,
        shots=2,
        seed=5,
        overrides=("shot.0.load.duration=2 ms",),
        profile="./p.yaml",
        output=Path("out"),
    )
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    taking = Taking()
    taking.run(queue)
    run = open_run(taking.runs[0])
    assert run.path.is_relative_to(tmp_path / "out")
    assert (run.seed, run.n_shots) == (5, 2)
    assert run.record["resolved"]["shot"][0]["load"]["duration"] == 0.002


def test_a_failure_ends_the_queue_and_is_kept(queue: Queue) -> None:
    add(queue)
    add(queue)

    def fail(run_dir: Path) -> None:
        shutil.rmtree(run_dir / "shots")

    taking = Taking(fail)
    with pytest.raises(RecordingError):
        taking.run(queue)
    assert states(queue) == {1: "failed", 2: "waiting"}
    failed = queue.entries()[0]
    assert failed.run_dir == taking.runs[0]
    assert "the folder is gone" in failed.error
    again = Taking()
    again.run(queue)
    assert again.begun == [2]  # what failed is not tried again by itself
    assert states(queue) == {1: "failed"}


def test_what_could_not_begin_goes_on_waiting(queue: Queue) -> None:
    add(queue)
    Path("p.yaml").write_text(PROFILE.replace("virtual}", "cannon}", 1), encoding="utf-8")
    with pytest.raises(ConfigError, match="cannon"):
        Taking().run(queue)
    (entry,) = queue.entries()
    assert (entry.state, entry.run_dir) == ("waiting", None)
    assert "cannon" in entry.error
    Path("p.yaml").write_text(PROFILE, encoding="utf-8")
    Taking().run(queue)
    assert queue.entries() == []


def test_a_run_that_is_stopped_after_its_shot_does_not_end_the_queue(queue: Queue) -> None:
    add(queue)
    add(queue)
    taking = Taking(ask_to_stop)
    taking.run(queue)
    assert taking.begun == [1, 2]
    assert [open_run(run).status for run in taking.runs] == ["stopped", "complete"]
    assert states(queue) == {1: "stopped"}
    with Session.resume(taking.runs[0]) as session:
        session.run()
    assert states(queue) == {1: "complete"}
    Taking().run(queue)
    assert queue.entries() == []


def test_the_queue_may_be_stopped_too(queue: Queue) -> None:
    add(queue)
    add(queue)
    assert not queue.ask_to_stop()  # no process runs it

    def stop(run_dir: Path) -> None:
        assert queue.ask_to_stop()

    taking = Taking(stop)
    taking.run(queue)
    assert taking.begun == [1]
    assert open_run(taking.runs[0]).status == "complete"
    assert states(queue) == {2: "waiting"}
    Taking().run(queue)
    assert queue.entries() == []


def test_a_queue_is_run_by_one(queue: Queue) -> None:
    add(queue)

    def again(_: Path) -> None:
        with pytest.raises(ConfigError, match=r"already being run: labseq queue run \(process \d+ on "):
            Taking().run(queue)

    Taking(again).run(queue)
    assert queue.holder() is None


@pytest.mark.parametrize(("number", "status"), [(2, "stopped"), (15, "running")])
def test_ctrl_c_is_meant_and_a_computer_that_shuts_down_is_not(
    queue: Queue, number: int, status: str
) -> None:
    add(queue)
    add(queue)

    class Signalling:
        def event(self, name: str, values: Mapping[str, Any]) -> None:
            if name == "shot_finished":
                session.stop_flag.request(number)

    def take(opening: Opening) -> None:
        nonlocal session
        with opening(Signalling()) as session:
            session.run()

    session: Any = None
    with pytest.raises(StopRequested):
        QueueRun(queue, take, lambda _: None, lambda _: None, Taking().calibrate).run()
    first, second = queue.entries()
    assert (first.status, second.status) == (status, "waiting")
    assert first.run_dir == session.run_dir
    if status == "running":  # by a process that will be gone
        queue.write(replace(first, owner=replace(Process.current(), started=1.0)))
    taking = Taking()
    taking.run(queue)
    assert taking.begun == ([2] if status == "stopped" else [1, 2])


def test_an_interrupted_entry_comes_first_and_goes_on(queue: Queue) -> None:
    add(queue)
    add(queue)
    Taking(ask_to_stop, lambda _: None).run(queue)
    (entry,) = queue.entries()
    add(queue)
    queue.move(3, 1)
    gone = replace(Process.current(), started=1.0)
    queue.write(replace(entry, status="running", owner=gone))
    assert states(queue) == {3: "waiting", 1: "interrupted"}
    taking = Taking()
    taking.run(queue)
    assert taking.begun == [1, 3]
    assert len(open_run(taking.runs[0]).record["resumed"]) == 1
    assert queue.entries() == []


def test_an_entry_of_a_living_process_is_left_alone(queue: Queue) -> None:
    entry = add(queue)
    queue.write(replace(entry, status="running", owner=Process.current()))
    assert states(queue) == {1: "running"}
    Taking().run(queue)
    assert states(queue) == {1: "running"}
    with pytest.raises(ConfigError, match="entry 1 is running; 'labseq stop' ends it first"):
        queue.remove([1])


def lose_folder(run_dir: Path) -> None:
    shutil.rmtree(run_dir / "shots")


def restore_folder(run_dir: Path) -> None:
    (run_dir / "shots").mkdir(exist_ok=True)


def test_each_entry_says_what_its_failure_means(queue: Queue) -> None:
    add(queue, rules=Rules("skip"))
    add(queue)
    taking = Taking(lose_folder)
    assert isinstance(taking.run(queue).first_error, RecordingError)
    assert (taking.begun, [type(error) for error in taking.failures]) == ([1, 2], [RecordingError])
    assert states(queue) == {1: "failed"}


def test_a_run_that_fails_is_resumed_once_if_its_entry_says_so(queue: Queue) -> None:
    add(queue, rules=Rules("retry"))
    add(queue)
    tried: list[Path] = []

    class Losing:
        def event(self, name: str, values: Mapping[str, Any]) -> None:
            if name == "shot_finished" and len(tried) == 1:
                lose_folder(tried[0])
            elif name == "run_starting":
                tried.append(Path(values["run_dir"]))
                restore_folder(tried[-1])

    def take(opening: Opening) -> None:
        if tried:
            restore_folder(tried[0])
        with opening(Losing()) as session:
            session.run()

    failures: list[Exception] = []
    QueueRun(queue, take, lambda _: None, failures.append, Taking().calibrate).run()
    assert len(failures) == 1
    assert tried[0] == tried[1] != tried[2]
    assert open_run(tried[0]).status == "complete"
    assert queue.entries() == []


def test_a_run_that_fails_twice_is_left_and_the_queue_goes_on(queue: Queue) -> None:
    add(queue, rules=Rules("retry"))
    add(queue)
    taking = Taking(lose_folder)  # and there is none when the run is resumed
    taking.run(queue)
    assert taking.begun == [1, 1, 2]
    assert states(queue) == {1: "failed"}


def test_a_full_disk_holds_the_queue_until_there_is_room(
    queue: Queue, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add(queue, rules=Rules("skip"))
    add(queue)
    looks, write = [0], Queue.write

    def fill(run_dir: Path) -> None:
        lose_folder(run_dir)
        looks[0] = 5

    def free(_: Path) -> int:
        looks[0] = max(0, looks[0] - 1)
        return 0 if looks[0] else 10**12

    def write_if_room(queue: Queue, entry: Entry) -> None:
        if looks[0]:
            raise RecordingError(queue.folder, "cannot be written: No space left on device")
        write(queue, entry)

    monkeypatch.setattr(Queue, "write", write_if_room)
    monkeypatch.setattr("labseq.queue.running.free_bytes", free)
    monkeypatch.setattr("labseq.queue.running.POLL_S", 0.0)
    taking = Taking(fill)
    taking.run(queue)
    assert (taking.begun, states(queue)) == ([1, 2], {1: "failed"})
    assert capsys.readouterr().err.count("queue: waits: the disk of") == 1


def test_no_shot_is_taken_after_the_time_of_an_entry(queue: Queue) -> None:
    over = now_utc()
    add(queue, rules=Rules(until_utc=over))
    add(queue)
    taking = Taking()
    taking.run(queue)
    assert taking.begun == [2]
    (skipped,) = queue.entries()
    assert (skipped.state, skipped.error[:12]) == ("skipped", "not begun by")
    queue.wait_again(1)
    Taking().run(queue)
    assert queue.entries() == []


def test_a_run_whose_time_is_over_ends_after_its_shot(queue: Queue, monkeypatch: pytest.MonkeyPatch) -> None:
    add(queue, rules=Rules(until_utc="2100-01-01T00:00:00+00:00"))
    taking = Taking(lambda _: monkeypatch.setattr(Rules, "is_too_late", True))
    taking.run(queue)
    monkeypatch.undo()
    assert [len(open_run(run).shots) for run in taking.runs] == [2]  # looked at before this test's own act
    assert (states(queue), queue.entries()[0].error[:8]) == ({1: "stopped"}, "ended at")
    queue.wait_again(1)
    with pytest.raises(ConfigError, match="entry 1 is waiting; expected an entry that was stopped"):
        queue.wait_again(1)


def test_a_calibration_that_is_missing_old_or_doubted_comes_first(
    queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    add(queue, rules=Rules(needs={"thresholds": 3600.0}))
    taking = Taking()
    taking.run(queue)
    assert taking.calibrated == [("thresholds", "p.yaml")]
    store = open_store("./p.yaml")[0]
    values = {"thresholds": np.full((4, 4), 100.0)}
    entry = CalibrationEntry("thresholds", values, {}, grid_facts(SiteGrid(4, 4)), {}, now_utc("seconds"))
    store.use(store.add(entry), SiteGrid(4, 4))
    add(queue, rules=Rules(needs={"thresholds": 3600.0}))
    add(queue, rules=Rules(needs={"thresholds": 0.0}))
    taking = Taking()
    taking.run(queue)
    assert (taking.begun, len(taking.calibrated)) == ([2, 3], 1)
    add(queue, rules=Rules(needs={"thresholds": 3600.0}))
    runs = QueueRun(queue, taking, lambda _: None, lambda _: None, taking.calibrate, doubted={"thresholds"})
    runs.run()
    assert (len(taking.calibrated), runs.doubted) == (2, set())
