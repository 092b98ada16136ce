"""The world listens: when what was heard acts, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from labseq_virtual.flight import RfTransport
from labseq_virtual.rf_analysis import PulseReceiver
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq import Context, DepthRamp, DeviceError, LimitError, MotionSpec, Plan, RandomStream, SiteGrid
from labseq.motion import tone_program
from labseq.testing.fakes import FakeClock
from labseq.testing.rf import GRID, START_S, PlayedRfSource, played, program_of, spec

CALM = {
    "lifetime": 2e6,
    "imaging_loss": 0.0,
    "transport_loss": 0.0,
    "loading": 1.0,
    "loading_time": 1e-3,
    "image": {"frame": (2, 2)},
}
PROGRAM = program_of(([(5, 2)], [(5, 4)]))


def new_world(clock: FakeClock, motion: MotionSpec | None = None, **physics: Any) -> VirtualSimulation:
    """A world with an atom on each site, the one at the goal of :data:`PROGRAM` too."""
    random = RandomStream(1)
    context = Context("simulation", GRID, motion or spec(), clock, random)
    world = VirtualSimulation(SimulationSettings.model_validate(CALM | physics), context)
    world.open()
    world.play("static_tweezers", DepthRamp(0.0, 1.0), clock.now())
    random.begin_shot(0, 0)
    world.begin_shot()
    world.load(clock.now(), 0.1)
    return world


def after(clock: FakeClock) -> float:
    """Some time after the program's end."""
    clock.sleep(START_S + 1.0 - clock.now())
    return clock.now()


@pytest.fixture
def clock() -> FakeClock:
    clock = FakeClock()
    assert clock.now() < START_S - 0.2
    return clock


def test_what_was_played_acts_before_what_comes_next(clock: FakeClock) -> None:
    world = new_world(clock)
    world.connect_outputs("mobile_tweezers", PlayedRfSource(played(PROGRAM)))
    world.expose(after(clock), 1e-3)
    assert np.argwhere(~world.truth()).tolist() == [[5, 2], [5, 3], [5, 4]]


def test_what_earlier_outputs_played_is_heard_before_others_take_their_place(clock: FakeClock) -> None:
    world = new_world(clock)
    world.connect_outputs("mobile_tweezers", PlayedRfSource(played(PROGRAM)))
    after(clock)
    world.connect_outputs("mobile_tweezers", PlayedRfSource(([], [])))
    assert not world.truth()[5, 2]


@pytest.mark.parametrize("event", ["exposure", "ramp"])
def test_light_that_comes_on_during_something_else_is_an_error(clock: FakeClock, event: str) -> None:
    world = new_world(clock)
    world.connect_outputs("mobile_tweezers", PlayedRfSource(([], [])))
    if event == "exposure":
        world.expose(START_S - 0.1, 0.2)
    else:
        world.play("static_tweezers", DepthRamp(1.0, 0.9, 0.2), START_S - 0.1)
    world.connect_outputs("mobile_tweezers", PlayedRfSource(played(PROGRAM)))
    after(clock)
    with pytest.raises(DeviceError, match=r"were on at 3\.00\d+ s, together with something else; wait"):
        world.truth()


def test_the_light_of_the_last_shot_moves_nothing_in_the_next(clock: FakeClock) -> None:
    world = new_world(clock)
    world.connect_outputs("mobile_tweezers", PlayedRfSource(played(PROGRAM)))
    after(clock)
    world.begin_shot()
    world.load(clock.now(), 0.1)
    assert world.truth()[5, 2]
    assert len(world.atom_events(0.0)["flights"]) == 0


def test_a_site_without_light_is_left_alone(clock: FakeClock) -> None:
    world = new_world(clock, lost_below_depth=0.0)
    world.play("static_tweezers", DepthRamp(1.0, 0.0, 0.1), START_S - 0.5)
    world.connect_outputs("mobile_tweezers", PlayedRfSource(played(PROGRAM)))
    after(clock)
    assert world.truth().any()


