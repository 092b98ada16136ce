"""The simulation: loading, losses, time, the static array, and connected outputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from labseq_virtual.atoms import Atoms
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from labseq_virtual.static_array import StaticArray
from labseq_virtual.tweezers import SILENCE

from labseq.data.fit_models import MODELS
from labseq.model import AxisTones
from labseq.motion import tone_program
from labseq.plugin import (
    Context,
    DepthRamp,
    DeviceError,
    LimitError,
    LineProgram,
    LineSpec,
    MotionSpec,
    Plan,
    RandomStream,
    SiteGrid,
    ToneProgram,
    TweezerAmplitudes,
)
from labseq.testing.fakes import FakeClock

from .rf import GRID as RF_GRID, START_S, PlayedRfSource, played, program_of, spec

GRID = SiteGrid(20, 20)
TINY_IMAGE = {"frame": (2, 2), "background": 0.0}


def new_simulation(seed: int = 0, *, on: bool = True, **physics: Any) -> VirtualSimulation:
    """A simulation without losses but those that are asked for, in its first shot, with small frames."""
    calm = {"lifetime": 2e6, "imaging_loss": 0.0, "transport_loss": 0.0, "image": TINY_IMAGE}
    random = RandomStream(seed)
    simulation = VirtualSimulation(
        SimulationSettings.model_validate(calm | physics), Context("simulation", GRID, random=random)
    )
    simulation.open()
    if on:
        simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    random.begin_shot(0, 0)
    simulation.begin_shot()
    return simulation


def n_atoms(simulation: VirtualSimulation) -> int:
    return int(simulation.truth().sum())


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
    simulation = new_simulation()
    for _ in range(25):
        simulation.begin_shot()
        simulation.load(1.0, duration_s)
        loaded += n_atoms(simulation)
    assert within_four_sigma(loaded, 25 * 400, filling)


def test_without_light_no_atoms_load() -> None:
    simulation = new_simulation(on=False)
    simulation.load(1.0, 0.5)
    assert n_atoms(simulation) == 0


def test_a_site_is_reloaded_and_a_shot_begins_empty() -> None:
    simulation = new_simulation(loading=0.5)
    for k in range(8):
        simulation.load(float(k), 0.5)
        assert within_four_sigma(n_atoms(simulation), 400, 0.5)
    simulation.begin_shot()
    assert n_atoms(simulation) == 0


@pytest.mark.parametrize(("depth", "kept"), [(0.0, 0), (0.001, 0), (0.5, 400)])
def test_a_ramp_too_low_loses_the_atoms_for_good(depth: float, kept: int) -> None:
    simulation = new_simulation(loading=1.0)
    simulation.load(1.0, 0.5)
    assert n_atoms(simulation) == 400
    simulation.play("static_tweezers", DepthRamp(1.0, depth, 0.01), 2.0)
    simulation.play("static_tweezers", DepthRamp(depth, 1.0, 0.01), 2.1)
    assert n_atoms(simulation) == kept


@pytest.mark.parametrize(("depth", "temperature"), [(0.02, 15e-6), (0.1, 30e-6), (0.2, 15e-6)])
def test_a_slow_ramp_loses_the_atoms_that_an_adiabatic_one_does(depth: float, temperature: float) -> None:
    simulation = new_simulation(loading=1.0, temperature=temperature, depth_disorder=0.0)
    simulation.load(1.0, 0.5)
    simulation.play("static_tweezers", DepthRamp(1.0, depth, 0.01), 2.0)
    stays = MODELS["lowering"].evaluate(np.array([depth]), temperature, 1.0, 300e-6)
    assert n_atoms(simulation) / 400 == pytest.approx(float(stays[0]), abs=0.08)


def test_an_image_heats_by_the_recoil_of_its_photons_against_the_cooling() -> None:
    rate_hz, recoil_k, cooling_s, at_k, step_s = 125e3, 0.36196e-6, 1e-3, 15e-6, 1e-6
    simulation = new_simulation(loading=1.0, depth_disorder=0.0, scattering_rate=rate_hz, imaging_loss=0.0)
    simulation.load(1.0, 0.5)
    simulation.expose(2.0, 2e-3)
    before = n_atoms(simulation)
    simulation.play("static_tweezers", TweezerAmplitudes(*[np.full(20, 1 / 20)] * 2, dark_s=20e-6), 2.002)
    heat = at_k
    for _ in range(2000):
        heat += step_s * (rate_hz * recoil_k / 3 - (heat - at_k) / cooling_s)
    light = {"depth": 300e-6, "waist": 0.98e-6, "wavelength": 808e-9, "mass": 86.9}
    stays = MODELS["release_recapture"].evaluate(np.array([20e-6]), heat, 1.0, *light.values())
    assert heat > 27e-6
    assert n_atoms(simulation) / before == pytest.approx(float(stays[0]), abs=0.08)


def test_the_lifetime_acts_between_events_whatever_their_number() -> None:
    survived, total = 0, 0
    for seed in range(10):
        simulation = new_simulation(seed, lifetime=33.0)
        simulation.load(0.0, 0.5)
        total += n_atoms(simulation)
        for t_s in (5.0, 12.0, 17.0, 33.5):
            simulation.play("static_tweezers", DepthRamp(1.0, 1.0), t_s)
        survived += n_atoms(simulation)
    assert within_four_sigma(survived, total, np.exp(-1))


@pytest.mark.parametrize("exposure_s", [45e-3, 90e-3])
def test_an_exposure_loses_what_the_paper_says(exposure_s: float) -> None:
    survived, total = 0, 0
    for seed in range(20):
        simulation = new_simulation(seed, imaging_loss=0.1, lifetime=1.0)
        simulation.load(0.0, 0.5)
        total += n_atoms(simulation)
        simulation.expose(0.5, exposure_s)
        survived += n_atoms(simulation)
    n_exposures = exposure_s / 45e-3
    assert within_four_sigma(survived, total, (0.9 * np.exp(-45e-3)) ** n_exposures)


def test_the_true_atoms_of_each_exposure_are_recorded_if_asked_for() -> None:
    assert "atoms" not in new_simulation().atom_events(0.0)
    simulation = new_simulation(record_truth=True, imaging_loss=0.2)
    simulation.load(0.0, 0.5)
    occupied = [simulation.truth()]
    for t_s in (0.5, 1.5):
        simulation.expose(t_s, 45e-3)
        occupied.append(simulation.truth())
    atoms = simulation.atom_events(0.0)["atoms"]
    for exposure, before in enumerate(occupied[:2]):
        seen = atoms[atoms["exposure"] == exposure]
        sites = np.zeros_like(before)
        sites[seen["row"], seen["col"]] = True
        assert (sites | before == before).all(), "the vacuum may lose some before the exposure"
        sites[seen["row"][seen["lost"]], seen["col"][seen["lost"]]] = False
        np.testing.assert_array_equal(sites, occupied[exposure + 1])
    assert atoms["lost"].sum() > 0


def test_atoms_shine_until_they_are_lost() -> None:
    light, dark = list[float](), {"background": 0.0, "clock_induced_charge": 0.0}
    for lifetime in (2e6, 5e-3):
        simulation = new_simulation(loading=1.0, lifetime=lifetime, image=dark)
        simulation.load(0.0, 0.5)
        simulation._atoms.occupied[...] = True
        light.append(float(simulation.expose(0.5, 45e-3).image.astype(float).sum() - 500 * 512**2))
    assert light[1] / light[0] == pytest.approx(5 / 45, rel=0.25)


def test_a_program_carries_atoms_and_takes_its_time() -> None:
    simulation = new_simulation(loading=1.0)
    simulation.load(0.0, 0.5)
    before = simulation.truth()
    simulation.play("mobile_tweezers", carry_row_0(20 - 1), 1.0)
    after = simulation.truth()
    assert before.all()
    assert not after[0].all()
    with pytest.raises(DeviceError, match=r"lasts until 1\.001120 s"):
        simulation.expose(1.0005, 45e-3)
    simulation.expose(1.00112, 45e-3)


def test_the_transport_loss_spreads_from_shot_to_shot_and_keeps_its_mean() -> None:
    factors: list[float] = []
    simulation = new_simulation(transport_loss_spread=0.5)
    for _ in range(1500):
        simulation.begin_shot()
        factors.append(simulation._loss_factor)
    assert np.mean(factors) == pytest.approx(1.0, abs=4 * 0.53 / np.sqrt(1500))
    assert np.std(np.log(factors)) == pytest.approx(0.5, abs=0.04)


@pytest.mark.parametrize("t_cut_s", [1.00003, 1.00056, 1.000876])
def test_silence_cuts_a_program_short_and_atoms_in_flight_are_lost(t_cut_s: float) -> None:
    simulation = new_simulation(loading=1.0)
    simulation.load(0.0, 0.5)
    for col in range(1, 20):
        simulation._atoms.occupied[0, col] = False
    simulation.play("mobile_tweezers", carry_row_0(19), 1.0)
    simulation.play("mobile_tweezers", SILENCE, t_cut_s)
    truth = simulation.truth()
    assert truth[1:].all()
    caught = t_cut_s > 1.00006
    assert truth[0].sum() == (0 if caught else 1)
    assert truth[0, 0] == (not caught)
    simulation.expose(t_cut_s, 45e-3)


def test_a_ramp_to_zero_is_never_refused_and_acts_when_a_program_has_ended() -> None:
    simulation = new_simulation(loading=1.0)
    simulation.load(0.0, 0.5)
    simulation.play("mobile_tweezers", carry_row_0(), 1.0)
    simulation.play("static_tweezers", DepthRamp(1.0, 0.0), 1.0005)
    assert n_atoms(simulation) == 0


def test_events_in_the_past_are_refused() -> None:
    simulation = new_simulation()
    simulation.load(1.0, 0.5)
    with pytest.raises(DeviceError, match=r"an exposure at 1\.400000 s.*lasts until 1\.500000 s"):
        simulation.expose(1.4, 45e-3)
    with pytest.raises(DeviceError, match="loading at"):
        simulation.load(1.0, 0.5)
    with pytest.raises(DeviceError, match="a program of the mobile tweezers at"):
        simulation.play("mobile_tweezers", carry_row_0(), 1.0)
    simulation.expose(1.5, 45e-3)


def test_the_same_seed_gives_the_same_shot_whatever_came_before() -> None:
    def shot(seed: int, indices: list[tuple[int, int]]) -> tuple[bytes, bytes]:
        random = RandomStream(seed)
        simulation = VirtualSimulation(SimulationSettings(), Context("simulation", GRID, random=random))
        simulation.open()
        simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
        frame = simulation.truth().tobytes(), b""
        for number, (index, attempt) in enumerate(indices):
            random.begin_shot(index, attempt)
            simulation.begin_shot()
            start_s = 10.0 * number
            simulation.load(start_s, 0.5)
            simulation.play("mobile_tweezers", carry_row_0(3), start_s + 1.0)
            image = simulation.expose(start_s + 2.0, 45e-3).image
            frame = simulation.truth().tobytes(), image.tobytes()
        return frame

    assert shot(1, [(3, 0)]) == shot(1, [(0, 0), (1, 0), (3, 0)])
    assert shot(1, [(3, 0)]) != shot(1, [(3, 1)])
    assert shot(1, [(3, 0)]) != shot(2, [(3, 0)])


def test_a_machine_with_a_seed_of_its_own_is_the_same_in_every_run() -> None:
    assert np.array_equal(
        new_simulation(1, machine_seed=9).spot_powers(), new_simulation(2, machine_seed=9).spot_powers()
    )
    assert not np.array_equal(new_simulation(1).spot_powers(), new_simulation(2).spot_powers())


ARRAY_GRID = SiteGrid(12, 15)


def array(level: float = 1.0, **physics: float) -> StaticArray:
    """An array with the light on."""
    static = StaticArray(ARRAY_GRID, SimulationSettings.model_validate({"depth_disorder": 0.0} | physics))
    static.draw(np.random.default_rng(3))
    static.ramp(
        DepthRamp(0.0, level), Atoms(np.zeros(ARRAY_GRID.shape, np.bool_), 15e-6), np.random.default_rng(1)
    )
    return static


def equal(factor: float = 1.0) -> TweezerAmplitudes:
    return TweezerAmplitudes(np.full(12, factor / 12), np.full(15, 1 / 15))


def test_the_depth_goes_as_the_amplitude_squared_and_is_nominal_at_full_scale() -> None:
    np.testing.assert_allclose(array().depth, np.ones(ARRAY_GRID.shape))
    static = array()
    for factor in (1.0, 0.7):
        static.drive(equal(factor))
        np.testing.assert_allclose(static.depth, np.full(ARRAY_GRID.shape, factor**2))


def test_the_response_of_the_tones_is_undone_by_amplitudes() -> None:
    static = array(tone_response=0.1)
    depth = static.depth
    assert 0.08 < depth.std() < 0.25
    rows, cols = depth[:, 0] / depth[0, 0], depth[0]
    static.drive(TweezerAmplitudes(rows**-0.5 / 12, cols**-0.5 / 15))
    np.testing.assert_allclose(static.depth, np.ones(ARRAY_GRID.shape))


def test_atoms_are_lost_where_the_light_is_too_weak() -> None:
    static, rng = array(depth_disorder=0.2, temperature=30e-6), np.random.default_rng(1)
    occupied = np.ones(ARRAY_GRID.shape, np.bool_)
    atoms = Atoms(occupied, 30e-6)
    assert static.ramp(DepthRamp(1.0, 1.0), atoms, rng) == 0
    depth = static.depth
    n_lost = static.ramp(DepthRamp(1.0, 0.1, 5e-3), atoms, rng)
    assert 0 < n_lost == np.count_nonzero(~occupied)
    assert depth[~occupied].mean() < depth[occupied].mean()
    static.switch_off()
    assert not static.holds().any()


class PlayedAmplitudes:
    """A ``ToneSource`` that answers what is put into it."""

    def __init__(self) -> None:
        self.queued: list[TweezerAmplitudes] = []

    def played(self, until_s: float) -> list[TweezerAmplitudes]:
        queued, self.queued = self.queued, []
        return queued


def test_connected_outputs_alone_set_the_light() -> None:
    static, outputs = array(), PlayedAmplitudes()
    static.connect_outputs(outputs)
    atoms = Atoms(np.zeros(ARRAY_GRID.shape, np.bool_), 15e-6)
    assert not static.receive_until(0.0, atoms, np.random.default_rng(1)).total()
    assert not static.holds().any()
    outputs.queued = [equal()]
    static.receive_until(1.0, atoms, np.random.default_rng(1))
    np.testing.assert_allclose(static.depth, np.ones(ARRAY_GRID.shape))
    static.receive_until(2.0, atoms, np.random.default_rng(1))
    np.testing.assert_allclose(static.depth, np.ones(ARRAY_GRID.shape))


def test_atoms_are_lost_in_a_dark_moment_between_two_reads_of_the_outputs() -> None:
    static, outputs = array(), PlayedAmplitudes()
    static.connect_outputs(outputs)
    atoms = Atoms(np.ones(ARRAY_GRID.shape, np.bool_), 15e-6)
    outputs.queued = [equal(), equal(0.9)]
    assert not static.receive_until(0.0, atoms, np.random.default_rng(1)).total()
    outputs.queued = [equal(0.0), equal()]
    assert static.receive_until(1.0, atoms, np.random.default_rng(1))["light"] == 12 * 15
    assert static.holds().all()


def test_a_line_that_stays_on_after_a_release_loses_the_atoms_and_lets_none_load() -> None:
    line = LineSpec("off", 7, ("release",), turns_off="static_tweezers")
    context = Context("simulation", ARRAY_GRID, lines=(line,))
    simulation = VirtualSimulation(SimulationSettings(loading=1.0, temperature=1e-6), context)
    simulation.open()
    simulation.begin_shot()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    n_left = list[int]()
    for t_s, states in ((0.0, [False]), (2.0, [True, False]), (3.0, [True, True]), (4.0, [True])):
        if t_s in (0.0, 4.0):
            simulation.load(t_s + 0.5, 0.5)
        times = np.array([0.0, 5e-6][: len(states)])
        on = np.array(states)[:, np.newaxis]
        simulation.play("lines", LineProgram("release", ("off",), times, on, 0.0, 5e-6), t_s + 1.0)
        n_left.append(int(simulation.truth().sum()))
    assert n_left[0] == 12 * 15
    assert n_left[1] > 0.9 * n_left[0]
    assert n_left[2:] == [0, 0]


def test_outputs_are_ignored_after_the_light_was_switched_off() -> None:
    static, outputs = array(), PlayedAmplitudes()
    static.connect_outputs(outputs)
    static.switch_off()
    outputs.queued = [equal()]
    static.receive_until(0.0, Atoms(np.zeros(ARRAY_GRID.shape, np.bool_), 15e-6), np.random.default_rng(1))
    assert not static.holds().any()


CALM = {
    "lifetime": 2e6,
    "imaging_loss": 0.0,
    "transport_loss": 0.0,
    "pair_survival": 0.0,
    "loading": 1.0,
    "loading_time": 1e-3,
    "image": {"frame": (2, 2)},
}

PROGRAM = program_of(([(5, 2)], [(5, 4)]))


def with_atoms(clock: FakeClock, motion: MotionSpec | None = None, **physics: Any) -> VirtualSimulation:
    """A simulation with an atom on each site, the one at the goal of :data:`PROGRAM` too."""
    random = RandomStream(1)
    context = Context("simulation", RF_GRID, motion or spec(), clock, random)
    simulation = VirtualSimulation(SimulationSettings.model_validate(CALM | physics), context)
    simulation.open()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), clock.now())
    random.begin_shot(0, 0)
    simulation.begin_shot()
    simulation.load(clock.now(), 0.1)
    return simulation


def after(clock: FakeClock) -> float:
    """Some time after the program's end."""
    clock.sleep(START_S + 1.0 - clock.now())
    return clock.now()


