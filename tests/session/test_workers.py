"""Runs whose shots are taken by workers: the same data as from one process, whatever happens to them."""

from __future__ import annotations

import json
import multiprocessing
import pickle
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pytest

import labseq
from labseq.campaign import make_keys
from labseq.cluster import ClusterWorkers
from labseq.errors import ConfigError, DeviceError
from labseq.session.options import Options
from labseq.session.workers import Recipe, ShotWorker, TakenShot
from labseq.testing.fakes import RecordingObserver
from labseq.workers import ProcessWorkers

from . import test_policies
from .small_runs import OWN_DEVICE, PROFILE, interrupted, resumed, table, write

TIMES = {"t_start_utc", "t_end_utc", "stage_s", "sha256", "bytes"}
"""Entries of the index that depend on the time, or on files that contain times."""


class Killing(RecordingObserver):
    """Kills a worker after each of the first shots."""

    n_kills = 0

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        super().event(name, values)
        workers = multiprocessing.active_children()
        if name == "shot_finished" and self.n_kills < 2 and workers:
            workers[-1].kill()  # the other one may be gone already
            self.n_kills += 1


def index(run: labseq.Run) -> list[dict[str, Any]]:
    lines = (run.path / "index.jsonl").read_text(encoding="utf-8").splitlines()
    return [{key: value for key, value in json.loads(line).items() if key not in TIMES} for line in lines]


def alone(sequence: Path) -> labseq.Run:
    with labseq.Session.open(sequence, seed=5, output=sequence.parent / "alone") as session:
        return session.run()


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    """The scan of the planner, from one process."""
    return alone(write(tmp_path_factory.mktemp("scanned"), "planner"))


class Counting(ProcessWorkers):
    """Counts the tasks that have been given to workers and are not done."""

    out: ClassVar[list[int]] = []

    def submit(self, task: int, argument: Any) -> None:
        super().submit(task, argument)
        self.out.append(sum(self.out[-1:]) + 1)

    def finished(self, timeout_s: float) -> list[tuple[int, Any]]:
        done = super().finished(timeout_s)
        self.out.append(sum(self.out[-1:]) - len(done))
        return done


def test_a_scan_that_is_stopped_and_resumed_while_workers_are_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scanned: labseq.Run
) -> None:
    monkeypatch.setattr("labseq.session.workers.ProcessWorkers", Counting)
    monkeypatch.setattr(Counting, "out", [])
    sequence, observer = write(tmp_path, "planner"), Killing()
    run_dir = interrupted(sequence, "shot_finished", 2, workers=2)
    assert len(labseq.open_run(run_dir).shots) == 2
    assert max(Counting.out) >= 4, "a worker that ends a shot has to wait for the next"
    run, expected = resumed(run_dir, observer, workers=2), scanned
    assert observer.n_kills == 2
    assert table(run) == table(expected)
    assert index(run) == index(expected)
    names = [sorted(path.name for path in (one.path / "shots").iterdir()) for one in (run, expected)]
    assert names[0] == names[1]
    assert not multiprocessing.active_children()


def test_an_adaptive_scan_chooses_the_same_points(tmp_path: Path) -> None:
    sequence, observer = write(tmp_path, "adaptive"), RecordingObserver()
    with labseq.Session.open(
        sequence, seed=5, output=tmp_path / "data", workers=2, observer=observer
    ) as session:
        run = session.run()
    assert index(run) == index(alone(sequence))
    shots = [values["shot"] for values in observer.of("shot_started")]
    assert shots == sorted(shots) == list(range(len(run.shots)))
    assert observer.of("image")[0]["image"].frame is None


@pytest.mark.parametrize(
    ("profile", "options", "message"),
    [
        (
            f"{PROFILE}devices: {{laser: {{use: mine}}}}\n",
            {},
            r"has real hardware \(laser\).*--dry-run",
        ),
        (PROFILE, {"realtime": True}, "at the speed of real time; leave out --realtime"),
        (PROFILE, {"workers": 0}, "workers is 0; expected 1 or more"),
    ],
)
def test_runs_that_only_one_process_can_take(
    tmp_path: Path, profile: str, options: dict[str, Any], message: str
) -> None:
    (tmp_path / "mine.py").write_text(OWN_DEVICE, encoding="utf-8")
    sequence = write(tmp_path)
    (tmp_path / "p.yaml").write_text(f"{profile}plugin_folders: [.]\n", encoding="utf-8")
    options = {"workers": 2, **options}
    with (
        labseq.Session.open(sequence, output=tmp_path / "data", **options) as session,
        pytest.raises(ConfigError, match=message),
    ):
        session.run()
    assert not (tmp_path / "data").exists()