@pytest.mark.parametrize(
    ("changes", "transit_s", "text"),
    [
        ({"speed_m_s": 0.3}, 10e-6, r"in a transit_time of 10 us is 0\.67 sites; the limit is 0\.6"),
        ({"speed_profile": "constant_jerk", "speed_m_s": 0.2}, 10e-6, r"0\.89 sites"),
        ({}, 50e-6, r"1\.4 sites"),
        (
            {},
            1e-6,
            r"step of the sites' tones at a transit_time of 1 us is 1\.6 MHz; the limit is at least 2 MHz",
        ),
    ],
)
def test_what_blurs_the_tones_is_refused(
    clock: FakeClock, changes: dict[str, float | str], transit_s: float, text: str
) -> None:
    world = new_world(clock, spec(**changes), mobile_light={"transit_time": transit_s})
    with pytest.raises(LimitError, match=text):
        world.connect_outputs("mobile_tweezers", PlayedRfSource(([], [])))


@pytest.mark.parametrize(
    ("changes", "transit_s"),
    [
        ({"speed_m_s": 0.26}, 10e-6),
        ({"speed_profile": "constant_jerk"}, 10e-6),
        ({}, 1.5e-6),
        ({}, 20e-6),
    ],
)
def test_what_is_just_not_refused_carries_neighbours(
    clock: FakeClock, changes: dict[str, float | str], transit_s: float
) -> None:
    motion = spec(**changes)
    world = new_world(clock, motion, mobile_light={"transit_time": transit_s})
    sources = [(5, c) for c in (1, 2, 3, 16)]
    program = program_of((sources, [(5, 3), (5, 4), (5, 5), (5, 16)]), **changes)
    world.connect_outputs("mobile_tweezers", PlayedRfSource(played(program)))
    after(clock)
    flights = world.atom_events(0.0)["flights"]
    known = {(int(f["from_row"]), int(f["from_col"])): f["fate"] for f in flights}
    # Those at 1 and 2 meet the atoms on 4 and 5, which nobody moves out of their way.
    assert known[5, 16] == b"kept"
    assert len(flights) == 6


def test_a_grid_with_one_site_has_no_tones_to_tell_apart(clock: FakeClock) -> None:
    hz = np.array([100e6])
    grid = SiteGrid(1, 1, row_frequency_hz=hz, column_frequency_hz=hz)
    world = VirtualSimulation(SimulationSettings(), Context("simulation", grid, spec(), clock))
    world.open()
    world.connect_outputs("mobile_tweezers", PlayedRfSource(([], [])))


def test_preassigned_amplitudes_give_the_full_depth(clock: FakeClock) -> None:
    motion = spec()
    amplitudes = tuple(np.linspace(0.02, 0.05, 20).tolist())
    motion = replace(motion, rf=replace(motion.rf, row_amplitudes=amplitudes))
    world = new_world(clock, motion)
    program = tone_program(Plan.from_batches([([(5, 2)], [(9, 2)])]), GRID, motion)
    world.connect_outputs("mobile_tweezers", PlayedRfSource(played(program)))
    after(clock)
    flights = world.atom_events(0.0)["flights"]
    assert flights["depth_K"][flights["from_row"] == 5] == pytest.approx([2.1e-3], rel=0.02)


def test_axes_of_different_lengths_are_heard_at_the_same_times() -> None:
    """Without pauses, so that the shortest disagreement adds up."""
    rows_hz, cols_hz = (np.linspace(140e6 - 0.8e6 * n, 140e6 + 0.8e6 * n, n, endpoint=False) for n in (8, 40))
    grid = SiteGrid(8, 40, row_frequency_hz=rows_hz, column_frequency_hz=cols_hz)
    motion = spec(overhead_per_batch_s=0.0)
    motion = replace(motion, rf=replace(motion.rf, row_band_hz=(80e6, 200e6), column_band_hz=(80e6, 200e6)))
    there, back = [(5, c) for c in (9, 30)], [(5, c) for c in (4, 25)]
    program = tone_program(Plan.from_batches([(there, back), (back, there)] * 6), grid, motion)
    occupied = np.zeros(grid.shape, np.bool_)
    occupied[5, [9, 30]] = True
    flight = RfTransport(grid, motion, SimulationSettings(transport_loss=0.0, temperature=1e-6))
    for pulse in PulseReceiver(PlayedRfSource(played(program)), 2 * flight.margin_s).receive_until(
        START_S + 10.0
    ):
        flight.carry(occupied, pulse, np.ones(grid.shape), np.random.default_rng(1), 1.0)
    assert np.argwhere(occupied).tolist() == [[5, 9], [5, 30]]
