"""Atoms in the light of played waveforms, against references of other kinds."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_virtual import flight_kernels as kernels
from labseq_virtual.atom_kernels import LANES, Machine, draw_atoms, move, pull, ramp_atoms
from labseq_virtual.atoms import Atoms
from labseq_virtual.flight import Conditions, Flights, RunningProgram
from labseq_virtual.flight_kernels import fly_in_light
from labseq_virtual.formulas import KELVIN
from labseq_virtual.light_kernels import DEPTH, FRAMES_PER_TRANSIT, HALF, PLACE, find_batches, light_of_axis
from labseq_virtual.records import FATES, SITE, plane_of
from labseq_virtual.rf_analysis import PulseReceiver, RfPulse
from labseq_virtual.settings import MobileLightSettings, SimulationSettings
from labseq_virtual.static_array import StaticArray
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.special import erf

from labseq.model import Batch, DepthRamp, Plan, SiteGrid, TargetPattern, TonePaths, ToneProgram, TonesNow
from labseq.motion import check_plan, tone_program

from .rf import (
    GRID,
    START_S,
    PlayedRfSource,
    SitePairs,
    played,
    program_of,
    spec,
    with_phase_jump,
)

Floats = NDArray[np.float64]
WAIST, STATIC_Z, MOBILE_Z = 0.98e-6, math.pi * 0.98e-6**2 / 808e-9, math.pi * 0.98e-6**2 / 852e-9
STATIC, MOBILE = 300e-6 * KELVIN, 2.1e-3 * KELVIN
HOP_S = 2.5e-6
MACHINE = Machine(STATIC, WAIST, STATIC_Z, MOBILE, WAIST, MOBILE_Z, 15e-6, 0.0, 0.0, 0.0, 0.0)
COLD_K = 1e-7


def plane() -> tuple[float, ...]:
    a1, a2 = GRID.axes
    return plane_of(GRID.positions_m[0, 0], a2, a1)


class Light:
    """The tones of a carriage: a row and a column tone, frame by frame."""

    def __init__(self, row: list[float], col: list[float], depth: list[float]) -> None:
        self.rows, self.cols = (np.array(values, np.float64)[None] for values in (row, col))
        self.depth = np.array(depth, np.float64)[None]

    def act(self, *atoms: tuple[int, int], pairs: float = 0.0) -> tuple[set[tuple[int, int]], Any]:
        """Move cold atoms; returns where they are, and the record."""
        sites = np.zeros(GRID.shape, SITE)
        sites["depth"], sites["heat"] = STATIC, COLD_K
        for atom in atoms:
            sites["atom"][atom] = True
        record = fly_in_light(
            sites, self.rows, np.ones_like(self.rows), self.cols, self.depth, 0.0, HOP_S,
            tuple(MACHINE._replace(pair_survival=pairs)), plane(), np.random.default_rng(3),
            np.zeros(len(FATES), np.int64),
        )  # fmt: skip
        return {(int(row), int(col)) for row, col in np.argwhere(sites["atom"])}, record


def carriage(sites: float, speed: float = 0.13, ramp_s: float = 60e-6, hold_s: float = 30e-6) -> Light:
    """From site (5, 3) along the row, with ramps linear in depth."""
    n_ramp, n_hold = round(ramp_s / HOP_S), round(hold_s / HOP_S)
    n_way = max(1, round(abs(sites) * GRID.spacing_m / speed / HOP_S))
    way = [3 + sites * k / n_way for k in range(n_way + 1)]
    depth = [k / n_ramp for k in range(n_ramp)] + [1.0] * (n_way + 1)
    depth += [1 - k / n_ramp for k in range(n_ramp)] + [0.0] * n_hold
    col = [3.0] * n_ramp + way + [3 + sites] * (n_ramp + n_hold)
    return Light([5.0] * len(col), col, depth)


@given(st.floats(-2e-6, 2e-6), st.floats(-2e-6, 2e-6), st.floats(-8e-6, 8e-6))
def test_the_force_is_the_slope_of_the_potential(x: float, y: float, z: float) -> None:
    h = 1e-12
    force = pull(x, y, z, STATIC, WAIST, STATIC_Z)[:3]
    for axis in range(3):
        ends = []
        for sign in (1, -1):
            place = [x, y, z]
            place[axis] += sign * h
            ends.append(pull(place[0], place[1], place[2], STATIC, WAIST, STATIC_Z)[3])
        assert force[axis] == pytest.approx(-(ends[0] - ends[1]) / (2 * h), rel=1e-3, abs=2e2)


def test_the_trap_frequencies_are_the_papers() -> None:
    """57(2) kHz radial and 9.0(4) kHz axial at 300 uK and 0.98(2) um (Tian et al.)."""
    h = 1e-9
    radial = math.sqrt(-pull(h, 0, 0, STATIC, WAIST, STATIC_Z)[0] / h) / math.tau
    axial = math.sqrt(-pull(0, 0, h, STATIC, WAIST, STATIC_Z)[2] / h) / math.tau
    assert radial == pytest.approx(57e3, rel=0.06)  # the waist is known to 2 %
    assert axial == pytest.approx(9.0e3, rel=0.25)  # real beams have aberrations


@settings(max_examples=8)
@given(st.integers(0, 10**6))
def test_moving_agrees_with_an_adaptive_integrator(seed: int) -> None:
    rng = np.random.default_rng(seed)
    atom = np.concatenate([rng.normal(0, 0.15e-6, 2), rng.normal(0, 0.5e-6, 1), rng.normal(0, 0.05, 3)])
    duration = 4e-6

    def slope(t: float, y: Floats) -> Floats:
        part = t / duration
        depth = MOBILE * (0.2 + 0.6 * part) * (1.0 - 0.2 * part)
        x0, y0 = 0.1e-6 + 0.3e-6 * part, -0.05e-6 + 0.1e-6 * part
        static = pull(y[0], y[1], y[2], STATIC, WAIST, STATIC_Z)
        mobile = pull(y[0] - x0, y[1] - y0, y[2], depth, WAIST, MOBILE_Z)
        return np.array([*y[3:], *(static[i] + mobile[i] for i in range(3))])

    expected = solve_ivp(slope, (0, duration), atom, rtol=1e-9, atol=1e-15).y[:, -1]
    lanes = np.zeros(kernels.N_NUMBERS * LANES, np.float32)
    tweezers = [STATIC, 0.1e-6, -0.05e-6, 0.3e-6, 0.1e-6, 0.2, 0.6, 1.0, -0.2]
    lanes[3::LANES] = [*atom, *tweezers]
    move(lanes, MACHINE, duration, 160)
    assert lanes[3 : 3 * LANES : LANES] == pytest.approx(expected[:3], abs=1e-9)
    assert lanes[3 * LANES + 3 : 6 * LANES : LANES] == pytest.approx(expected[3:], abs=1e-3)
    assert not lanes[:LANES][np.arange(LANES) != 3].any()


def test_an_atom_is_carried_and_set_down() -> None:
    sites, record = carriage(4).act((5, 3), (9, 9))
    assert sites == {(5, 7), (9, 9)}
    assert len(record) == 1
    assert 0 < record["held_s"][0] < 60e-6
    assert record["offset"][0] == pytest.approx(0, abs=1e-12)
    assert record["depth"][0] == pytest.approx(MOBILE)


def test_a_shallow_tweezer_leaves_the_atom_behind_and_a_distant_one_does_too() -> None:
    shallow = carriage(4)
    shallow.depth *= 0.05
    beside = carriage(4)
    beside.rows += 0.45
    for light in (shallow, beside):
        assert light.act((5, 3))[0] == {(5, 3)}


@pytest.mark.parametrize(("pairs", "left"), [(0.0, 1), (1.0, 2)])
def test_of_two_atoms_in_one_tweezer_collisions_leave_one_or_none(pairs: float, left: int) -> None:
    sites, record = carriage(3).act((5, 3), (5, 5), (5, 9), pairs=pairs)
    assert (5, 9) in sites
    assert len(sites) == left
    lost = record[record["fate"] > 0]
    assert (lost["fate"] == kernels.COLLISION).all()
    assert (lost["lost_s"] > 60e-6).all()


SURE = SimulationSettings(transport_loss=0.0, pair_survival=0.0)


def fly(
    program: ToneProgram,
    atoms: list[tuple[int, int]],
    settings: SimulationSettings = SURE,
    loss_factor: float = 1.0,
) -> tuple[set[tuple[int, int]], NDArray[Any], NDArray[Any]]:
    """The sites that hold atoms afterwards, and the tables of flights and jumps."""
    flight = Flights(GRID, spec(), settings)
    occupied = np.zeros(GRID.shape, np.bool_)
    for site in atoms:
        occupied[site] = True
    held, rng = Atoms(occupied, settings.temperature), np.random.default_rng(1)
    for pulse in PulseReceiver(PlayedRfSource(played(program)), 60e-6).receive_until(START_S + 10.0):
        flight.carry_pulse(held, pulse, np.ones(GRID.shape), rng, Conditions(loss_factor))
    tables = flight.tables(START_S)
    return {(int(row), int(col)) for row, col in np.argwhere(occupied)}, tables["flights"], tables["jumps"]


def batch(*pairs: tuple[tuple[int, int], tuple[int, int]]) -> SitePairs:
    return [source for source, _ in pairs], [goal for _, goal in pairs]


def test_atoms_are_where_the_plan_says() -> None:
    program = program_of(
        batch(((5, 2), (5, 1)), ((5, 4), (5, 4)), ((5, 9), (5, 13))),
        batch(((3, 7), (6, 7)), ((8, 7), (9, 7))),
    )
    atoms = [(5, 2), (5, 4), (5, 9), (3, 7), (8, 7), (12, 12)]
    sites, flights, _ = fly(program, atoms)
    assert sites == {(5, 1), (5, 4), (5, 13), (6, 7), (9, 7), (12, 12)}
    assert flights["fate"].tolist() == [b"kept"] * 5
    assert flights["depth_K"] == pytest.approx(np.full(5, 2.1e-3), rel=0.01)
    assert flights["offset_m"] == pytest.approx(np.zeros(5), abs=1e-9)
    assert (flights["held_s"][:3] < program.joint_s[-1] / 2).all()


@pytest.mark.parametrize("pause_s", [0.0, 0.5e-3])
def test_each_batch_moves_its_atoms_anew(pause_s: float) -> None:
    """Batches that follow each other at once are flights of their own, and each costs its hand-over loss."""
    there, back = batch(((5, 2), (5, 4))), batch(((5, 4), (5, 2)))
    program = program_of(there, back, there, overhead_per_batch_s=pause_s)
    sites, flights, jumps = fly(program, [(5, 2)])
    assert sites == {(5, 4)}
    assert flights["to_col"].tolist() == [4, 2, 4]
    assert (np.diff(flights["held_s"]) > 120e-6).all()
    assert len(jumps) == 0
    lossy = SimulationSettings(transport_loss=0.1)
    _, flights, _ = fly(program, [(5, 2), (9, 2)], lossy, loss_factor=10)
    assert flights["fate"].tolist() == [b"hand_over"]


@pytest.mark.parametrize("cooled", [0.0, 1.0])
def test_atoms_are_cooled_before_they_are_moved_if_there_is_light(cooled: float) -> None:
    columns = range(1, 19, 3)
    rows = [batch(*(((row, c), (row, c + 2)) for c in columns)) for row in (5, 9)]
    program = program_of(*rows, overhead_per_batch_s=0.5e-3)
    occupied = np.zeros(GRID.shape, np.bool_)
    occupied[np.ix_([5, 9], columns)] = True
    atoms = Atoms(occupied, 60e-6)
    atoms.since_s[...] = START_S
    settings = SimulationSettings(transport_loss=0.0, cooling_time=50e-6)
    running, rng = RunningProgram(program, START_S), np.random.default_rng(2)
    flight = Flights(GRID, spec(), settings)
    flight.carry_program(atoms, running, np.ones(GRID.shape), rng, Conditions(cooled=cooled))
    assert (atoms.heat[occupied].mean() < 30e-6) == (cooled > 0)


def test_a_row_that_moves_by_a_site_keeps_all_atoms() -> None:
    row = range(3, 10)
    sites, _, _ = fly(program_of(batch(*(((4, c), (4, c + 1)) for c in row))), [(4, c) for c in row])
    assert sites == {(4, c + 1) for c in row}


def test_an_atom_that_is_moved_over_another_costs_both() -> None:
    sites, flights, _ = fly(program_of(batch(((5, 2), (5, 8)))), [(5, 2), (5, 5)])
    assert sites == set()
    assert flights["fate"].tolist() == [b"collision", b"collision"]
    assert flights["lost_col"] == pytest.approx([5, 5], abs=0.4)  # a waist is 0.2 sites
    assert flights["lost_s"][0] == pytest.approx(60e-6 + 3 * 4.49e-6 / 0.13, abs=10e-6)


def test_an_atom_that_leaves_the_grid_is_ejected() -> None:
    sites, flights, _ = fly(program_of(batch(((5, 2), (5, -1)))), [(5, 2)])
    assert sites == set()
    assert flights["fate"].tolist() == [b"ejected"]


def test_the_transport_loss_is_drawn_for_held_atoms() -> None:
    settings = SimulationSettings(transport_loss=0.1)
    sites, flights, _ = fly(program_of(batch(((5, 2), (5, 4)))), [(5, 2), (9, 9)], settings, loss_factor=10)
    assert sites == {(9, 9)}
    assert flights["fate"].tolist() == [b"hand_over"]


@pytest.mark.parametrize("axis", [0, 1])
def test_a_misplaced_tweezer_is_reported_and_far_ones_move_nothing(axis: int) -> None:
    program = program_of(batch(((5, 2), (5, 4))))
    for offset_m, moves in ((0.3e-6, True), (2.2e-6, False)):
        offset = (offset_m, 0.0) if axis == 0 else (0.0, offset_m)
        light = MobileLightSettings(offset=offset)
        sites, flights, _ = fly(program, [(5, 2)], SimulationSettings(transport_loss=0.0, mobile_light=light))
        assert sites == ({(5, 4)} if moves else {(5, 2)})
        if moves:
            assert flights["offset_m"] == pytest.approx([offset_m], rel=0.05)
        else:
            assert len(flights) == 0


def test_a_temperature_that_the_tweezers_cannot_hold_is_refused() -> None:
    assert SimulationSettings(temperature=150e-6).temperature == 150e-6
    with pytest.raises(ValueError, match="too hot for tweezers with a static_depth of 300 uK; expected at"):
        SimulationSettings(temperature=151e-6)


@pytest.mark.parametrize("depth", [15e-6, 300e-6])
def test_atoms_are_bound_and_no_hotter_than_their_tweezer_allows(depth: float) -> None:
    waist, rayleigh, n = 0.98e-6, 3.7e-6, 1000
    depths, kt = np.full(n, KELVIN * depth), KELVIN * 15e-6
    state = draw_atoms(depths, np.full(n, kt), waist, rayleigh, np.random.default_rng(1))
    assert (ramp_atoms(state, depths, 1.0, 0.0, waist, rayleigh) < 0).all()
    assert state[:, 3:].var() < 1.1 * min(kt, KELVIN * depth / 2)


def test_rows_are_put_down_one_after_the_other() -> None:
    """While the second row is dropped off, the column that it does not use waits half a site beside it."""
    row = np.array([[0.0, 2], [0.5, 2.5], [1, 2.5], [1, 2.5], [1, 3]])
    column = np.array([[2.0, 3]] * 3 + [[2.5, 3]] * 2)
    tones = TonePaths(row, column, np.array([2, 4]))
    plan = Plan.from_batches([Batch(np.array([(0, 2), (2, 3)]), np.array([(1, 2), (3, 3)]), tones=tones)])
    atoms = [(0, 2), (2, 3), (3, 2), (1, 1), (4, 3)]
    occupied = np.zeros(GRID.shape, np.bool_)
    occupied[tuple(np.array(atoms).T)] = True
    report = check_plan(plan, occupied, TargetPattern.none(GRID.shape), 4)
    expected = {(1, 2), (3, 3), (3, 2), (1, 1), (4, 3)}
    assert {(int(r), int(c)) for r, c in np.argwhere(report.predicted)} == expected
    program = tone_program(plan, GRID, spec())
    there, flights, jumps = fly(program, atoms)
    assert there == expected
    assert set(flights["fate"].tolist()) == {b"kept"}
    assert len(jumps) == 0
    held, rng = Atoms(occupied, 15e-6), np.random.default_rng(1)
    running = RunningProgram(program, 0.0)
    Flights(GRID, spec(), SURE).carry_program(held, running, np.ones(GRID.shape), rng)
    assert np.array_equal(occupied, report.predicted)


MOVE = ([(5, 2), (5, 5)], [(5, 5), (5, 9)])
"""Segments: 0 pick-up, 1 and 2 transport (one arrives before the other), 3 drop-off."""


def jumps_of(program: ToneProgram) -> NDArray[Any]:
    return fly(program, [(5, 2), (5, 5)])[2]


@pytest.mark.parametrize("speed_profile", ["constant", "minimum_jerk", "constant_jerk"])
def test_smooth_motion_has_no_jumps(speed_profile: str) -> None:
    batches = [MOVE, ([(5, 5), (5, 9)], [(5, 4), (5, 7)]), ([(4, 4), (8, 4)], [(3, 4), (12, 4)])]
    assert len(jumps_of(program_of(*batches, speed_profile=speed_profile))) == 0


@pytest.mark.parametrize(("segment", "size_rad"), [(2, -1.0), (3, 2.0), (4, -2.0)])
def test_a_phase_jump_is_found_with_its_size_and_place(segment: int, size_rad: float) -> None:
    smooth = program_of(MOVE)
    all_jumps = jumps_of(with_phase_jump(smooth, segment, size_rad))
    assert np.abs(all_jumps["t_s"] - smooth.joint_s[segment]).max() < 10e-6  # a large one dims the light, too
    jumps = all_jumps[all_jumps["kind"] == b"phase"]
    assert len(jumps) == 2
    for jump in jumps:
        assert jump["t_s"] == pytest.approx(smooth.joint_s[segment], abs=5e-6)
        assert jump["size"] == pytest.approx(size_rad, abs=0.3)
        assert math.isnan(jump["row"])
    columns = smooth.tones_at(float(smooth.joint_s[segment])).column.frequency_hz
    sites = np.interp(columns, GRID.column_frequency_hz, np.arange(20))
    assert np.sort(jumps["col"]) == pytest.approx(np.sort(sites), abs=0.3)


@pytest.mark.parametrize(("ramp", "size"), [("pick_up_s", 1.0), ("drop_off_s", -1.0)])
def test_a_ramp_of_no_length_is_a_jump_of_the_depth(ramp: str, size: float) -> None:
    jumps = jumps_of(program_of(MOVE, **{ramp: 1e-9}))
    assert len(jumps) == 2
    assert set(jumps["kind"].tolist()) == {b"depth"}
    assert jumps["size"] == pytest.approx([size, size], abs=0.1)
    assert jumps["row"] == pytest.approx([5, 5], abs=0.1)
    columns = [2, 5] if size > 0 else [5, 9]
    assert np.sort(jumps["col"]) == pytest.approx(columns, abs=0.4)


# Waveforms broken on purpose, against a prediction that never sees a sample: it takes the tone program's
# formulas, smooths them over the beam by sums over time, and moves an ensemble of atoms in numpy.
N_ATOMS = int(os.environ.get("LABSEQ_ATOMS", "200"))
WAY, ROW = 4, 5
TRANSIT_S, STEP_S = 10e-6, 0.2e-6
HOT_K = 25e-6
"""Hot enough that even a correct waveform loses some."""


@dataclass(frozen=True)
class Broken:
    """A fault of a waveform or of the light."""

    name: str
    offset_m: float = 0.0
    depth_k: float = 2.1e-3
    motion: dict[str, float] = field(default_factory=dict[str, float])
    change: Callable[[ToneProgram], ToneProgram] = lambda program: program
    columns: tuple[int, ...] = (0, 5, 10, 15)
    """Apart, so that an atom left behind is not in the way of another."""

    @property
    def program(self) -> ToneProgram:
        """All atoms of the row move on together."""
        sources = [(ROW, c) for c in self.columns]
        return self.change(program_of((sources, [(r, c + WAY) for r, c in sources]), **self.motion))


CASES = [
    Broken("900 nm beside the sites", offset_m=900e-9),
    Broken("65 % less depth", depth_k=0.35 * 2.1e-3),
    Broken("a phase jump of 2 rad at the start", change=lambda p: with_phase_jump(p, 1, 2.0)),
    Broken("a drop-off of no length", motion={"drop_off_s": 1e-9}),
    Broken("twice the speed", motion={"speed_m_s": 0.26}),
]
if "LABSEQ_ATOMS" in os.environ:
    CASES.extend(
        [
            Broken("nothing"),
            Broken("150 nm beside the sites", offset_m=150e-9),
            Broken("10 % less depth", depth_k=0.9 * 2.1e-3),
            Broken("a phase jump of 1 rad at the start", change=lambda p: with_phase_jump(p, 1, 1.0)),
            Broken("a pick-up of no length", motion={"pick_up_s": 1e-9}),
        ]
    )


class CachedFlights(Flights):
    """Finds the tones of each pulse once: they do not depend on the atoms."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.found: dict[int, Any] = {}

    def find_tones(self, pulse: RfPulse) -> Any:
        if id(pulse) not in self.found:
            self.found[id(pulse)] = list(super().find_tones(pulse))
        return self.found[id(pulse)]


