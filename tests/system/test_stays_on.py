"""A lamp goes off whatever happens to the run that has turned it on, or to the server of its device."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Generator
from pathlib import Path

import pytest

from tests.system import lamps
from tests.system.lamps import Lamps, until

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(sys.platform != "linux", reason="ends processes the POSIX way, and looks into /proc"),
]


@pytest.fixture
def lab() -> Generator[Lamps]:
    with lamps.lamps() as one:
        yield one


@pytest.mark.parametrize(
    "cause",
    [
        "the disk hangs",
        "the disk hangs, Ctrl-C twice",
        "no memory",
        "watchdog replaced after SIGKILL, then the run",
        "watchdog replaced after SIGSTOP, then the run",
    ],
)
def test_the_lamp_goes_off(lab: Lamps, cause: str) -> None:
    with lab.run() as run:
        lab.off_after_s(lamps.CAUSES[cause](lab, run), 60.0)


def test_a_slow_disk_is_no_failure(lab: Lamps) -> None:
    """Each time that a shot is flushed to the disk takes 2 s; there are three."""
    with lab.run() as run:
        watchdog = lab.watchdog
        lab.fault("slow")
        n_before = lab.n_shots
        until(lambda: lab.n_shots > n_before or run.poll() is not None)
        (lab.folder / "fault").unlink()
        assert lab.is_on
        assert lab.interrupt(run) == 130
    assert lab.watchdog == watchdog
    assert not list(lab.folder.glob("data/*/*/watchdog.jsonl"))


def test_a_run_whose_watchdog_cannot_be_replaced_ends_safely(lab: Lamps) -> None:
    with lab.run() as run:
        (lab.folder / "no watchdog").touch()
        os.kill(lab.watchdog, signal.SIGKILL)
        assert run.wait(60.0) == 3
        assert not lab.is_on
    assert "watchdog: no watchdog is left" in lab.output


def test_a_served_device_whose_safe_state_fails_is_switched_off_and_stays_known(lab: Lamps) -> None:
    with lab.served() as server:
        with lab.run("--profile", "far.yaml") as run:
            (lab.folder / "refuses").touch()
            lab.interrupt(run)
            until(lambda: not lab.is_on)
        assert "NOT SAFE" in lab.output
        lab.interrupt(server)
    (lab.folder / "refuses").unlink()
    assert lab.start("devices", "lamps.yaml").wait(60.0) == 0
    assert "died; 'labseq safe lamps.yaml' makes all of them safe" in " ".join(lab.output.split())
    for command in (["safe", "lamps.yaml"], ["devices", "lamps.yaml"]):
        begin = len(lab.output)
        assert lab.start(*command).wait(60.0) == 0
    assert "died" not in lab.output[begin:]


def test_a_server_that_holds_the_port_of_a_device_that_is_not_safe_is_ended(lab: Lamps) -> None:
    lab.environment["LAMPS_HOLDS_PORT"] = "yes"
    with lab.served() as server:
        with lab.run("--profile", "far.yaml") as run:
            (lab.folder / "refuses").touch()
            lab.interrupt(run)
            until(lambda: not lab.is_on)
        assert server.wait(60.0) < 0, lab.output  # ended by a signal


def test_safe_ends_the_run_that_holds_the_port_of_a_device(lab: Lamps) -> None:
    lab.environment["LAMPS_HOLDS_PORT"] = "yes"
    with lab.run() as run:
        code, said = lab.in_terminal("n\n", "safe", "lamps.yaml")
        assert (code, lab.is_on) == (3, True)
        assert "[Y/n]" in said
        assert "'labseq safe lamps.yaml --end' ends that process first" in " ".join(said.split())
        assert lab.start("safe", "lamps.yaml").wait(60.0) == 0, lab.output
        assert not lab.is_on
        assert run.wait(60.0) == 143


def test_connections_without_a_key_keep_neither_a_server_nor_its_devices_from_their_work(
    lab: Lamps, tmp_path: Path
) -> None:
    lab.make_keys(tmp_path)
    with (
        lab.served(keys=True, n_files=300) as server,
        lab.run("--profile", "far.yaml") as run,
        lab.strangers(1000),
    ):
        n_before = lab.n_shots
        until(lambda: lab.n_shots > n_before + 5 or run.poll() is not None)
        assert run.poll() is None, lab.output
        assert lab.interrupt(server) == 0, lab.output
        until(lambda: not lab.is_on)