@pytest.fixture
def clock() -> FakeClock:
    clock = FakeClock()
    assert clock.now() < START_S - 0.2
    return clock


def test_played_output_acts_before_the_next_event(clock: FakeClock) -> None:
    simulation = with_atoms(clock)
    simulation.connect_outputs("mobile_tweezers", PlayedRfSource(played(PROGRAM)))
    simulation.expose(after(clock), 1e-3)
    assert np.argwhere(~simulation.truth()).tolist() == [[5, 2], [5, 3], [5, 4]]


def test_output_played_before_a_new_connection_still_acts(clock: FakeClock) -> None:
    simulation = with_atoms(clock)
    simulation.connect_outputs("mobile_tweezers", PlayedRfSource(played(PROGRAM)))
    after(clock)
    simulation.connect_outputs("mobile_tweezers", PlayedRfSource(([], [])))
    assert not simulation.truth()[5, 2]


@pytest.mark.parametrize("event", ["exposure", "ramp"])
def test_light_during_another_event_is_an_error(clock: FakeClock, event: str) -> None:
    simulation = with_atoms(clock)
    simulation.connect_outputs("mobile_tweezers", PlayedRfSource(([], [])))
    if event == "exposure":
        simulation.expose(START_S - 0.1, 0.2)
    else:
        simulation.play("static_tweezers", DepthRamp(1.0, 0.9, 0.2), START_S - 0.1)
    simulation.connect_outputs("mobile_tweezers", PlayedRfSource(played(PROGRAM)))
    after(clock)
    with pytest.raises(DeviceError, match=r"were on at 3\.00\d+ s, together with something else; wait"):
        simulation.truth()