def test_a_worker_with_other_code_takes_no_shot(tmp_path: Path) -> None:
    observer = RecordingObserver()
    with labseq.Session.open(
        write(tmp_path), shots=1, output=tmp_path / "data", observer=observer
    ) as session:
        session.run()
    record = observer.of("run_started")[0]["record"]
    plugins = tuple({**one, "version": "0.0"} if one["name"] == "psca" else one for one in record.plugins)
    other = replace(record, provenance={**record.provenance, "labseq": "0.0"}, plugins=plugins)
    with pytest.raises(ConfigError, match=r"a worker on .* would take other shots: labseq was 0.0"):
        ShotWorker(Recipe(other, "x", Options(shots=1), "", "", keeps_frames=False))


def test_a_cluster_takes_the_same_shots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scanned: labseq.Run
) -> None:
    import distributed  # takes 0.7 s, which the processes that run other tests need not spend

    sequence, keys = write(tmp_path, "planner"), tmp_path / "keys"
    ca, scheduler, worker, _ = map(str, make_keys(keys))
    files = {"tls_ca_file": ca, "tls_scheduler_cert": scheduler, "tls_scheduler_key": scheduler}
    files |= {"tls_worker_cert": worker, "tls_worker_key": worker}
    files |= {"tls_client_cert": worker, "tls_client_key": worker}
    about: dict[str, Any] = {"dashboard_address": ":0", "protocol": "tls", "processes": False}
    about["security"] = distributed.Security(require_encryption=True, **files)
    make_cluster: Any = distributed.LocalCluster
    with make_cluster(n_workers=1, threads_per_worker=2, **about) as cluster:
        options: dict[str, Any] = {"scheduler": cluster.scheduler_address, "keys": keys}
        options["output"] = tmp_path / "data"
        runs = list[labseq.Run]()
        for _ in range(2):
            with labseq.Session.open(sequence, seed=5, **options) as session:
                runs.append(session.run())
            # now as on another computer, which does not see the run's folder
            monkeypatch.setattr("labseq.session.workers.write_file", lambda *_: None)
    for run in runs:
        assert index(run) == index(scanned)
        for shot in run.shots:
            shot.verify()


def test_a_worker_that_an_error_has_ended_takes_none_of_its_other_shots(tmp_path: Path) -> None:
    observer = RecordingObserver()
    with (
        labseq.Session.open(
            test_policies.sequence(tmp_path, step="{at: [1]}"), output=tmp_path / "data", observer=observer
        ) as session,
        pytest.raises(DeviceError, match="went out of lock"),
    ):
        session.run()
    record = observer.of("run_started")[0]["record"]
    worker = ShotWorker(Recipe(record, "x", Options(), "", "", keeps_frames=False))
    taken: list[TakenShot] = [pickle.loads(worker((shot, 0)).finish()) for shot in (1, 2)]
    assert [str(one.error) for one in taken] == ["laser: went out of lock"] * 2
    assert [len(one.events) > 1 for one in taken] == [True, False]


@pytest.mark.parametrize(
    ("address", "keys", "message"),
    [
        ("tcp://10.0.0.1:8786", None, "run code; expected tls"),
        (
            "tls://lab:8786",
            None,
            "needs certificates; 'labseq campaign keys FOLDER' makes them",
        ),
        ("tls://lab:8786", Path("nowhere"), "there is no ca.pem in nowhere"),
        ("lab:8786", None, "this is no address of a scheduler; expected tls://HOST:PORT"),
        ("tcp://127.0.0.1:9", None, "no scheduler answers"),
    ],
)
def test_a_cluster_that_cannot_be_used(
    address: str, keys: Path | None, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("labseq.cluster._ANSWER_S", 0.5)
    with pytest.raises(ConfigError, match=message):
        ClusterWorkers(address, keys, "shot")
