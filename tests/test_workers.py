"""Worker processes: what becomes of tasks whose workers die."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from labseq.errors import ConfigError, LabseqError
from labseq.workers import MAX_LOST, ProcessWorkers


def make(folder: Path | None) -> Callable[[int], int]:
    """Tasks of which number 1 ends its first worker, and number 3 each of them."""
    if folder is None:
        raise ConfigError("this worker lacks a plugin")

    def do(number: int) -> int:
        tries = folder / str(number)
        n_before = len(tries.read_text()) if tries.exists() else 0
        tries.write_text("x" * (n_before + 1))
        if number == 3 or (number == 1 and not n_before):
            os._exit(7)
        return number**2

    return do


def finished(workers: ProcessWorkers, n_tasks: int) -> dict[int, int]:
    found = dict[int, int]()
    while len(found) < n_tasks:
        found.update(workers.finished(1.0))
    return found


def test_tasks_of_a_lost_worker_are_done_by_others_and_a_task_that_ends_all_ends_the_work(
    tmp_path: Path,
) -> None:
    with closing(ProcessWorkers(1, "job")) as workers:
        workers.prepare(make, tmp_path)
        for number in range(3):
            workers.submit(number, number)
        assert finished(workers, 3) == {0: 0, 1: 1, 2: 4}
        workers.submit(3, 3)
        with pytest.raises(LabseqError, match=f"{MAX_LOST} worker processes have died of job 3 .exit code 7"):
            finished(workers, 1)
    assert (tmp_path / "3").read_text() == "x" * MAX_LOST


def make_by_its_process(_: None) -> Callable[[int], int]:
    return lambda _: os.getpid()


def test_tasks_are_shared_out_evenly() -> None:
    with closing(ProcessWorkers(2, "job")) as workers:
        workers.prepare(make_by_its_process, None)
        for number in range(6):
            workers.submit(number, number)
        assert sorted(Counter(finished(workers, 6).values()).values()) == [3, 3]


def make_at_the_third_attempt(folder: Path) -> Callable[[int], int]:
    """Two of three workers die of their start; task 1 ends its worker once."""
    n_before = len([*folder.glob("start*")])
    (folder / f"start{n_before}").touch()
    if n_before % 3 < 2:
        os._exit(7)
    return make(folder)


def test_starts_that_fail_count_until_one_succeeds(tmp_path: Path) -> None:
    with closing(ProcessWorkers(1, "job")) as workers:
        workers.prepare(make_at_the_third_attempt, tmp_path)
        workers.submit(1, 1)
        assert finished(workers, 1) == {1: 1}
    assert len([*tmp_path.glob("start*")]) == 6


def test_a_worker_that_cannot_be_prepared_is_an_error_of_its_own_kind() -> None:
    with closing(ProcessWorkers(1, "job")) as workers:
        workers.prepare(make, None)
        workers.submit(0, 0)
        with pytest.raises(ConfigError, match="this worker lacks a plugin"):
            finished(workers, 1)


def make_one_that_finds_no_file(_: None) -> Callable[[int], int]:
    def do(number: int) -> int:
        raise FileNotFoundError(2, "No such file", f"{number}.yaml")

    return do


def test_an_error_of_the_system_in_a_task_is_its_own_and_not_the_death_of_its_worker() -> None:
    with closing(ProcessWorkers(1, "job")) as workers:
        workers.prepare(make_one_that_finds_no_file, None)
        workers.submit(5, 5)
        with pytest.raises(LabseqError, match=r"No such file: .5.yaml"):
            finished(workers, 1)