class Ensemble:
    """Atoms of a row that are carried by the same program again and again.

    Args:
        program: The program.
        columns: Where the atoms start.
        simulation: The settings.
        is_played: Whether the samples of an ideal card are played, or the program is taken as it is.
    """

    def __init__(
        self, program: ToneProgram, columns: tuple[int, ...], simulation: SimulationSettings, is_played: bool
    ) -> None:
        self.flights = CachedFlights(GRID, spec(), simulation)
        self._program, self._columns, self._temperature = program, list(columns), simulation.temperature
        outputs = PlayedRfSource(played(program)) if is_played else None
        receiver = PulseReceiver(outputs, 60e-6) if outputs else None
        self._pulses = [*receiver.receive_until(START_S + 10.0)] if receiver else None

    def carry(self, n_atoms: int, way: int) -> Floats:
        """Temperatures of the atoms that arrive, of at least n_atoms."""
        rng, heat, depth = np.random.default_rng(7), list[float](), np.ones(GRID.shape)
        there = np.array(self._columns) + way
        for _ in range(math.ceil(n_atoms / len(there))):
            atoms = Atoms(np.zeros(GRID.shape, np.bool_), self._temperature)
            atoms.occupied[ROW, self._columns] = True
            if self._pulses is None:
                self.flights.carry_program(atoms, RunningProgram(self._program, START_S), depth, rng)
            for pulse in self._pulses or ():
                self.flights.carry_pulse(atoms, pulse, depth, rng)
            heat.extend(atoms.heat[ROW, there][atoms.occupied[ROW, there]])
        return np.array(heat)


