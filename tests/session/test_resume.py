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
    Wholes,
    changed,
    interrupted,
    lines,
    resumed,
    stopped,
    stopped_home,
    table,
    wholes,
    write,
)

__all__ = ["stopped", "stopped_home", "wholes"]


@settings(max_examples=3, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    scan=st.sampled_from(sorted(SCANS)),
    stops=st.lists(
        st.tuples(st.sampled_from(["shot_started", "image", "cycle", "shot_finished"]), st.integers(1, 8)),
        min_size=1,
        max_size=2,
    ),
)
def test_an_interrupted_run_gives_the_same_shots(
    wholes: Wholes, scan: str, stops: list[tuple[str, int]]
) -> None:
    (event, n), *later = stops
    expected = wholes(scan)
    run_dir = interrupted(wholes.folder / f"{scan.replace(' ', '_')}.yaml", event, n)
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
    assert table(run) == expected
    for shot in (*run.shots, *run.attempts):
        shot.verify()


def test_what_was_resumed_is_on_record(stopped: Path) -> None:
    (stopped / "STOP").write_text("")  # of before
    (stopped / "index.jsonl").write_text("\n".join(lines(stopped)[:3]), encoding="utf-8")  # no line end
    seen = RecordingObserver()
    run = resumed(stopped, seen)
    (once,) = run.record["resumed"]
    assert (once["first_shot"], once["changes"]) == (3, [])
    assert once["provenance"]["labseq"] == labseq.__version__
    assert once["t_utc"] > run.record["t_start_utc"]
    assert seen.of("run_starting")[0]["n_before"] == 3
    assert (len(run.shots), run.n_damaged_lines, len(lines(stopped))) == (6, 0, 6)
    assert run.record["devices"]
    assert not (stopped / "STOP").exists()
    with pytest.raises(ConfigError, match="it is complete"):
        labseq.Session.resume(stopped)


def test_files_of_interrupted_attempts_are_kept(stopped: Path) -> None:
    for _ in range(2):
        observer = Interrupting("shot_started", 1)
        with labseq.Session.resume(stopped, observer=observer) as session:
            observer.session = session
            with pytest.raises(StopRequested):
                session.run()
    run = resumed(stopped)
    first = "shot_000003.attempt_0"
    names = [attempt.file.name for attempt in run.attempts]
    assert names == [f"{first}.h5", f"{first}.take_2.h5", f"{first}.take_3.h5"]
    assert {(attempt.index, attempt.attempt, attempt.status) for attempt in run.attempts} == {
        (3, 0, "interrupted")
    }
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


def test_a_shot_whose_file_is_gone_is_taken_again(stopped: Path) -> None:
    (stopped / "shots" / "shot_000001.h5").unlink()
    seen = RecordingObserver()
    run = resumed(stopped, seen)
    assert len(run.shots) == 6
    assert all(shot.file.exists() for shot in run.shots)
    assert any("taken again: 1" in values["text"] for values in seen.of("warning"))


def state_of_another(run_dir: Path, **changes: str) -> None:
    state = json.loads((run_dir / "STATE").read_text())
    (run_dir / "STATE").write_text(json.dumps({**state, "state": "running", **changes}))


def test_a_run_that_died_after_its_last_shot_is_complete(tmp_path: Path) -> None:
    run_dir = interrupted(write(tmp_path), "shot_finished", 6)
    assert labseq.open_run(run_dir).status == "complete"
    state_of_another(run_dir, started="another")
    assert labseq.open_run(run_dir).status == "failed"
    changed(run_dir, lambda record: record["plugins"][0].update(sha256="0" * 64))
    run = resumed(run_dir, accept_changes=True)
    assert (run.status, len(run.shots), run.record["resumed"]) == ("complete", 6, [])
    assert [path.name for path in run_dir.glob("sources*")] == ["sources.zip"]  # today's took no shot


