"""The bench of real drivers: each on its simulated counterpart, all of them in one simulated world."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from labseq_aravis import load_library
from labseq_soapy_sim import build_module
from labseq_ttl_sim.simavr import runner

from labseq import Run, Session
from labseq.cli import main
from tests.plugins.needs import need_library

SEQUENCE = Path(__file__).parents[2] / "sequences" / "compact_225.yaml"


@pytest.fixture(autouse=True, scope="module")
def installed() -> None:
    for load in (load_library, build_module, lambda: runner("lines")):
        need_library(load)


def run(tmp_path: Path, profile: str, shots: int = 2) -> Run:
    with Session.open(SEQUENCE, profile=profile, shots=shots, seed=1, output=tmp_path) as session:
        return session.run()


def test_a_run_through_every_driver_is_the_one_through_virtual_devices(tmp_path: Path) -> None:
    bench, expected = run(tmp_path, "bench"), run(tmp_path, "bench_awg")
    assert bench.simulated
    for shot, other in zip(bench.shots, expected.shots, strict=True):
        np.testing.assert_array_equal(shot.frames, other.frames)
        np.testing.assert_array_equal(shot.occupancies, other.occupancies)
        flights, others = shot.atom_events["flights"], other.atom_events["flights"]
        for column in flights.dtype.names or ():
            if flights[column].dtype.kind == "f":  # depths are measured on what the radio sent
                np.testing.assert_allclose(flights[column], others[column], rtol=1e-4, atol=1e-12)
            else:
                np.testing.assert_array_equal(flights[column], others[column])


def test_every_device_of_the_bench_answers_and_passes_its_self_test(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["devices", "bench", "--json"])
    devices = {device["name"]: device for device in json.loads(capfd.readouterr().out)["devices"]}
    assert devices["camera"]["serial_number"] == "SIM1"
    assert all(device["ok"] for device in devices.values())
