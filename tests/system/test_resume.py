"""kill -9 at random moments, then ``labseq resume``: the run ends as if nothing had happened."""

import json
import os
import random
import subprocess

import pytest

import labseq

from .resumable import N_SHOTS, NAMES, check_committed, sequence_of, table as table_of

pytestmark = pytest.mark.system

N_KILLS = int(os.environ.get("LABSEQ_KILLS", "2"))

N_READS = 3 * N_SHOTS
"""Images of a run at least."""


def table(run):
    return table_of(run, (*NAMES, "attempt"))


def write_scan(bench, index):
    text = sequence_of(["scan", "climb"][index], profile="watched")
    (bench.folder / "sequence.yaml").write_text(text, encoding="utf-8")
    bench.environment["GIT_DIR"] = os.devnull  # edits of the code while the tests run are no change here


@pytest.fixture
def scanned(bench):
    write_scan(bench, 0)
    return bench


WHOLE = {}


def whole(bench, index=0):
    """The table of the run that is never interrupted."""
    if index not in WHOLE:
        assert bench.run("run", "sequence.yaml", "--output", "whole").returncode == 0
        (record,) = bench.folder.glob("whole/*/*/run.json")
        WHOLE[index] = table(labseq.open_run(record))
        bench.log.unlink()
    return WHOLE[index]


@pytest.mark.parametrize("trial", range(N_KILLS))
def test_a_run_that_is_killed_and_resumed_is_the_whole_run(bench, trial):
    write_scan(bench, trial % 2)
    expected = whole(bench, trial % 2)
    moments = random.Random(trial)
    command = ["run", "sequence.yaml"]
    for _ in range(moments.randint(1, 2)):
        n_before = bench.calls().count("camera.read")
        n_more = moments.randint(1, max(1, N_READS - n_before - 4))
        process = bench.start(*command)
        bench.await_calls(process, "camera.read", n_before + n_more)
        process.kill()
        process.communicate()
        check_committed(bench.run_dir())
        assert labseq.open_run(bench.run_dir()).status == "failed"
        command = ["resume", str(bench.run_dir())]
    done = bench.run(*command)
    assert done.returncode == 0, done.stderr
    run = labseq.open_run(bench.run_dir())
    assert (run.status, len(run.shots)) == ("complete", N_SHOTS)
    counted = [row["shot"] for row in bench.index() if row["counts"]]
    assert sorted(counted) == list(range(N_SHOTS))  # none lost, none doubled
    assert table(run) == expected
    for shot in (*run.shots, *run.attempts):
        shot.verify()


def test_a_run_is_stopped_after_its_shot(scanned):
    process = scanned.start("run", "sequence.yaml", "--realtime", "--set", "shot.0.load.duration=50 ms")
    scanned.await_calls(process, "camera.read", 2)
    stopped = scanned.run("stop", "--wait")
    out, err = process.communicate(timeout=180.0)
    assert (stopped.returncode, process.returncode) == (0, 143), (stopped.stderr, out, err)
    run_dir = scanned.run_dir()
    assert f"labseq resume {run_dir}" in stopped.stdout
    assert "stopped by 'labseq stop'" in err
    run = labseq.open_run(run_dir)
    assert (run.status, run.error) == ("stopped", "stopped by 'labseq stop'")
    assert 0 < len(run.shots) < N_SHOTS
    assert not run.attempts  # the shot in progress was taken to its end
    assert scanned.calls()[-8:].count("mobile_tweezers.close") == 1
    again = scanned.run("stop")
    assert again.returncode == 2
    assert "no run is in progress" in again.stderr


def test_a_queue_that_is_killed_resumes_its_run(scanned):
    for shots in ("6", "1"):
        assert scanned.run("queue", "add", "sequence.yaml", "--shots", shots).returncode == 0
    process = scanned.start("queue", "run")
    scanned.await_calls(process, "camera.read", 5)
    process.kill()
    process.communicate()
    listed = json.loads(scanned.run("queue", "list", "--json").stdout)["entries"]
    assert [entry["state"] for entry in listed] == ["interrupted", "waiting"]
    done = scanned.run("queue", "run")
    assert done.returncode == 0, done.stderr
    runs = [labseq.open_run(path) for path in sorted(scanned.data.glob("*/*/run.json"))]
    assert [(run.status, len(run.shots)) for run in runs] == [("complete", 6), ("complete", 1)]
    assert str(runs[0].path) == listed[0]["run_dir"]
    assert len(runs[0].record["resumed"]) == 1
    entries = json.loads(scanned.run("queue", "list", "--json").stdout)["entries"]
    assert [entry["state"] for entry in entries] == ["complete", "complete"]


@pytest.fixture
def small_disk(scanned):
    """A data folder with room for some shots; needs the right to mount."""
    disk = scanned.folder / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("nothing can be mounted here")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_disk_that_fills_up_costs_no_shot(scanned, small_disk):
    expected = whole(scanned)
    scanned.data = small_disk / "data"
    scanned.environment["LABSEQ_DATA"] = str(scanned.data)
    done = scanned.run("run", "sequence.yaml")
    assert done.returncode == 1
    assert "the disk is full" in done.stderr
    run = labseq.open_run(scanned.run_dir())
    assert 0 < len(run.shots) < N_SHOTS
    assert table(run) == expected[: len(run.shots)]
    still_full = scanned.run("resume", str(run.path))
    assert "the disk is full" in still_full.stderr
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    done = scanned.run("resume", str(run.path))
    assert done.returncode == 0, done.stderr
    run = labseq.open_run(run.path)
    assert table(run) == expected
    for shot in run.shots:
        shot.verify()