def test_options_a_dry_run_and_relative_paths_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("elsewhere", "mine", "plugins"):
        (tmp_path / folder).mkdir()
    monkeypatch.chdir(tmp_path)
    sequence = Path(write(tmp_path).name)
    own = "calibrations: {folder: mine}\nplugin_folders: [plugins]\n"
    text = PROFILE.replace("camera: {use: virtual}", "camera: {use: andor}") + own
    Path("p.yaml").write_text(text, encoding="utf-8")
    options: dict[str, Any] = {
        "shots": 3,
        "dry_run": "fast",
        "profile": "p.yaml",
        "overrides": ["planner.degree_of_parallelism=2", "profile.mobile_tweezers.speed=100 um/ms"],
    }
    run_dir = tmp_path / interrupted(sequence, "shot_started", 2, **options)
    Path("p.yaml").unlink()
    monkeypatch.chdir("elsewhere")
    run = resumed(run_dir)
    assert (len(run.shots), run.status) == (3, "complete")
    assert run.record["resolved"]["profile"]["calibrations"]["folder"] == "mine"
    assert run.shots[0].parameters == run.shots[-1].parameters


REFUSED: dict[str, tuple[Any, type[Exception], str]] = {
    "another number of shots": (
        lambda run: changed(run, lambda r: r.update(n_shots=9)),
        ConfigError,
        "shots would differ today: n_shots was 9 and is now 6",
    ),
    "another text": (
        lambda run: (run / "sequence.yaml").write_text("labseq: 1\n"),
        RecordingError,
        "not the file described in run.json",
    ),
    "no profile": (lambda run: (run / "profile.yaml").unlink(), RecordingError, "cannot be read"),
    "a newer format": (
        lambda run: changed(run, lambda r: r.update(format_version="9.0")),
        RecordingError,
        "update labseq",
    ),
    "a damaged record": (
        lambda run: changed(run, lambda r: r.pop("overrides")),
        RecordingError,
        "no valid 'overrides'",
    ),
    "no run": (shutil.rmtree, RecordingError, "no such file or folder"),
    "another calibration": (
        lambda run: changed(run, lambda r: r.update(calibrations={"sites": "f102b3cd999c"})),
        ConfigError,
        "f102b3cd999c",
    ),
    "in progress": (
        lambda run: write_file(run / "STATE", encode_state("running")),
        ConfigError,
        r"it is in progress \(process \d+ on ",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_run_that_cannot_be_resumed_is_left_alone(stopped: Path, name: str) -> None:
    def contents() -> dict[Path, bytes]:
        files = (path for path in stopped.rglob("*") if path.is_file() and not path.name.startswith("."))
        return {path: path.read_bytes() for path in files}

    spoil, kind, message = REFUSED[name]
    spoil(stopped)
    before = contents()
    with pytest.raises(kind, match=message):
        labseq.Session.resume(stopped, accept_changes=True)
    assert contents() == before


def test_a_run_that_may_be_in_progress_elsewhere_is_a_change(stopped: Path) -> None:
    state_of_another(stopped, host="another")
    with pytest.raises(ConfigError, match=r"computer was another and .*in progress there"):
        labseq.Session.resume(stopped)
    assert resumed(stopped, accept_changes=True).status == "complete"


def test_one_resumes_at_a_time(stopped: Path) -> None:
    with labseq.Session.resume(stopped) as session:
        with pytest.raises(ConfigError, match=r"labseq resume \(process \d+ on "):
            labseq.Session.resume(stopped)
        session.run()
    assert labseq.open_run(stopped).status == "complete"


def test_a_run_may_have_been_put_elsewhere(stopped: Path, tmp_path: Path) -> None:
    moved = tmp_path / "usb" / "my run"
    shutil.copytree(stopped, moved)
    assert resumed(moved).path == moved
    assert labseq.open_run(moved).status == "complete"
    assert labseq.open_run(stopped).status == "stopped"
    assert {path.name for path in moved.parent.iterdir()} == {"my run"}
