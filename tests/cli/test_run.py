"""``labseq run`` around a session that is made up; tests/system has real ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from labseq.assembly.options import Options
from labseq.cli.run import run_sequence
from labseq.cli.summary import Summary
from labseq.console.output import discard_unwritten
from labseq.data.reader import open_run
from labseq.errors import ConfigError, DeviceError, Problem, RecordingError, StopRequested
from labseq.recording.writer import RunWriter

NOTHING = {"run_dir": None, "shots": 0, "defect_free": None, "filling_fraction": None}

ENDED = {"event": "shot_finished", "values": {}}


class FakeSession:
    """Records its arguments; takes the given shots, then raises the given error, if any."""

    def __init__(self, root: Path, run: Any, shots: Any, error: BaseException | None = None) -> None:
        self.root, self.record, self.shots, self.error = root, run, shots, error
        self.run_dir: Path | None = None
        self.given: dict[str, Any] = {}
        self.closed = False

    def open(self, sequence: Path, **given: Any) -> FakeSession:
        self.given = given
        if isinstance(self.error, ConfigError):
            raise self.error
        return self

    def __enter__(self) -> FakeSession:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True

    def run(self) -> None:
        observer = self.given["observer"]
        print("a plugin prints")
        os.write(1, b"a C library prints\n")
        writer = RunWriter.create(self.root, self.record)
        self.run_dir = writer.run_dir
        observer.event("run_starting", {"record": self.record, "run_dir": str(self.run_dir)})
        for shot in self.shots:
            observer.event("shot_finished", {"row": writer.write_shot(shot)})
        stopped = isinstance(self.error, StopRequested)
        writer.finish(
            "complete" if self.error is None else "stopped" if stopped else "failed", str(self.error or "")
        )
        lines = [{"t_s": 1.0 + shot.shot_index, **ENDED} for shot in self.shots]
        with (self.run_dir / "events.jsonl").open("a", encoding="utf-8") as events:
            events.writelines(f"{json.dumps(line)}\n" for line in lines)
        if self.error is not None:
            raise self.error


@pytest.fixture
def perform(fake: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any) -> Any:
    """Run a made-up session; returns it, stdout, stderr and the error."""

    def run(error: BaseException | None = None, *, as_json: bool = True, options: Any = None) -> Any:
        shots = [fake.shot(0), fake.shot(1, success=False, seen=0, filling=224 / 225)]
        session = FakeSession(tmp_path, fake.run(n_shots=2), shots, error)
        monkeypatch.setattr("labseq.cli.run.Session", session)
        monkeypatch.setattr(sys, "stdout", sys.stdout)  # given back at the end
        caught: BaseException | None = None
        try:
            run_sequence(Path("a.yaml"), options or Options(), as_json=as_json)
        except BaseException as failure:  # noqa: BLE001 - the tests look at it
            caught = failure
        return session, *capfd.readouterr(), caught

    return run


def test_json_is_alone_on_stdout(perform: Any) -> None:
    session, out, err, caught = perform()
    assert caught is None
    answer = json.loads(out)
    assert answer.pop("statistics")["seen"]["n"] == 2
    expected = {
        "run_dir": str(session.run_dir),
        "shots": 2,
        "skipped": 0,
        "defect_free": 0.5,
        "filling_fraction": pytest.approx(449 / 450),
        "status": "complete",
    }
    assert answer.items() >= expected.items()
    assert out.count("\n") == 1
    assert "a plugin prints\n" in err
    assert "a C library prints\n" in err
    assert "shot 1  " in err
    assert session.closed


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (StopRequested(15), "stopped", "stopped by SIGTERM"),
        (DeviceError("camera", "mute"), "failed", "error: camera: mute"),
        (
            MemoryError(),
            "failed",
            "internal error: MemoryError",
        ),
    ],
)
def test_json_of_a_run_that_ended_early(perform: Any, error: BaseException, status: str, text: str) -> None:
    session, out, _, caught = perform(error)
    assert caught is error
    answer = json.loads(out)
    assert (answer["shots"], answer["status"]) == (2, status)
    assert answer["error"].startswith(text)
    assert answer["run_dir"] == str(session.run_dir)
    assert session.closed


def test_json_of_a_run_that_never_began(perform: Any) -> None:
    problems = [Problem("unknown key", "a.yaml", 1, 2), Problem("wrong", "a.yaml", 3, 4)]
    _, out, _, caught = perform(ConfigError(problems))
    assert isinstance(caught, ConfigError)
    expected = {
        **NOTHING,
        "status": "failed",
        "error": "a.yaml:1:2: unknown key\na.yaml:3:4: wrong",
    }
    assert json.loads(out).items() >= expected.items()


def test_a_run_that_cannot_be_read_back(perform: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def finish(writer: RunWriter, *_: object) -> None:
        (writer.run_dir / "run.json").unlink()

    monkeypatch.setattr(RunWriter, "finish", finish)
    session, out, _, caught = perform(DeviceError("camera", "mute"))
    assert isinstance(caught, DeviceError)
    expected = {
        **NOTHING,
        "run_dir": str(session.run_dir),
        "status": "failed",
        "error": "error: camera: mute",
    }
    assert json.loads(out).items() >= expected.items()


def test_for_people(perform: Any) -> None:
    session, out, err, _ = perform(as_json=False)
    assert err == ""
    lines = out.splitlines()
    assert lines[-10:] == [
        f"run               {session.run_dir}",
        "sequence          compact-225, to compact",
        "status            complete",
        "shots             2 of 2",
        "defect-free       1 of 2 (50.0 %), 21.6 to 78.4 %",
        "seen defect-free  2 of 2 (100.0 %)",
        "filling           99.8(2) %",
        "best shot         0: defect-free after 0 cycles, 1.9 s",
        "simulated time    3.8 s in all shots together",
        "computer time     2 s",
    ]
    assert "shot 0  defect-free after 2 cycles  filling 100.0 %  1.9 s" in lines


def test_options_reach_the_session(perform: Any, tmp_path: Path) -> None:
    options = Options("lab", 3, 7, ("a.b=1", "c=2"), tmp_path, "fast", True, "a note", ("a tag",))
    session, *_ = perform(options=options)
    given = {name: value for name, value in session.given.items() if name != "observer"}
    assert given == {
        "profile": "lab",
        "shots": 3,
        "seed": 7,
        "overrides": ("a.b=1", "c=2"),
        "output": tmp_path,
        "dry_run": "fast",
        "realtime": True,
        "note": "a note",
        "tags": ("a tag",),
    }


def test_a_broken_screen_does_not_hide_the_outcome(perform: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: object) -> None:
        raise OSError("no screen")

    monkeypatch.setattr("labseq.console.events.LogLines.close", fail)
    _, out, _, caught = perform()
    assert caught is None
    assert json.loads(out)["status"] == "complete"


FULL = Path("/dev/full")


@pytest.mark.skipif(not FULL.exists(), reason="no full device")
def test_a_full_disk_behind_stdout_takes_nothing_from_the_run(perform: Any) -> None:
    with FULL.open("w", encoding="utf-8") as full, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        patch.setattr("labseq.console.events.LogLines.event", lambda *_: None)  # a session gives it up
        session, _, err, caught = perform(as_json=False)
        discard_unwritten()
    assert caught is None
    lines = err.splitlines()
    assert lines[0].startswith("warning: /dev/full: cannot be written: No space left on device")
    assert lines[1] == f"run               {session.run_dir}"


@pytest.mark.skipif(not FULL.exists(), reason="no full device")
@pytest.mark.parametrize("error", [DeviceError("camera", "mute"), None])
def test_an_answer_that_cannot_be_given_hides_no_failure(perform: Any, error: BaseException | None) -> None:
    stdout = os.dup(1)
    try:
        with FULL.open("wb") as full:
            os.dup2(full.fileno(), 1)
        *_, caught = perform(error)
    finally:
        os.dup2(stdout, 1)
        os.close(stdout)
    assert caught is error if error is not None else isinstance(caught, RecordingError)


LATE_PRINTS = """
import atexit, ctypes, ctypes.util, sys
from labseq.console.output import stdout_to_stderr, say
answer = stdout_to_stderr()
atexit.register(print, "said at the end")
library = ctypes.CDLL(None)
library.puts(b"buffered by the C library until the process ends")
answer("the answer")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="finds the C library as Unix does")
def test_what_is_printed_late_does_not_follow_the_answer() -> None:
    done = subprocess.run([sys.executable, "-c", LATE_PRINTS], capture_output=True, text=True, check=True)
    assert done.stdout == "the answer\n"
    assert "said at the end" in done.stderr
    assert "buffered by the C library" in done.stderr


def test_a_clock_that_is_set_changes_no_duration(perform: Any) -> None:
    session, *_ = perform(as_json=False)
    assert session.run_dir is not None
    times_s = [(10.0, "2026-11-20"), (70.0, "2026-11-19"), (5.0, "2027-01-01")]  # resumed before the last
    lines = [{"t_utc": f"{day}T10:00:00+00:00", "t_s": t, **ENDED} for t, day in times_s]
    text = "".join(f"{json.dumps(line)}\n" for line in lines)
    (session.run_dir / "events.jsonl").write_text(text, encoding="utf-8")
    assert "computer time     75 s" in Summary.of(open_run(session.run_dir)).as_text()
