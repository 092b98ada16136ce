"""The simulated world: loading, losses, time."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from labseq_virtual.tweezers import SILENCE

from labseq import (
    Context,
    DepthRamp,
    DeviceError,
    LimitError,
    RandomStream,
    SiteGrid,
    ToneProgram,
)
from labseq.model import AxisTones
from labseq.roles import offers

GRID = SiteGrid(20, 20)
TINY_IMAGE = {"frame": (2, 2), "background": 0.0}


def new_world(seed: int = 0, *, on: bool = True, **physics: Any) -> VirtualSimulation:
    """A world without losses but those that are asked for, in its first shot, with small frames."""
    calm = {"lifetime": 2e6, "imaging_loss": 0.0, "transport_loss": 0.0, "image": TINY_IMAGE}
    random = RandomStream(seed)
    world = VirtualSimulation(
        SimulationSettings.model_validate(calm | physics), Context("simulation", GRID, random=random)
    )
    world.open()
    if on:
        world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    random.begin_shot(0, 0)
    world.begin_shot()
    return world


def n_atoms(world: VirtualSimulation) -> int:
    return int(world.truth().sum())


def within_four_sigma(count: int, n: int, p: float) -> bool:
    return abs(count - n * p) <= 4 * np.sqrt(n * p * (1 - p))


def carry_row_0(n_sites: int = 1, moves_s: float = 1e-3) -> ToneProgram:
    """Take the atom at (0, 0) along row 0 to column ``n_sites``: pick-up, transport, drop-off."""
    hz = GRID.column_frequency_hz
    places, ramp = hz[[0, 0, n_sites, n_sites]], np.array([0.0, 0.1, 0.1, 0.0])
    offsets, phase = np.arange(4, dtype=np.int32), np.zeros(3)
    still, on = np.full(3, GRID.row_frequency_hz[0]), np.full(3, 0.1)
    return ToneProgram(
        AxisTones(offsets, still, still, on, on, phase),
        AxisTones(offsets, places[:3], places[1:], ramp[:3], ramp[1:], phase),
        np.array([60e-6, moves_s, 60e-6]),
        np.zeros(3, np.int8),
        np.zeros(3, np.int32),
    )


@pytest.mark.parametrize(
    ("duration_s", "filling"), [(0.5, 0.75), (0.05, 0.75 * (1 - np.exp(-1))), (0.0, 0.0)]
)
def test_loading_saturates(duration_s: float, filling: float) -> None:
    loaded = 0
    world = new_world()
    for _ in range(25):
        world.begin_shot()
        world.load(1.0, duration_s)
        loaded += n_atoms(world)
    assert within_four_sigma(loaded, 25 * 400, filling)


def test_loading_twice_is_loading_once() -> None:
    world = new_world(loading=0.5)
    for k in range(25):
        world.load(float(k), 0.5)
        assert within_four_sigma(n_atoms(world), 400, 0.5)


def test_no_light_no_atoms() -> None:
    world = new_world(on=False)
    world.load(1.0, 0.5)
    assert n_atoms(world) == 0


def test_a_shot_begins_empty() -> None:
    world = new_world(loading=1.0)
    world.load(1.0, 0.5)
    world.begin_shot()
    assert n_atoms(world) == 0


@pytest.mark.parametrize(("depth", "kept"), [(0.0, 0), (0.05, 0), (0.5, 400)])
def test_a_ramp_too_low_loses_the_atoms_for_good(depth: float, kept: int) -> None:
    world = new_world(loading=1.0)
    world.load(1.0, 0.5)
    assert n_atoms(world) == 400
    world.play("static_tweezers", DepthRamp(1.0, depth, 0.01), 2.0)
    world.play("static_tweezers", DepthRamp(depth, 1.0, 0.01), 2.1)
    assert n_atoms(world) == kept


def test_the_weakest_tweezers_lose_their_atoms_first() -> None:
    world = new_world(loading=1.0, depth_disorder=0.04, lost_below_depth=0.1)
    world.load(1.0, 0.5)
    world.play("static_tweezers", DepthRamp(1.0, 0.1), 2.0)
    assert within_four_sigma(n_atoms(world), 400, 0.5)


def test_the_machine_is_the_same_in_every_shot_and_another_for_another_seed() -> None:
    def held_at_the_edge(seed: int, shot: int) -> bytes:
        random = RandomStream(seed)
        world = VirtualSimulation(SimulationSettings(loading=1.0), Context("simulation", GRID, random=random))
        world.open()
        world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
        random.begin_shot(shot, 0)
        world.begin_shot()
        world.load(1.0, 60.0)
        world.play("static_tweezers", DepthRamp(1.0, 0.1), 61.0)
        return world.truth().tobytes()

    assert held_at_the_edge(1, 0) == held_at_the_edge(1, 5)
    assert held_at_the_edge(1, 0) != held_at_the_edge(2, 0)


def test_the_lifetime_acts_between_events_whatever_their_number() -> None:
    survived, total = 0, 0
    for seed in range(10):
        world = new_world(seed, lifetime=33.0)
        world.load(0.0, 0.5)
        total += n_atoms(world)
        for t_s in (5.0, 12.0, 17.0, 33.5):
            world.play("static_tweezers", DepthRamp(1.0, 1.0), t_s)
        survived += n_atoms(world)
    assert within_four_sigma(survived, total, np.exp(-1))


@pytest.mark.parametrize("exposure_s", [45e-3, 90e-3])
def test_an_exposure_loses_what_the_paper_says(exposure_s: float) -> None:
    survived, total = 0, 0
    for seed in range(20):
        world = new_world(seed, imaging_loss=0.1, lifetime=1.0)
        world.load(0.0, 0.5)
        total += n_atoms(world)
        world.expose(0.5, exposure_s)
        survived += n_atoms(world)
    n_exposures = exposure_s / 45e-3
    assert within_four_sigma(survived, total, (0.9 * np.exp(-45e-3)) ** n_exposures)


def test_the_papers_survival_of_one_image() -> None:
    defaults = SimulationSettings()
    survival = (1 - defaults.imaging_loss) * np.exp(-45e-3 / defaults.lifetime)
    assert survival == pytest.approx(0.9955, abs=1e-5)


def test_a_program_carries_atoms_and_takes_its_time() -> None:
    world = new_world(loading=1.0)
    world.load(0.0, 0.5)
    before = world.truth()
    world.play("mobile_tweezers", carry_row_0(20 - 1), 1.0)
    after = world.truth()
    assert before.all()
    assert not after[0].all()
    with pytest.raises(DeviceError, match=r"lasts until 1\.001120 s"):
        world.expose(1.0005, 45e-3)
    world.expose(1.00112, 45e-3)


def test_the_transport_loss_spreads_from_shot_to_shot_and_keeps_its_mean() -> None:
    factors: list[float] = []
    world = new_world(transport_loss_spread=0.5)
    for _ in range(4000):
        world.begin_shot()
        factors.append(world._loss_factor)
    assert np.mean(factors) == pytest.approx(1.0, abs=4 * 0.53 / np.sqrt(4000))
    assert np.std(np.log(factors)) == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("t_cut_s", [1.00003, 1.0005, 1.00107])
def test_silence_cuts_a_program_short_and_atoms_in_flight_are_lost(t_cut_s: float) -> None:
    world = new_world(loading=1.0)
    world.load(0.0, 0.5)
    for col in range(1, 20):
        world._occupied[0, col] = False
    world.play("mobile_tweezers", carry_row_0(19), 1.0)
    world.play("mobile_tweezers", SILENCE, t_cut_s)
    truth = world.truth()
    assert truth[1:].all()
    caught = t_cut_s > 1.00006
    assert truth[0].sum() == (0 if caught else 1)
    assert truth[0, 0] == (not caught)
    world.expose(t_cut_s, 45e-3)


def test_safety_is_never_refused_however_far_the_world_is() -> None:
    world = new_world(loading=1.0)
    world.load(0.0, 0.5)
    world.expose(1.0, 45e-3)
    world.play("mobile_tweezers", SILENCE, 1.01)
    world.play("static_tweezers", DepthRamp(1.0, 0.0), 1.01)
    assert n_atoms(world) == 0


def test_a_ramp_during_a_program_acts_at_its_end() -> None:
    world = new_world(loading=1.0)
    world.load(0.0, 0.5)
    world.play("mobile_tweezers", carry_row_0(), 1.0)
    world.play("static_tweezers", DepthRamp(1.0, 0.0), 1.0005)
    assert n_atoms(world) == 0


def test_events_in_the_past_are_refused() -> None:
    world = new_world()
    world.load(1.0, 0.5)
    with pytest.raises(DeviceError, match=r"an exposure at 1\.400000 s.*lasts until 1\.500000 s"):
        world.expose(1.4, 45e-3)
    with pytest.raises(DeviceError, match="loading at"):
        world.load(1.0, 0.5)
    with pytest.raises(DeviceError, match="a program of the mobile tweezers at"):
        world.play("mobile_tweezers", carry_row_0(), 1.0)
    world.expose(1.5, 45e-3)


def test_a_new_program_takes_the_place_of_one_that_plays() -> None:
    world = new_world(loading=1.0)
    world.load(0.0, 0.5)
    world.play("mobile_tweezers", carry_row_0(), 1.0)
    world.play("mobile_tweezers", carry_row_0(), 1.0005)
    assert not world.truth()[0, 0]


@pytest.mark.parametrize("role", ["camera", "static_tweezers"])
def test_a_role_that_cannot_play_tones_is_named(role: str) -> None:
    with pytest.raises(DeviceError, match=f"'{role}' played a ToneProgram"):
        new_world().play(role, SILENCE, 0.0)


def test_a_world_that_is_not_open_says_so() -> None:
    world = VirtualSimulation(SimulationSettings(), Context("simulation"))
    with pytest.raises(DeviceError, match="not open"):
        world.begin_shot()
    world.close()
    with pytest.raises(DeviceError, match="not open"):
        world.expose(0.0, 1.0)


@pytest.mark.parametrize("exposure_s", [0.0, -1.0, float("nan")])
def test_an_exposure_takes_time(exposure_s: float) -> None:
    with pytest.raises(LimitError, match="exposure"):
        new_world().expose(0.0, exposure_s)


def test_the_same_seed_gives_the_same_shot_whatever_came_before() -> None:
    def shot(seed: int, indices: list[tuple[int, int]]) -> tuple[bytes, bytes]:
        random = RandomStream(seed)
        world = VirtualSimulation(SimulationSettings(), Context("simulation", GRID, random=random))
        world.open()
        world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
        frame = world.truth().tobytes(), b""
        for number, (index, attempt) in enumerate(indices):
            random.begin_shot(index, attempt)
            world.begin_shot()
            start_s = 10.0 * number
            world.load(start_s, 0.5)
            world.play("mobile_tweezers", carry_row_0(3), start_s + 1.0)
            image = world.expose(start_s + 2.0, 45e-3).image
            frame = world.truth().tobytes(), image.tobytes()
        return frame

    assert shot(1, [(3, 0)]) == shot(1, [(0, 0), (1, 0), (3, 0)])
    assert shot(1, [(3, 0)]) != shot(1, [(3, 1)])
    assert shot(1, [(3, 0)]) != shot(2, [(3, 0)])


def test_the_world_tells_the_truth_and_keeps_it() -> None:
    world = new_world(loading=1.0)
    assert offers(world, "truth")
    world.load(0.0, 0.5)
    world.truth()[...] = False
    assert n_atoms(world) == 400


def test_the_description_is_ready_for_json() -> None:
    described = json.loads(json.dumps(dict(new_world(seed=7).describe())))
    assert described["seed"] == 7
    assert described["image"]["em_gain"] == 300.0


def test_a_machine_with_a_seed_of_its_own_is_the_same_in_every_run() -> None:
    assert np.array_equal(
        new_world(1, machine_seed=9).spot_powers(), new_world(2, machine_seed=9).spot_powers()
    )
    assert not np.array_equal(new_world(1).spot_powers(), new_world(2).spot_powers())
