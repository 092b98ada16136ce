"""The profiles of real drivers on simulated devices: `bench_awg` (the AWG alone) and `bench` (all of them).

Atoms move in what the card plays. Long comparisons with the virtual profile: LABSEQ_SHOTS=40.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from labseq import Run, Session
from labseq.cli import main
from labseq.data.shot import Shot

SEQUENCE = Path(__file__).parents[2] / "sequences" / "compact_225.yaml"
N_SHOTS = int(os.environ.get("LABSEQ_SHOTS", "1"))
MOBILE = "profile.mobile_tweezers"
TRIGGER = "awg: {channel: 7, on: [rearrange], pulse: 0.1 ms, triggers: mobile_tweezers}"
TIMING = f"{MOBILE}.overhead_per_cycle=13 ms"  # the same in every mode, so that the atoms wait equally long
TRIGGERED = (TIMING, f"profile.lines={{use: virtual, channels: {{{TRIGGER}}}}}")
STREAM = (TIMING, f"{MOBILE}.mode=stream")

UNEVEN = tuple(
    f"profile.simulation.{value}"
    for value in (
        "machine_seed=20",
        "tone_response=12.5 %",
        "depth_disorder=0 %",
        "mobile_light.tone_response=12 %",
    )
)
"""The uneven tweezers of `bench`."""

RunProfile = Callable[..., Run]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunProfile:
    """Runs a profile, once for equal arguments."""

    @cache
    def run(profile: str, *overrides: str, shots: int = N_SHOTS) -> Run:
        folder = tmp_path_factory.mktemp(profile)
        small = "target.rows=9", "target.cols=9"  # half as many batches, and so samples to look for tones in
        overrides = (*overrides, *small, "shot.2.rearrange.cycles=1", "planner.degree_of_parallelism=15")
        if profile != "virtual":  # half as many samples to look for tones in
            overrides = (*overrides, f"{MOBILE}.sample_rate=312 MHz")
        with Session.open(
            SEQUENCE, profile=profile, shots=shots, seed=1, output=folder, overrides=overrides
        ) as session:
            return session.run()

    return run


def filled_once(shot: Shot, done: Run) -> float:
    """Filling after the first cycle."""
    first = next(i for i, image in enumerate(shot.record().images) if image.cycle == 0)
    return done.target.filling_fraction(shot.occupancies[first])


@pytest.mark.parametrize("overrides", [TRIGGERED, STREAM], ids=["sequence", "stream"])
def test_filling_agrees_with_the_virtual_profile(run: RunProfile, overrides: tuple[str, ...]) -> None:
    played = run("bench_awg", *overrides)
    virtual = run("virtual", shots=5 * N_SHOTS)
    assert virtual.shots[0].atom_events == {}
    found, expected = (np.array([filled_once(s, done) for s in done.shots]) for done in (played, virtual))
    error = float(expected.std()) * math.sqrt(1 / len(found) + 1 / len(expected))
    print(f"{found.mean():.4f}, virtual {expected.mean():.4f}, error of the difference {error:.4f}")
    assert abs(found.mean() - expected.mean()) < 4 * error
    for shot in played.shots:
        flights = shot.atom_events["flights"]
        held = flights[~np.isnan(flights["held_s"])]
        assert len(held) > 30
        assert np.isin(held["fate"], [b"transport", b"collision"]).sum() < 0.02 * len(held)
        assert held["offset_m"].max() < 5e-9
        assert len(shot.atom_events["jumps"]) == 0


def compare_images(shot: Shot, other: Shot) -> None:
    np.testing.assert_array_equal(shot.frames, other.frames)
    np.testing.assert_array_equal(shot.occupancies, other.occupancies)


def compare_flights(shot: Shot, other: Shot, but: tuple[str, ...] = ()) -> None:
    flights, others = shot.atom_events["flights"], other.atom_events["flights"]
    for column in set(flights.dtype.names or ()) - {*but}:
        if flights[column].dtype.kind == "f":
            np.testing.assert_allclose(flights[column], others[column], rtol=1e-4, atol=1e-12)
        else:
            np.testing.assert_array_equal(flights[column], others[column])


@pytest.mark.parametrize("mode", ["sequence", "fifo"])
def test_other_modes_move_atoms_as_replay_does(run: RunProfile, mode: str) -> None:
    played, replayed = (
        run("bench_awg", TIMING, f"{MOBILE}.mode={one}", shots=1).shots[0] for one in (mode, "replay")
    )
    compare_flights(played, replayed, but=("held_s", "lost_s"))
    if mode == "fifo":  # sequence starts 0.1 ms later, so that losses are drawn otherwise
        compare_images(played, replayed)


@pytest.mark.needs("libaravis")
def test_a_run_through_every_driver_is_the_one_through_virtual_devices(run: RunProfile) -> None:
    bench = run("bench", shots=1)
    expected = run("bench_awg", *TRIGGERED, *UNEVEN)
    assert bench.simulated
    compare_images(bench.shots[0], expected.shots[0])
    compare_flights(bench.shots[0], expected.shots[0])  # depths follow what the radio sent


@pytest.mark.needs("libaravis")
def test_every_device_of_the_bench_profile_passes_its_self_test(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["devices", "bench", "--json"])
    devices = {device["name"]: device for device in json.loads(capfd.readouterr().out)["devices"]}
    assert devices["camera"]["serial_number"] == "SIM1"
    assert all(device["ok"] for device in devices.values())
