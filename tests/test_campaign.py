"""Campaigns: runs at each point, continued after a stop, taken at once; mistakes with their place."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.analysis.campaigns import campaign_picture, combined
from labseq.campaigns.campaign import Campaign, PlannedRun, recorded_runs
from labseq.campaigns.certificates import make_certificates
from labseq.campaigns.running import run_at_once, run_in_turn
from labseq.cli import main
from labseq.cluster import ClusterWorkers
from labseq.data.reader import Run
from labseq.errors import ConfigError, StopRequested
from labseq.recording.run_file import read_state
from labseq.session.session import Session
from labseq.workers import ProcessWorkers
from tests.session.small_runs import OWN_DEVICE, PROFILE, table, write

FILE = """labseq: 1
sequence: no_scan.yaml
axes:
  planner.degree_of_parallelism: [1, 4]
  profile.simulation.loading: [60 %, 80 %]
repeats: 2
seed: 3
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write(tmp_path)
    path = tmp_path / "campaign.yaml"
    path.write_text(FILE, encoding="utf-8")
    return path


def running(n_runs: int) -> Callable[[Any], None]:
    """Runs sessions, and is stopped in the last of them."""
    left = [n_runs]

    def run_session(opening: Callable[[Any], Session]) -> None:
        with opening(None) as session:
            left[0] -= 1
            if not left[0]:
                session.stop_flag.request()
            session.run()

    return run_session


def test_a_campaign_that_is_stopped_goes_on_and_its_results_are_combined(file: Path) -> None:
    campaign, folder = Campaign.read(file), file.parent / "out"
    with pytest.raises(StopRequested):
        run_in_turn(running(2), campaign, folder)
    half = combined(*recorded_runs(folder))
    assert half["n_shots"].values.tolist() == [[2, 0], [0, 0]]
    assert np.isfinite(half["filling"].values).tolist() == [[True, False], [False, False]]
    assert "0.8" in str(half["profile.simulation.loading"].values)  # of points without a run, too
    assert "1 of 4 points are complete" in campaign_picture(folder).note
    run_in_turn(running(9), campaign, folder)
    runs = all_runs(folder)
    assert [run.status for run in runs] == ["complete"] * 4
    assert len([*folder.glob("*/*/run.json")]) == 4
    file.unlink()  # the folder has a copy
    results = combined(*recorded_runs(folder))
    assert dict(results.sizes) == {
        "planner.degree_of_parallelism": 2,
        "profile.simulation.loading": 2,
        "repeat": 2,
    }
    assert results["profile.simulation.loading"].values.tolist() == [0.6, 0.8]
    point = results.sel({"planner.degree_of_parallelism": 4, "profile.simulation.loading": 0.6})
    [expected] = [
        run
        for run in runs
        if (run.changes["planner.degree_of_parallelism"], run.changes["profile.simulation.loading"])
        == ("4", "60 %")
    ]
    assert point["n_batches"].values.tolist() == [shot.row.n_batches for shot in expected.shots]
    assert float(point["filling"]) == expected.quantity("filling").over(expected.shots).value
    assert len(campaign_picture(folder).rows) == 2
    file.write_text(FILE.replace("seed: 3", "seed: 4"), encoding="utf-8")
    with pytest.raises(ConfigError, match="this run belongs to no point of the campaign"):
        run_in_turn(running(9), Campaign.read(file), folder)


def all_runs(folder: Path) -> list[Run]:
    """The runs of a campaign, in the order of its points."""
    return [run for runs in recorded_runs(folder)[1].values() for run in runs]


class Killing(ProcessWorkers):
    """Kills a worker as soon as a run has begun."""

    folder = Path()
    n_kills = 0

    def finished(self, timeout_s: float) -> list[tuple[int, Any]]:
        found = super().finished(timeout_s)
        n_begun = len([*self.folder.glob("*/*/index.jsonl")])  # not of one killed while it made its folder
        if self.n_kills < min(2, n_begun):
            multiprocessing.active_children()[0].kill()
            self.n_kills += 1
        return found


SPLIT = FILE.replace("repeats: 2", "repeats: 5\nruns: 2").replace("[60 %, 80 %]", "[60 %]")


