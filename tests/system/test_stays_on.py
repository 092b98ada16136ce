"""A lamp goes off whatever happens to the run that has turned it on, or to the server of its device."""

from __future__ import annotations

import signal
import sys
from collections.abc import Generator

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


def test_a_served_device_whose_safe_state_fails_is_switched_off_and_stays_known(lab: Lamps) -> None:
    with lab.served() as server:
        with lab.run("--profile", "far.yaml") as run:
            (lab.folder / "refuses").touch()
            run.send_signal(signal.SIGINT)
            run.wait(60.0)
            until(lambda: not lab.is_on)
        assert "NOT SAFE" in lab.output
        server.send_signal(signal.SIGINT)
        server.wait(60.0)
    (lab.folder / "refuses").unlink()
    assert lab.start("devices", "lamps.yaml").wait(60.0) == 0
    assert "died; 'labseq safe lamps.yaml' makes all of them safe" in " ".join(lab.output.split())
    for command in (["safe", "lamps.yaml"], ["devices", "lamps.yaml"]):
        begin = len(lab.output)
        assert lab.start(*command).wait(60.0) == 0
    assert "died" not in lab.output[begin:]