PATHS = pytest.mark.parametrize("is_played", [True, False], ids=["played", "program"])


@PATHS
def test_a_slow_move_leaves_the_atoms_as_warm_as_they_were(is_played: bool) -> None:
    columns = (0, 5, 10, 15)
    program = program_of(batch(*(((ROW, c), (ROW, c + 2)) for c in columns)))
    heat = Ensemble(program, columns, SURE, is_played).carry(200, 2)
    assert len(heat) > 190
    assert 0.9 < np.mean(heat) / 15e-6 < 1.25


def simulated_loss(case: Broken, is_played: bool) -> tuple[int, NDArray[Any], NDArray[Any]]:
    """How many of :data:`N_ATOMS` the simulation loses, with its tables."""
    light = MobileLightSettings(offset=(case.offset_m, 0.0), depth=case.depth_k, transit_time=TRANSIT_S)
    simulation = SimulationSettings(transport_loss=0.0, temperature=HOT_K, mobile_light=light)
    ensemble = Ensemble(case.program, case.columns, simulation, is_played)
    n_kept = len(ensemble.carry(N_ATOMS, WAY))
    tables = ensemble.flights.tables(START_S)
    return N_ATOMS - n_kept, tables["flights"], tables["jumps"]


def predicted_loss(case: Broken, n_atoms: int) -> float:
    """The fraction that an ensemble loses on the way of the first tone."""
    t_s, place, depth = smoothed(case.program)
    place += case.offset_m / GRID.spacing_m
    rng = np.random.default_rng(11)
    waist = 0.98e-6
    rayleigh = [math.pi * waist**2 / wavelength for wavelength in (808e-9, 852e-9)]
    static, mobile = KELVIN * 300e-6, KELVIN * case.depth_k
    box = np.array([1.5 * waist, 1.5 * waist, 4 * rayleigh[0]])
    x, v = np.empty((0, 3)), np.empty((0, 3))
    while len(x) < n_atoms:  # the Boltzmann distribution, by rejection from a box
        more_x = box * rng.uniform(-1, 1, (100_000, 3))
        energy = potential(more_x, static, waist, rayleigh[0])
        more_x = more_x[rng.random(len(energy)) < np.exp(-(energy + static) / (KELVIN * HOT_K))]
        more_v = math.sqrt(KELVIN * HOT_K) * rng.standard_normal(more_x.shape)
        energy = 0.5 * (more_v**2).sum(axis=1) + potential(more_x, static, waist, rayleigh[0])
        x, v = np.vstack([x, more_x[energy < 0]]), np.vstack([v, more_v[energy < 0]])
    for k in range(len(t_s)):
        x += 0.5 * STEP_S * v
        site = np.zeros_like(x)
        site[:, 0] = np.rint(x[:, 0] / GRID.spacing_m) * GRID.spacing_m
        v += STEP_S * force(x - site, static, waist, rayleigh[0])
        tweezer = np.array([place[k] * GRID.spacing_m, 0.0, 0.0])
        v += STEP_S * force(x - tweezer, mobile * depth[k], waist, rayleigh[1])
        x += 0.5 * STEP_S * v
    goal = x - np.array([WAY * GRID.spacing_m, 0.0, 0.0])
    energy = 0.5 * (v**2).sum(axis=1) + potential(goal, static, waist, rayleigh[0])
    return float(np.mean(energy >= 0))