def test_runs_at_once_of_which_some_die_are_those_in_turn(file: Path) -> None:
    file.write_text(SPLIT, encoding="utf-8")
    campaign, folder, reported = Campaign.read(file), file.parent / "at once", list[tuple[PlannedRun, Run]]()
    workers = Killing(2, "run")
    workers.folder = folder
    run_at_once(campaign, folder, workers, lambda planned, run: reported.append((planned, run)))
    assert workers.n_kills == 2
    assert not multiprocessing.active_children()
    run_in_turn(running(9), campaign, file.parent / "in turn")
    runs, expected = all_runs(folder), all_runs(file.parent / "in turn")
    assert [table(run) for run in runs] == [table(run) for run in expected]
    assert [len(run.shots) for run in runs] == [3, 2, 3, 2]
    assert len({run.seed for run in runs}) == 2, (
        "the runs of a point are independent, and compared with those"
    )
    assert [run.seed for run in runs[:2]] == [run.seed for run in runs[2:]]
    # not by their folders: a run that was killed between its last shot and its report is taken again
    assert sorted(str(table(run)) for _, run in reported) == sorted(str(table(run)) for run in runs)
    results = combined(*recorded_runs(folder))
    assert results["n_shots"].values.tolist() == [[5], [5]]
    assert results["filling_fraction"].values[0, 0].tolist() == [
        shot.filling_fraction for run in expected[:2] for shot in run.shots
    ]
    folders = [*folder.glob("*/*")]
    run_at_once(campaign, folder, ProcessWorkers(1, "run"), lambda *_: pytest.fail("all are there"))
    assert [*folder.glob("*/*")] == folders


def test_a_stop_ends_the_runs_at_once_and_they_are_resumed(file: Path) -> None:
    campaign, folder = Campaign.read(file), file.parent / "out"

    class Stopping(ProcessWorkers):
        def finished(self, timeout_s: float) -> list[tuple[int, Any]]:
            if [*folder.glob("*/*/index.jsonl")]:
                raise StopRequested
            return super().finished(timeout_s)

    with pytest.raises(StopRequested):
        run_at_once(campaign, folder, Stopping(2, "run"), lambda *_: None)
    assert not multiprocessing.active_children()
    run_at_once(campaign, folder, ProcessWorkers(2, "run"), lambda *_: None)
    assert [run.status for run in all_runs(folder)] == ["complete"] * 4
    assert len([*folder.glob("*/*/run.json")]) == 4


