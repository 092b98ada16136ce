"""A run in another process, watched by its files."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from labseq.cli.live import Tally
from labseq.cli.watch import watch_run
from labseq.data.follower import Follower
from labseq.data.reader import open_run
from labseq.recording.writer import RunWriter


class WrittenRun:
    """A run that is written while it is watched."""

    def __init__(self, root: Path, fake: Any, n_shots: int = 3) -> None:
        self.fake = fake
        self.writer = RunWriter.create(root, fake.run(n_shots=n_shots))
        self.writer.event("run_starting", run_dir=str(self.writer.run_dir))
        self.out = io.StringIO()

    def take(self, index: int, **changes: Any) -> None:
        shot = self.fake.shot(index, **changes)
        shot.images.append(self.fake.image(self.fake.target().fill))
        self.writer.event("shot_started", shot=index, attempt=shot.attempt)
        self.writer.write_shot(shot)
        names = ("shot_index", "attempt", "status", "error", "success", "filling_fraction")
        printed = {name: getattr(shot, name) for name in names}
        self.writer.event("shot_repeated" if shot.status == "failed" else "shot_finished", shot=printed)

    def watch(self, *meanwhile: Callable[[], None]) -> list[str]:
        """Watch the run; between the looks at it, do these things."""
        left = list(meanwhile)

        def wait(duration_s: float) -> None:
            assert duration_s > 0
            left.pop(0)()

        watch_run(self.writer.run_dir, self.out, wait)
        assert not left
        return self.out.getvalue().splitlines()


@pytest.fixture
def watched(tmp_path: Path, fake: Any) -> WrittenRun:
    return WrittenRun(tmp_path, fake)


def test_a_run_is_watched_to_its_end(watched: WrittenRun) -> None:
    watched.take(0)
    lines = watched.watch(
        lambda: watched.take(1, status="failed", error="TransientError: no light"),
        lambda: watched.take(1, attempt=1),
        lambda: None,
        lambda: watched.writer.finish("stopped"),
    )
    assert lines[0].endswith("3 shots, seed 1, profile virtual, simulated")
    assert lines[1:4] == [
        "shot 0  defect-free after 2 cycles  filling 100.0 %  1.9 s",
        "shot 1: attempt 0 failed, trying again: TransientError: no light",
        "shot 1  defect-free after 2 cycles  filling 100.0 %  1.9 s",
    ]
    assert "shots             2 of 3, 1 attempt kept that did not complete" in lines


def test_an_attempt_that_is_made_again_after_an_interruption_has_a_line_of_its_own(
    watched: WrittenRun,
) -> None:
    watched.take(0, status="interrupted")
    watched.take(0)
    watched.writer.finish("complete")
    lines = [line for line in watched.watch() if line.startswith("shot 0")]
    assert [line.split()[2] for line in lines] == ["interrupted", "defect-free"]


def test_a_finished_run_is_shown_at_once(watched: WrittenRun) -> None:
    watched.take(0)
    watched.writer.finish("complete")
    assert "status            complete" in watched.watch()


def test_ctrl_c_leaves_the_run_alone(watched: WrittenRun) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    lines = watched.watch(interrupt)
    assert lines[-1] == f"stopped watching the run {watched.writer.run_dir}, which continues"
    assert open_run(watched.writer.run_dir).status == "running"


def test_the_view_learns_what_the_runs_own_view_does(watched: WrittenRun) -> None:
    """Its times are those of the run, in all its parts, whatever day it is."""
    watched.take(0)
    times_s, path = iter([0.0, 70.0, 5.0]), watched.writer.run_dir / "events.jsonl"  # resumed before the last
    lines = [json.loads(line) | {"t_s": next(times_s)} for line in path.read_text("utf-8").splitlines()]
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines), "utf-8")
    clock_s = [500.0]
    follower = Follower(watched.writer.run_dir, lambda: clock_s[0])
    tally = Tally(follower.now)
    for event in follower.events():
        tally.add(event.name, event.values)
    assert (tally.n_done, tally.n_defect_free, tally.n_seen, tally.n_shots) == (1, 1, 1, 3)
    assert follower.now() == 75.0
    clock_s[0] = 507.0
    assert follower.now() == 82.0
    assert not follower.is_over
    assert [*follower.events()] == []


def test_lines_of_another_version_and_damaged_ones_are_passed_over(watched: WrittenRun) -> None:
    path = watched.writer.run_dir / "events.jsonl"
    watched.take(0)
    odd: list[Any] = [
        {},
        {"event": "warning"},
        {"t_utc": "2026-11-20T10:00:00+00:00", "event": "shot_finished", "values": {}},
    ]
    watched.writer.finish("complete")
    path.write_text(
        "x\n" + "".join(f"{json.dumps(line)}\n" for line in odd) + path.read_text("utf-8"), "utf-8"
    )
    assert any(line.startswith("shot 0  ") for line in watched.watch())


@pytest.mark.parametrize("is_named", [True, False])
def test_the_next_run_is_watched_when_one_is_over(
    watched: WrittenRun, tmp_path: Path, fake: Any, monkeypatch: pytest.MonkeyPatch, is_named: bool
) -> None:
    monkeypatch.chdir(tmp_path.parent)
    monkeypatch.setenv("LABSEQ_DATA", tmp_path.name)
    runs = [watched]

    def begin_another() -> None:
        runs.append(WrittenRun(tmp_path, fake))

    def leave() -> None:
        raise KeyboardInterrupt

    steps: list[Callable[[], None]] = [
        lambda: watched.writer.finish("complete"),
        begin_another,
        lambda: runs[1].writer.finish("failed", "no light"),
        leave,
    ]
    named = watched.writer.run_dir if is_named else None
    watch_run(named, watched.out, lambda _: steps.pop(0)(), follow=True)
    text = watched.out.getvalue()
    summaries = [line for line in text.splitlines() if line.startswith("run ")]
    assert [line.split()[1] for line in summaries] == [str(run.writer.run_dir) for run in runs]
    assert "no light" in text
    assert text.splitlines()[-1].startswith("stopped watching")
