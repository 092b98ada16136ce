"""``labseq queue``, ``resume`` and ``stop``: what is printed, and the exit code."""

from __future__ import annotations

import json
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.cli import main
from labseq.errors import StopRequested
from labseq.plain import now
from labseq.queue.listing import outcome_lines
from labseq.queue.queue import Queue
from labseq.session.stopping import ask_to_stop
from labseq.testing.fakes import RecordingObserver

from .queued import PROFILE, SEQUENCE


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("LABSEQ_DATA", raising=False)
    monkeypatch.setenv("GIT_DIR", "/dev/null")  # edits while the tests run are no change here
    Path("s.yaml").write_text(SEQUENCE, encoding="utf-8")
    Path("p.yaml").write_text(PROFILE, encoding="utf-8")


def call(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[Any, str, str]:
    capsys.readouterr()
    with pytest.raises(SystemExit) as leaving:
        main(arguments)
    out, err = capsys.readouterr()
    return leaving.value.code, out, err


def test_runs_are_queued_listed_moved_removed_and_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert "empty" in call(capsys, "queue", "list")[1]
    code, out, err = call(capsys, "queue", "add", "s.yaml", "--shots", "2", "--set", "attempts=5")
    assert (code, out.startswith("1: s.yaml, 2 shots"), err) == (0, True, "")
    call(capsys, "queue", "add", "s.yaml")
    call(capsys, "queue", "add", "s.yaml", "--seed", "7")
    assert call(capsys, "queue", "move", "3", "--before", "1")[0] == 0
    assert call(capsys, "queue", "remove", "2")[0] == 0
    code, out, err = call(capsys, "queue", "list")
    assert (code, err) == (0, "")
    header, first, second = out.splitlines()
    assert header.split() == ["id", "state", "sequence", "begun", "ends", "options"]
    assert (first.split()[:3], first.split()[-1]) == (["3", "waiting", "s.yaml"], "seed=7")
    assert second.endswith("shots=2, attempts=5")
    code, out, err = call(capsys, "queue", "run")
    assert (code, err) == (0, "")
    about_queue = [line for line in out.splitlines() if line.startswith("queue:")]
    assert [line[:8] for line in about_queue[:2]] == ["queue: 3", "queue: 1"]
    assert about_queue[2:] == ["queue: 2 runs complete"]
    runs = sorted(Path("data").glob("*/*/run.json"))
    assert [len(labseq.open_run(run).shots) for run in runs] == [3, 2]
    assert [row.split()[:2] for row in call(capsys, "queue", "list")[1].splitlines()[1:]] == [
        ["3", "complete"],
        ["1", "complete"],
    ]


def test_the_list_says_what_one_should_know(capsys: pytest.CaptureFixture[str]) -> None:
    call(capsys, "queue", "add", "s.yaml")
    Path("s.yaml").write_text(SEQUENCE + "\n", encoding="utf-8")
    Path("p.yaml").unlink()
    code, _, err = call(capsys, "queue", "run")
    assert code == 2
    assert err.startswith(f"{Path.cwd() / 's.yaml'} (as queued):4:10: there is no hardware profile at ")
    code, out, _ = call(capsys, "queue", "list")
    *_, changed, why = out.splitlines()
    assert changed.startswith("1: s.yaml has been changed")
    assert why.startswith("1: ")
    assert "there is no hardware profile" in why
    values = json.loads(call(capsys, "queue", "list", "--json")[1])["entries"][0]
    assert (values["state"], values["changed"], values["run_dir"]) == ("waiting", True, None)
    assert values["options"]["dry_run"] == "off"


def test_what_still_waits_is_told_with_the_command_that_continues(capsys: pytest.CaptureFixture[str]) -> None:
    call(capsys, "queue", "add", "s.yaml")
    assert outcome_lines(Queue(Path("data")), timedelta(hours=1)) == [
        "queue: 0 runs complete",
        "queue: 1 waiting: 1 s",
        "queue: 'labseq queue run' continues, with --keep-going also after a failure",
    ]


def test_a_queue_that_keeps_going_ends_with_the_first_failure(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    call(capsys, "queue", "add", "s.yaml", "--set", "profile.camera.faults={transient: 1.0}")
    call(capsys, "queue", "add", "s.yaml")
    code, out, err = call(capsys, "queue", "run", "--keep-going")
    assert code == 3
    assert err.count("error: ") == 1
    assert out.count("queue: ") == 4
    assert out.endswith("queue: 1 run complete\nqueue: 1 failed: 1 s\n")
    code, out, _ = call(capsys, "queue", "list")
    (run,) = [path.parent for path in Path("data").glob("*/*/run.json") if not labseq.open_run(path).shots]
    assert f"1: 'labseq resume {run.absolute()}' resumes its run now, " in out
    assert [row.split()[:2] for row in out.splitlines()[1:3]] == [["2", "complete"], ["1", "failed"]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("queue", "remove", "5"), "error: the queue has no entry 5"),
        (("stop", "--profile", "./p.yaml"), "error: no run is in progress on the profile ./p.yaml"),
        (("stop", "--queue"), "error: no process runs the queue; to end a run use 'labseq stop' "),
        (("stop", "nowhere"), "nowhere: no such file or folder"),
    ],
)
def test_what_is_not_there_is_said(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = call(capsys, *arguments)
    assert (code, out) == (2, "")
    assert message in err


class Stopping(RecordingObserver):
    """Asks for the end of the run in its second shot."""

    def event(self, name: str, values: Any) -> None:
        super().event(name, values)
        if name == "shot_started" and values["shot"] == 1:
            ask_to_stop(Path(self.of("run_starting")[0]["run_dir"]))


@pytest.fixture
def stopped() -> Path:
    """A run of three shots of which two are done."""
    with labseq.Session.open("s.yaml", observer=Stopping()) as session:
        with pytest.raises(StopRequested):
            session.run()
        assert session.run_dir is not None
        return session.run_dir


def test_a_run_is_resumed(stopped: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = call(capsys, "resume", str(stopped))
    assert (code, err) == (0, "")
    assert "3 shots, 2 of them taken before, seed 1" in out
    assert "shot 2  " in out
    assert "shot 0  " not in out
    assert labseq.open_run(stopped).status == "complete"
    code, _, err = call(capsys, "resume", str(stopped))
    assert code == 2
    assert err.startswith(f"{stopped}: ")
    assert "it is complete" in err


def test_a_run_in_progress_is_asked(stopped: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from labseq.files import write_file
    from labseq.recording import mark_active
    from labseq.recording.run_file import encode_state

    write_file(stopped / "STATE", encode_state("running"))
    mark_active("lab", [], stopped)
    code, out, err = call(capsys, "stop")
    assert (code, err) == (0, "")
    assert out.splitlines()[0].startswith(f"{stopped} (process ")
    assert out.splitlines()[1].endswith(f"labseq resume {stopped}")
    assert (stopped / "STOP").exists()


def test_rules_are_listed_with_the_expected_ends(capsys: pytest.CaptureFixture[str]) -> None:
    rules = ("--if-fails", "skip", "--until", "2100-01-01 06:00", "--needs", "thresholds=2h")
    for _ in range(2):
        code, out, err = call(capsys, "queue", "add", "s.yaml", "--realtime", "--shots", "36000", *rules)
        assert (code, err, ", about 1:" in out) == (0, "", True)
    first, second = call(capsys, "queue", "list")[1].splitlines()[1:]
    assert first.count(" about ") == second.count(" about ") == 1
    assert "shots=36000, if-fails=skip, until=2100-01-01 06:00, needs" in first
    values = json.loads(call(capsys, "queue", "list", "--json")[1])["entries"]
    ends = [datetime.fromisoformat(one["ends_utc"]) for one in values]
    expected_s = values[0]["expected_s"]
    assert 3600 < expected_s < 3 * 3600
    assert abs((ends[1] - ends[0]).total_seconds() - expected_s) < 2
    assert abs((ends[0] - now()).total_seconds() - expected_s) < 60


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (("--until", "6 am"), "--until is '6 am'; expected a time such as 06:00"),
        (("--until", "2001-01-01 06:00"), "which is in the past"),
        (("--needs", "threshold=2h"), "did you mean 'thresholds'?"),
        (("--needs", "thresholds=2"), "--needs thresholds is '2'; expected an age with its unit"),
    ],
)
def test_wrong_rules_are_refused(
    capsys: pytest.CaptureFixture[str], options: tuple[str, ...], what: str
) -> None:
    code, _, err = call(capsys, "queue", "add", "s.yaml", *options)
    assert code == 2
    assert what in err
    assert "empty" in call(capsys, "queue", "list")[1]