def test_a_folder_is_used_by_one_command_and_by_runs_of_the_same_files(file: Path) -> None:
    campaign, folder = Campaign.read(file), file.parent / "out"
    with pytest.raises(StopRequested):
        run_in_turn(running(2), campaign, folder)
    sequence = campaign.sequence.read_text(encoding="utf-8")
    campaign.sequence.write_text(f"{sequence}# another text\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="taken with a different sequence or profile file"):
        run_in_turn(running(9), campaign, folder)
    campaign.sequence.write_text(sequence, encoding="utf-8")
    held = []

    def run_session(opening: Callable[[Any], Session]) -> None:
        with pytest.raises(ConfigError, match="this campaign is in progress: labseq campaign run") as refused:
            run_in_turn(running(9), campaign, folder)
        held.append(refused)
        running(9)(opening)

    run_in_turn(run_session, campaign, folder)
    assert len(held) == 3
    assert [run.status for run in all_runs(folder)] == ["complete"] * 4


@pytest.mark.system
def test_workers_compile_what_is_missing_and_end_with_the_first_process(file: Path) -> None:
    folder = file.parent / "out"
    command = [sys.executable, "-m", "labseq", "campaign", "run", str(file), "--output", str(folder)]
    file.write_text(FILE.replace("repeats: 2", "repeats: 100000"), encoding="utf-8")
    with subprocess.Popen([*command, "--workers", "2"]) as process:
        while process.poll() is None and len([*folder.glob("*/*/index.jsonl")]) < 2:
            time.sleep(0.05)
        assert process.poll() is None
        process.kill()
    deadline = time.monotonic() + 60.0
    while any(read_state(one.parent)[0] == "running" for one in folder.glob("*/*/run.json")):
        assert time.monotonic() < deadline, "a worker goes on without the first process"
        time.sleep(0.05)
    assert {read_state(one.parent)[0] for one in folder.glob("*/*/run.json")} == {"stopped"}


def test_real_hardware_is_not_used_by_several_runs_at_once(file: Path) -> None:
    (file.parent / "mine.py").write_text(OWN_DEVICE, encoding="utf-8")
    profile = f"{PROFILE}devices: {{laser: {{use: mine}}}}\nplugin_folders: [.]\n"
    (file.parent / "p.yaml").write_text(profile, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"real hardware .laser.; .*leave out --workers and --scheduler"):
        run_at_once(Campaign.read(file), file.parent / "out", ProcessWorkers(2, "run"), lambda *_: None)
    assert not (file.parent / "out").exists()


def test_a_cluster_takes_the_runs_where_it_sees_the_folder(file: Path) -> None:
    import distributed  # takes 0.7 s, which the processes that run other tests need not spend

    ca, scheduler, worker, _ = map(str, make_certificates(file.parent / "keys"))
    files = {"tls_ca_file": ca, "tls_scheduler_cert": scheduler, "tls_scheduler_key": scheduler}
    files |= {"tls_worker_cert": worker, "tls_worker_key": worker}
    files |= {"tls_client_cert": worker, "tls_client_key": worker}
    about: dict[str, Any] = {"dashboard_address": ":0", "protocol": "tls", "processes": False}
    about["security"] = distributed.Security(require_encryption=True, **files)
    make_cluster: Any = distributed.LocalCluster
    folder, campaign = file.parent / "out", Campaign.read(file)
    with make_cluster(n_workers=1, threads_per_worker=2, **about) as cluster:

        def workers() -> ClusterWorkers:
            return ClusterWorkers(cluster.scheduler_address, file.parent / "keys", "run")

        run_at_once(campaign, folder, workers(), lambda *_: None)
        elsewhere = file.parent / "elsewhere"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("labseq.campaigns.running._copy_file", lambda *_, **__: None)
            with pytest.raises(ConfigError, match=r"the worker on .* does not see this folder"):
                run_at_once(campaign, elsewhere, workers(), lambda *_: None)
    assert [run.status for run in all_runs(folder)] == ["complete"] * 4


NO_ATOMS = """labseq: 1
sequence: loading.yaml
axes:
  profile.simulation.loading: [0 %, 80 %]
  profile.alarms.stop_after: [2]
repeats: REPEATS
seed: 3
"""
LOADING = """labseq: 1
name: loading
profile: ./p.yaml
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
"""


@pytest.mark.parametrize(("repeats", "status"), [(4, "failed"), (6, "complete")])
def test_an_alarm_ends_its_run_and_not_the_campaign(
    file: Path, capsys: pytest.CaptureFixture[str], repeats: int, status: str
) -> None:
    """The alarm begins with the third shot: only then 100 sites have been looked at."""
    (file.parent / "loading.yaml").write_text(LOADING, encoding="utf-8")
    file.write_text(NO_ATOMS.replace("REPEATS", str(repeats)), encoding="utf-8")
    folder = file.parent / "out"
    command = ["campaign", "run", str(file), "--output", str(folder)]
    assert left_with(*command) == 3
    out, err = capsys.readouterr()
    table = [line.split() for line in out.splitlines()[-4:-1]]
    assert table[0][2:] == ["shots", "loading", "runs"]
    assert [row[3:5] for row in table[1:]] == [["4", "0"], [str(repeats), table[2][4]]]
    assert "alarm 'atoms' in 2 shots in a row" in err
    assert "; alarms ended 1 of 2 runs" in err
    # one that has all its shots is over; the shots that are left are taken now
    assert left_with(*command) == 0
    dark = all_runs(folder)[0]
    assert (dark.status, len(dark.shots)) == (status, repeats)
    assert "alarm 'atoms'" in str([dark.error, dark.record["resumed"]])
    if status == "failed":
        with pytest.raises(
            ConfigError, match=r"no shot is missing, and its failure stays on record: .*'atoms'"
        ):
            Session.resume(dark.path)


def left_with(*arguments: str) -> Any:
    """The exit code of a command."""
    with pytest.raises(SystemExit) as left:
        main(arguments)
    return left.value.code or 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{FILE}runs: 3\n", r"campaign.yaml:8:7: 3 runs cannot share 2 shots"),
        (FILE.replace("seed: 3", "runs: 2"), r"campaign.yaml:7:7: 'seed' is missing"),
        ("labseq: 1\nsequence: x\nrepeat: 2\naxes: {a: [1]}\n", r"campaign.yaml:3:1: .*'repeat'.*'repeats'"),
        ("labseq: 1\nsequence: x\naxes: {a: [1, 1]}\n", r"campaign.yaml:3:11: a value occurs twice"),
        ("labseq: 1\nsequence: compakt_225\n", r"campaign.yaml:2:11: there is no sequence 'compakt_225'"),
        ("labseq: 1\nsequence: x.yaml\n", r"campaign.yaml:2:11: there is no such file"),
        (f"{FILE}profile: nothere\n", r"campaign.yaml:8:10: there is no hardware profile 'nothere'"),
        (FILE.replace("[1, 4]", "[1, 0]"), r"campaign.yaml:4:38: degree_of_parallelism is 0"),
    ],
)
def test_mistakes_have_their_place(file: Path, text: str, message: str) -> None:
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        run_in_turn(running(9), Campaign.read(file), file.parent / "out")


def test_a_folder_without_a_campaign_and_what_a_campaign_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, message = str(tmp_path), "or a campaign's folder, which has a campaign.yaml"
    assert refusal(capsys, "export", folder) == refusal(capsys, "plot", folder)
    assert message in refusal(capsys, "export", folder)
    (tmp_path / "campaign.yaml").write_text(FILE, encoding="utf-8")
    assert "cannot be exported as 'csv'; expected netcdf" in refusal(capsys, "export", folder, "--to", "csv")
    assert "these options are for a single run" in refusal(capsys, "plot", folder, "--shot", "1")
    assert "the campaign has no runs yet" in refusal(capsys, "plot", folder)


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What a command that the user got wrong prints."""
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 2
    return capsys.readouterr().err