def smoothed(program: ToneProgram) -> tuple[Floats, Floats, Floats]:
    """Times, place of the first column tone (in sites from its first) and depth, as the beams see them."""
    start_s, end_s = program.joint_s[0] - 30e-6, program.joint_s[-1] + 30e-6
    t_s = np.arange(start_s, end_s, STEP_S)
    u_s = np.arange(-12.5e-6, 12.5e-6, STEP_S)
    weight = np.exp(-2 * (2 * u_s / TRANSIT_S) ** 2)
    weight /= weight.sum()
    shapes: list[tuple[Floats, Floats]] = []
    for axis in ("row", "column"):
        hz, amplitude, phase = np.zeros(len(t_s)), np.zeros(len(t_s)), np.zeros(len(t_s))
        for k, time_s in enumerate(t_s):
            tones: TonesNow = getattr(program.tones_at(float(time_s)), axis)
            if len(tones.frequency_hz):
                hz[k], amplitude[k], phase[k] = (
                    tones.frequency_hz[0], tones.amplitude[0] * 20, tones.phase_rad[0],
                )  # fmt: skip
        power = np.convolve(amplitude**2, weight, "same")
        mean_hz = np.convolve(amplitude**2 * hz, weight, "same") / np.where(power > 1e-9, power, np.inf)
        chirp = np.gradient(mean_hz, STEP_S)
        wave = amplitude * np.exp(1j * phase)
        n = len(u_s)
        padded = np.pad(wave, (n // 2, n - n // 2 - 1))
        windows = padded[np.arange(len(t_s))[:, None] + np.arange(n)]
        bend = np.exp(-1j * np.pi * chirp[:, None] * u_s**2)
        turn = np.exp(-2j * np.pi * (mean_hz[:, None] * u_s))
        overlap = np.abs((windows * turn * bend * weight).sum(axis=1))
        shapes.append((np.asarray(mean_hz, np.float64), np.asarray(overlap, np.float64)))
    step_hz = float(np.diff(GRID.column_frequency_hz[:2])[0])
    place = np.where(shapes[1][0] > 0, (shapes[1][0] - GRID.column_frequency_hz[0]) / step_hz, 0.0)
    return t_s, place, (shapes[0][1] * shapes[1][1]) ** 2


def potential(x: Floats, depth: float, waist: float, rayleigh: float) -> Floats:
    s = 1 + (x[:, 2] / rayleigh) ** 2
    return -depth / s * np.exp(-2 * (x[:, 0] ** 2 + x[:, 1] ** 2) / (waist**2 * s))


def force(x: Floats, depth: float, waist: float, rayleigh: float) -> Floats:
    s = 1 + (x[:, 2] / rayleigh) ** 2
    q = 2 * (x[:, 0] ** 2 + x[:, 1] ** 2) / (waist**2 * s)
    bottom = depth / s * np.exp(-q)
    radial = -4 * bottom / (waist**2 * s)
    axial = -2 * bottom * (1 - q) / (s * rayleigh**2)
    return np.stack([radial * x[:, 0], radial * x[:, 1], axial * x[:, 2]], axis=1)


@PATHS
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_loss_is_the_predicted_one(case: Broken, is_played: bool) -> None:
    n_lost, flights, jumps = simulated_loss(case, is_played)
    n_predicted = max(600, N_ATOMS)
    expected = predicted_loss(case, n_predicted)
    variance = N_ATOMS * expected * (1 - expected) * (1 + N_ATOMS / n_predicted) + 1.0
    print(f"{case.name}: lost {n_lost} of {N_ATOMS}, predicted {expected:.2%}")
    assert abs(n_lost - N_ATOMS * expected) < 4 * math.sqrt(variance)
    if not is_played:
        return  # these are found in samples only
    held = flights[~np.isnan(flights["held_s"])]
    if "pick_up_s" not in case.motion:  # else it moves before it is seen
        assert float(np.median(held["offset_m"])) == pytest.approx(case.offset_m, abs=5e-9)
    if case.name.startswith("a phase jump of 1 rad"):
        assert np.unique(jumps["kind"]).tolist() == [b"phase"]
    if {"pick_up_s", "drop_off_s"} & {*case.motion}:
        assert np.unique(jumps["kind"]).tolist() == [b"depth"]
    if case.name in ("nothing", "150 nm beside the sites", "10 % less depth", "twice the speed"):
        assert len(jumps) == 0


@pytest.mark.parametrize(("speed_m_s", "error"), [(0.13, 0.02), (0.26, 0.06)])
def test_the_light_of_a_program_is_the_overlap_of_its_sound_with_the_beam(
    speed_m_s: float, error: float
) -> None:
    case = Broken("", motion={"speed_m_s": speed_m_s}, columns=(3,))
    program, flights = case.program, Flights(GRID, spec(), SURE)
    rows, cols = (flights._tones(program, axis) for axis in (0, 1))
    offsets, n = (program.row.offsets, program.column.offsets), program.n_segments
    ((first, last),) = find_batches(rows, offsets[0], cols, offsets[1], n).tolist()
    frame_s = TRANSIT_S / FRAMES_PER_TRANSIT
    light = [
        light_of_axis(tones, at, program.duration_s, program.course, first, last, frame_s, 1.6e6)[0][0]
        for tones, at in zip((rows, cols), offsets, strict=True)
    ]
    t_s, place, depth = smoothed(program)
    frames_s = (np.arange(light[0].shape[0]) - HALF) * frame_s
    found = light[0][:, DEPTH] * light[1][:, DEPTH]
    on = (found > 0.01) & (np.arange(len(found)) < len(found) - 1)
    assert found[on] == pytest.approx(np.interp(frames_s, t_s, depth)[on], abs=error)
    expected = np.interp(frames_s, t_s, place)
    assert (light[1][on, PLACE] - light[1][on, PLACE][0]) == pytest.approx(
        expected[on] - expected[on][0], abs=0.02
    )


def test_the_step_is_short_enough() -> None:
    """Hot atoms in a tweezer that comes on, moves at 200 um/ms and goes off: loss and heat do not change."""
    light, n_groups = carriage(4, speed=0.2), 50
    n = n_groups * LANES
    start = draw_atoms(
        np.full(n, STATIC), np.full(n, KELVIN * 25e-6), WAIST, STATIC_Z, np.random.default_rng(5)
    )
    n_steps = kernels.steps_of(MACHINE, 1.0, HOP_S)
    ends = [flown(light, start, steps) for steps in (n_steps, 4 * n_steps)]
    lost, heat = zip(*((np.mean(e >= 0), e[e < 0].mean() + STATIC) for e in ends), strict=True)
    error = math.sqrt(lost[1] * (1 - lost[1]) / n)
    assert 0.01 < lost[1] < 0.5
    assert abs(lost[0] - lost[1]) < error
    assert heat[0] == pytest.approx(heat[1], rel=0.05)  # 0.05: the error of 400 atoms


def flown(light: Light, start: Floats, n_steps: int) -> Floats:
    """Energies of atoms in their nearest static tweezers after a carriage along a row."""
    step_m, after = GRID.spacing_m, list[Floats]()
    for group in start.reshape(-1, LANES, 6):
        lanes = np.zeros((kernels.N_NUMBERS, LANES), np.float32)
        lanes[:6], lanes[6], lanes[11] = group.T, STATIC, 1.0
        origin = np.zeros(LANES)
        for k in range(len(light.depth[0]) - 1):
            moved = np.rint(lanes[0] / step_m) * step_m
            origin += moved
            lanes[0] -= moved
            place = (light.cols[0] - 3) * step_m
            lanes[7], lanes[9] = place[k] - origin, place[k + 1] - place[k]
            lanes[13], lanes[14] = light.depth[0, k], light.depth[0, k + 1] - light.depth[0, k]
            move(lanes.ravel(), MACHINE, HOP_S, n_steps)
        after.append(np.asarray(lanes[:6].T, np.float64).copy())
    return ramp_atoms(np.concatenate(after), np.full(len(start), STATIC), 1.0, 0.0, WAIST, STATIC_Z)


@pytest.mark.parametrize("fraction", [0.1, 0.2])
def test_a_sudden_drop_of_the_static_tweezers_keeps_what_the_boltzmann_distribution_says(
    fraction: float,
) -> None:
    """The mean, over positions in the deep well, of the Maxwell distribution up to the depth that is left."""
    n, kelvin = 4000, 25e-6
    array = StaticArray(SiteGrid(50, 80), SimulationSettings(temperature=kelvin, depth_disorder=0.0))
    array.ramp(DepthRamp(0.0, 1.0), Atoms(np.ones((50, 80), np.bool_), kelvin), np.random.default_rng(0))
    atoms = Atoms(np.ones((50, 80), np.bool_), kelvin)
    array.ramp(DepthRamp(fraction, fraction), atoms, np.random.default_rng(4))
    x = np.linspace(0, 3 * WAIST, 300)[:, None]
    z = np.linspace(-6 * STATIC_Z, 6 * STATIC_Z, 600)
    s = 1 + (z / STATIC_Z) ** 2
    a = STATIC / (KELVIN * kelvin) / s * np.exp(-2 * x**2 / (WAIST**2 * s))
    weight = x * np.exp(a)
    bound = [erf(np.sqrt(b)) - 2 * np.sqrt(b / np.pi) * np.exp(-b) for b in (a, fraction * a)]
    expected = float((weight * bound[1]).sum() / (weight * bound[0]).sum())
    assert 0.05 < expected < 0.95
    assert atoms.occupied.mean() == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / n))
