"""Runs that ended early go on as if nothing had happened."""

from __future__ import annotations

import json
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

import labseq
from labseq.errors import ConfigError, RecordingError, StopRequested
from labseq.files import write_file
from labseq.recording.run_file import encode_state
from labseq.testing.fakes import RecordingObserver

from .small_runs import (
    PROFILE,
    SCANS,
    Interrupting,
    changed,
    interrupted,
    lines,
    no_git,
    resumed,
    stopped,
    stopped_home,
    table,
    write,
)

__all__ = ["no_git", "stopped", "stopped_home"]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("home")
    write(folder)
    return folder


WHOLE: dict[str, list[Any]] = {}


def whole(home: Path, scan: str) -> list[Any]:
    """The table of the run that nobody interrupts."""
    if scan not in WHOLE:
        run_dir = interrupted(write(home, scan), "never", 1)
        WHOLE[scan] = table(labseq.open_run(run_dir))
    return WHOLE[scan]


@settings(max_examples=3, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    scan=st.sampled_from(sorted(SCANS)),
    stops=st.lists(
        st.tuples(st.sampled_from(["shot_started", "image", "cycle", "shot_finished"]), st.integers(1, 8)),
        min_size=1,
        max_size=2,
    ),
)
def test_an_interrupted_run_ends_as_if_nothing_had_happened(
    home: Path, scan: str, stops: list[tuple[str, int]]
) -> None:
    (event, n), *later = stops
    run_dir = interrupted(write(home, scan), event, n)
    for event, n in later:
        if labseq.open_run(run_dir).status == "complete":
            break
        observer = Interrupting(event, n)
        with labseq.Session.resume(run_dir, observer=observer) as session:
            observer.session = session
            with suppress(StopRequested):
                session.run()
    if labseq.open_run(run_dir).status != "complete":
        resumed(run_dir)
    run = labseq.open_run(run_dir)
    assert (run.status, run.n_damaged_lines) == ("complete", 0)
    assert [json.loads(line)["counts"] for line in lines(run_dir)].count(True) == run.n_shots
    assert table(run) == whole(home, scan)
    for shot in (*run.shots, *run.attempts):
        shot.verify()


def test_what_was_resumed_is_on_record(stopped: Path) -> None:
    seen = RecordingObserver()
    run = resumed(stopped, seen)
    (once,) = run.record["resumed"]
    assert (once["first_shot"], once["changes"]) == (3, [])
    assert once["provenance"]["labseq"] == labseq.__version__
    assert once["t_utc"] > run.record["t_start_utc"]
    assert seen.of("run_starting")[0]["n_before"] == 3
    assert len(run.shots) == 6
    (attempt,) = run.attempts
    assert (attempt.index, attempt.attempt, attempt.status) == (3, 0, "interrupted")
    assert run.record["devices"]


def test_files_of_interrupted_attempts_are_kept(stopped: Path) -> None:
    for _ in range(2):
        observer = Interrupting("shot_started", 1)
        with labseq.Session.resume(stopped, observer=observer) as session:
            observer.session = session
            with pytest.raises(StopRequested):
                session.run()
    run = resumed(stopped)
    names = [attempt.file.name for attempt in run.attempts]
    first = "shot_000003.attempt_0"
    assert names == [f"{first}.h5", f"{first}.take_2.h5", f"{first}.take_3.h5"]
    for attempt in run.attempts:
        attempt.verify()
    assert len(run.record["resumed"]) == 3


def test_a_shot_that_never_came_into_the_index_is_taken_again_beside_its_file(stopped: Path) -> None:
    index = lines(stopped)
    (stopped / "index.jsonl").write_text("\n".join([*index[:2], index[2][:50]]), encoding="utf-8")
    left = (stopped / "shots" / "shot_000002.h5").read_bytes()
    run = resumed(stopped)
    assert [shot.file.name for shot in run.shots][1:4] == [
        "shot_000001.h5", "shot_000002.take_2.h5", "shot_000003.h5"
    ]  # fmt: skip
    assert (stopped / "shots" / "shot_000002.h5").read_bytes() == left
    assert run.n_damaged_lines == 1
    assert index[2][:50] in lines(stopped)


def test_a_whole_line_without_its_end_counts(stopped: Path) -> None:
    (stopped / "index.jsonl").write_text("\n".join(lines(stopped)[:3]), encoding="utf-8")
    run = resumed(stopped)
    assert run.record["resumed"][0]["first_shot"] == 3
    assert (len(run.shots), run.n_damaged_lines, len(lines(stopped))) == (6, 0, 6)


def test_a_shot_whose_file_is_gone_is_taken_again(stopped: Path) -> None:
    (stopped / "shots" / "shot_000001.h5").unlink()
    seen = RecordingObserver()
    run = resumed(stopped, seen)
    assert len(run.shots) == 6
    assert all(shot.file.exists() for shot in run.shots)
    assert any("taken again: 1" in values["text"] for values in seen.of("warning"))


def test_a_run_that_died_after_its_last_shot_is_complete(tmp_path: Path) -> None:
    run_dir = interrupted(write(tmp_path), "shot_finished", 6)
    assert labseq.open_run(run_dir).status == "complete"
    state = json.loads((run_dir / "STATE").read_text())
    (run_dir / "STATE").write_text(json.dumps({**state, "state": "running", "started": "another"}))
    assert labseq.open_run(run_dir).status == "failed"
    run = resumed(run_dir)
    assert (run.status, len(run.shots), run.record["resumed"]) == ("complete", 6, [])


