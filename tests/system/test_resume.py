"""kill -9 at random moments, then ``labseq resume``: the run ends as if nothing had happened."""

import json
import os
import random
import subprocess

import pytest

import labseq

pytestmark = pytest.mark.system

N_KILLS = int(os.environ.get("LABSEQ_KILLS", "2"))

SEQUENCE = """
labseq: 1
name: scanned run
profile: watched
seed: 7
target: {pattern: compact, rows: 6, cols: 6}
planner: {use: psca}
SCAN
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 2, window: 60 ms, exposure: 45 ms}
  - image: {exposure: 45 ms}
"""
SCANS = [
    """scan:
  planner.degree_of_parallelism: [2, 6]
  profile.mobile_tweezers.speed: [100 um/ms, 130 um/ms]
repeats: 3
order: shuffled""",
    """scan:
  use: climb
  over:
    planner.degree_of_parallelism: {from: 2, to: 9}
    profile.mobile_tweezers.pick_up: {from: 20 us, to: 400 us}
  maximise: filling_fraction
  points: 6
repeats: 2""",
]
N_SHOTS = 12
N_READS = 3 * N_SHOTS
"""Images of a run at least."""


def table(run):
    names = (
        "shot",
        "attempt",
        "status",
        "success",
        "filling_fraction",
        "n_batches",
        "n_atom_moves",
        "parameters",
    )
    return [
        (
            [shot.row[name] for name in names],
            shot.occupancies.tobytes(),
            [p.moves.tobytes() for p in shot.plans],
        )
        for shot in run.shots
    ]


@pytest.fixture(params=[0])
def scanned(bench, request):
    """A bench with a sequence; the parameter says with which scan."""
    text = SEQUENCE.replace("SCAN", SCANS[request.param])
    (bench.folder / "sequence.yaml").write_text(text, encoding="utf-8")
    bench.environment["GIT_DIR"] = os.devnull  # nobody's edits while the tests run are a change here
    return bench


@pytest.fixture
def whole(scanned, monkeypatch):
    """The table of the run that nobody kills."""
    monkeypatch.setenv("WATCHED_LOG", str(scanned.folder / "other.log"))
    output = scanned.folder / "whole"
    with labseq.Session.open(scanned.folder / "sequence.yaml", output=output) as session:
        return table(session.run())


@pytest.mark.parametrize(
    ("scanned", "trial"), [(trial % 2, trial) for trial in range(N_KILLS)], indirect=["scanned"]
)
def test_a_run_that_is_killed_and_resumed_is_the_whole_run(scanned, whole, trial):
    moments = random.Random(trial)
    command = ["run", "sequence.yaml"]
    for _ in range(moments.randint(1, 2)):
        n_before = scanned.calls().count("camera.read")
        n_more = moments.randint(1, max(1, N_READS - n_before - 4))
        process = scanned.start(*command)
        scanned.await_calls(process, "camera.read", n_before + n_more)
        process.kill()
        process.communicate()
        command = ["resume", str(scanned.run_dir())]
    if labseq.open_run(scanned.run_dir()).status != "complete":
        done = scanned.run(*command)
        assert done.returncode == 0, done.stderr
    run = labseq.open_run(scanned.run_dir())
    assert (run.status, len(run.shots)) == ("complete", N_SHOTS)
    counted = [row["shot"] for row in scanned.index() if row["counts"]]
    assert sorted(counted) == list(range(N_SHOTS))  # none lost, none doubled
    assert table(run) == whole
    for shot in (*run.shots, *run.attempts):
        shot.verify()


def test_a_run_is_stopped_after_its_shot_and_resumed(scanned):
    process = scanned.start("run", "sequence.yaml", "--realtime")
    scanned.await_calls(process, "camera.read", 2)
    stopped = scanned.run("stop", "--wait")
    out, err = process.communicate(timeout=60.0)
    assert (stopped.returncode, process.returncode) == (0, 143), (stopped.stderr, out, err)
    run_dir = scanned.run_dir()
    assert f"labseq resume {run_dir}" in stopped.stdout
    assert "stopped by 'labseq stop'" in err
    run = labseq.open_run(run_dir)
    assert (run.status, run.error) == ("stopped", "stopped by 'labseq stop'")
    assert 0 < len(run.shots) < N_SHOTS
    assert not run.attempts  # the shot at hand came to its end
    assert scanned.calls()[-8:].count("mobile_tweezers.close") == 1
    again = scanned.run("stop")
    assert (again.returncode, again.stderr) == (2, "error: no run is in progress\n")


def test_a_queue_that_is_killed_goes_on_with_the_run_at_hand(scanned):
    for shots in ("6", "1"):
        assert scanned.run("queue", "add", "sequence.yaml", "--shots", shots).returncode == 0
    process = scanned.start("queue", "run")
    scanned.await_calls(process, "camera.read", 5)
    process.kill()
    process.communicate()
    listed = json.loads(scanned.run_apart("queue", "list", "--json").stdout)["entries"]
    assert [entry["state"] for entry in listed] == ["interrupted", "waiting"]
    done = scanned.run("queue", "run")
    assert done.returncode == 0, done.stderr
    runs = [labseq.open_run(path) for path in sorted(scanned.data.glob("*/*/run.json"))]
    assert [(run.status, len(run.shots)) for run in runs] == [("complete", 6), ("complete", 1)]
    assert str(runs[0].path) == listed[0]["run_dir"]
    assert len(runs[0].record["resumed"]) == 1
    assert scanned.run("queue", "list").stdout == "the queue is empty\n"


@pytest.fixture
def small_disk(scanned):
    """A data folder with room for a few shots; needs the right to mount."""
    disk = scanned.folder / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(disk)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("nothing can be mounted here")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_disk_that_fills_up_costs_no_shot(scanned, whole, small_disk):
    scanned.data = small_disk / "data"
    scanned.environment["LABSEQ_DATA"] = str(scanned.data)
    done = scanned.run("run", "sequence.yaml")
    assert done.returncode == 1
    assert "the disk is full" in done.stderr
    run = labseq.open_run(scanned.run_dir())
    assert 0 < len(run.shots) < N_SHOTS
    assert table(run) == whole[: len(run.shots)]
    still_full = scanned.run("resume", str(run.path))
    assert "the disk is full" in still_full.stderr
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    done = scanned.run("resume", str(run.path))
    assert done.returncode == 0, done.stderr
    run = labseq.open_run(run.path)
    assert table(run) == whole
    for shot in run.shots:
        shot.verify()