def test_the_light_of_the_last_shot_moves_nothing_in_the_next(clock: FakeClock) -> None:
    simulation = with_atoms(clock)
    simulation.connect_outputs("mobile_tweezers", PlayedRfSource(played(PROGRAM)))
    after(clock)
    simulation.begin_shot()
    simulation.load(clock.now(), 0.1)
    assert simulation.truth()[5, 2]
    assert len(simulation.atom_events(0.0)["flights"]) == 0


@pytest.mark.parametrize(
    ("changes", "transit_s", "text"),
    [
        ({"speed_m_s": 0.3}, 10e-6, r"in a transit_time of 10 us is 0\.67 sites; the limit is 0\.6"),
        ({}, 50e-6, r"1\.4 sites"),
        ({}, 1e-6, r"transit_time of 1 us is 1\.6 MHz; .* 2 MHz"),
    ],
)
def test_unresolvable_tones_are_refused(
    clock: FakeClock, changes: dict[str, float | str], transit_s: float, text: str
) -> None:
    simulation = with_atoms(clock, spec(**changes), mobile_light={"transit_time": transit_s})
    with pytest.raises(LimitError, match=text):
        simulation.connect_outputs("mobile_tweezers", PlayedRfSource(([], [])))


@pytest.mark.parametrize(
    ("changes", "transit_s"),
    [({"speed_m_s": 0.26}, 10e-6), ({}, 1.5e-6)],
)
def test_barely_resolvable_tones_carry_neighbours(
    clock: FakeClock, changes: dict[str, float | str], transit_s: float
) -> None:
    motion = spec(**changes)
    simulation = with_atoms(clock, motion, mobile_light={"transit_time": transit_s})
    sources = [(5, c) for c in (1, 2, 3, 16)]
    program = program_of((sources, [(5, 3), (5, 4), (5, 5), (5, 16)]), **changes)
    simulation.connect_outputs("mobile_tweezers", PlayedRfSource(played(program)))
    after(clock)
    flights = simulation.atom_events(0.0)["flights"]
    known = {(int(f["from_row"]), int(f["from_col"])): f["fate"] for f in flights}
    # Those at 1 and 2 meet the atoms on 4 and 5, which stay in their way.
    assert known[5, 16] == b"kept"
    assert len(flights) == 6