def test_options_and_dry_runs_are_kept(tmp_path: Path) -> None:
    text = PROFILE.replace("camera: {use: virtual}", "camera: {use: andor}")
    sequence = write(tmp_path)
    (tmp_path / "p.yaml").write_text(text, encoding="utf-8")
    options: dict[str, Any] = {
        "shots": 3,
        "dry_run": "fast",
        "profile": str(tmp_path / "p.yaml"),
        "overrides": ["planner.degree_of_parallelism=2", "profile.mobile_tweezers.speed=100 um/ms"],
    }
    run_dir = interrupted(sequence, "shot_started", 2, **options)
    (tmp_path / "p.yaml").unlink()
    run = resumed(run_dir)
    assert (len(run.shots), run.status) == (3, "complete")
    assert run.shots[0].parameters == run.shots[-1].parameters


def test_relative_paths_lead_where_they_led(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("elsewhere", "mine", "plugins"):
        (tmp_path / folder).mkdir()
    sequence = write(tmp_path)
    own = "calibrations: {folder: mine}\nplugin_folders: [plugins]\n"
    (tmp_path / "p.yaml").write_text(PROFILE + own, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    run_dir = interrupted(Path(sequence.name), "shot_started", 2)
    assert labseq.open_run(run_dir).record["resolved"]["profile"]["calibrations"]["folder"] == "mine"
    monkeypatch.chdir("elsewhere")
    assert resumed(run_dir).status == "complete"


REFUSED: dict[str, tuple[Any, type[Exception], str]] = {
    "other shots": (
        lambda run: changed(run, lambda r: r.update(n_shots=9)),
        ConfigError,
        "shots would be others today: n_shots was 9, is 6",
    ),
    "other scan": (
        lambda run: changed(run, lambda r: r.update(scan={"order": "odd"})),
        ConfigError,
        "others today: order was",
    ),
    "other text": (
        lambda run: (run / "sequence.yaml").write_text("labseq: 1\n"),
        RecordingError,
        "not what run.json says",
    ),
    "no profile": (lambda run: (run / "profile.yaml").unlink(), RecordingError, "cannot be read"),
    "newer": (
        lambda run: changed(run, lambda r: r.update(format_version="9.0")),
        RecordingError,
        "update labseq",
    ),
    "foreign": (lambda run: (run / "run.json").write_text("{}"), RecordingError, "not labseq's"),
    "damaged": (
        lambda run: changed(run, lambda r: r.pop("overrides")),
        RecordingError,
        "no valid 'overrides'",
    ),
    "no run": (shutil.rmtree, RecordingError, "no such file or folder"),
    "calibration": (
        lambda run: changed(run, lambda r: r.update(calibrations={"sites": "f102b3cd999c"})),
        ConfigError,
        "f102b3cd999c",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_run_that_cannot_be_resumed_is_left_alone(stopped: Path, name: str) -> None:
    spoil, kind, message = REFUSED[name]
    spoil(stopped)
    before = {p: p.read_bytes() for p in stopped.rglob("*") if p.is_file() and not p.name.startswith(".")}
    with pytest.raises(kind, match=message):
        labseq.Session.resume(stopped, accept_changes=True)
    assert {
        p: p.read_bytes() for p in stopped.rglob("*") if p.is_file() and not p.name.startswith(".")
    } == before


def test_a_complete_run_is_refused(stopped: Path) -> None:
    resumed(stopped)
    with pytest.raises(ConfigError, match="it is complete: no shot is missing"):
        labseq.Session.resume(stopped)


def test_a_run_in_progress_is_refused(stopped: Path) -> None:

    write_file(stopped / "STATE", encode_state("running"))
    with pytest.raises(ConfigError, match=r"it is in progress \(process \d+ on "):
        labseq.Session.resume(stopped)


def test_a_run_that_may_be_in_progress_elsewhere_is_a_change(stopped: Path) -> None:
    state = json.loads((stopped / "STATE").read_text())
    (stopped / "STATE").write_text(json.dumps({**state, "state": "running", "host": "another"}))
    with pytest.raises(ConfigError, match="may still be in progress was another, is this one"):
        labseq.Session.resume(stopped)
    assert resumed(stopped, accept_changes=True).status == "complete"


def test_one_resumes_at_a_time(stopped: Path) -> None:
    with labseq.Session.resume(stopped) as session:
        with pytest.raises(
            ConfigError, match=r"another process resumes it already: labseq resume \(process \d+ on "
        ):
            labseq.Session.resume(stopped)
        session.run()
    assert labseq.open_run(stopped).status == "complete"


def test_a_stop_that_was_asked_for_before_is_forgotten(stopped: Path) -> None:
    (stopped / "STOP").write_text("")
    assert resumed(stopped).status == "complete"
    assert not (stopped / "STOP").exists()


def test_a_run_may_have_been_put_elsewhere(stopped: Path, tmp_path: Path) -> None:
    moved = tmp_path / "usb" / "my run"
    shutil.copytree(stopped, moved)
    assert resumed(moved).path == moved
    assert labseq.open_run(moved).status == "complete"
    assert labseq.open_run(stopped).status == "stopped"
    assert {path.name for path in moved.parent.iterdir()} == {"my run", ".active"}