def test_preassigned_amplitudes_give_the_full_depth(clock: FakeClock) -> None:
    motion = spec()
    amplitudes = tuple(np.linspace(0.02, 0.05, 20).tolist())
    motion = replace(motion, rf=replace(motion.rf, row_amplitudes=amplitudes))
    simulation = with_atoms(clock, motion)
    program = tone_program(Plan.from_batches([([(5, 2)], [(9, 2)])]), RF_GRID, motion)
    simulation.connect_outputs("mobile_tweezers", PlayedRfSource(played(program)))
    after(clock)
    flights = simulation.atom_events(0.0)["flights"]
    assert flights["depth_K"][flights["from_row"] == 5] == pytest.approx([2.1e-3], rel=0.02)


NOISY = {
    "loading": 1.0,
    "intensity_noise": 2e-8,
    "lights": {"cooling": ["molasses"]},
    "depth_disorder": 0.0,
}


def without_cooling() -> VirtualSimulation:
    """Cold atoms at 1.5 s, which the noise of the intensity heats from then on."""
    line = LineSpec("molasses", 3, ("load",))
    context = Context("simulation", ARRAY_GRID, lines=(line,))
    simulation = VirtualSimulation(SimulationSettings.model_validate(NOISY), context)
    simulation.open()
    simulation.begin_shot()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    simulation.load(1.0, 0.5)
    dark = LineProgram("idle", ("molasses",), np.zeros(1), np.zeros((1, 1), np.bool_), 0.0, 1.0)
    simulation.play("lines", dark, 1.5)
    return simulation


def test_atoms_that_are_loaded_are_cold_whatever_was_there_before() -> None:
    simulation = without_cooling()
    simulation.load(1.55, 0.5)
    simulation.expose(2.05, 1e-3)
    assert simulation.losses()["heat"] == 0


def test_noise_of_the_intensity_heats_atoms_that_no_light_cools() -> None:
    n_left: list[int] = []
    for hold_s in (0.0, 2e-3, 10e-3):
        simulation = without_cooling()
        simulation.expose(1.5 + hold_s, 1e-3)
        n_left.append(n_atoms(simulation))
    rate_hz = 2 / 3 * np.pi**2 * 54.7e3**2 * 2e-8  # 55 kHz in a well of 300 uK
    x = 20 * np.exp(-rate_hz * 10e-3)
    lost = np.exp(-x) * (1 + x + x**2 / 2)
    assert n_left[0] >= n_left[1] > n_left[2]
    assert 1 - n_left[2] / n_left[0] == pytest.approx(lost, abs=0.1)
