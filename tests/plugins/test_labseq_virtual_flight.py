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
from hypothesis.extra.numpy import arrays
from labseq_virtual.atoms import Atoms
from labseq_virtual.flight import KELVIN, RfTransport, draw_atoms
from labseq_virtual.flight_kernels import (
    Beams,
    Site,
    Spot,
    energies,
    follow_atoms,
    move,
    new_flights,
    pull,
)
from labseq_virtual.rf_analysis import PulseReceiver, RfPulse
from labseq_virtual.settings import MobileLightSettings, SimulationSettings
from labseq_virtual.transport import Transport
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from labseq.model import Batch, Plan, SiteGrid, TargetPattern, TonePaths, ToneProgram, TonesNow
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
BEAMS = np.array([WAIST, STATIC_Z, WAIST, MOBILE_Z])
STATIC, MOBILE = 300e-6 * KELVIN, 2.1e-3 * KELVIN
HOP_S = 2.5e-6


def plane() -> Floats:
    a1, a2 = GRID.axes
    return np.vstack([GRID.positions_m[0, 0], a2, a1, np.linalg.inv(np.stack([a2, a1], axis=1))])


class Light:
    """The tones of a carriage: two columns of frames, as :func:`follow_atoms` takes them."""

    def __init__(self, row: list[float], col: list[float], depth: list[float]) -> None:
        self.rows, self.cols = (np.array(values, np.float64)[:, None] for values in (row, col))
        self.depth = np.array(depth, np.float64)[:, None]
        self.t_s: Floats = np.arange(len(row), dtype=np.float64) * HOP_S

    def act(self, state: Floats, n_steps: int = 25, pairs: float = 0.0) -> tuple[NDArray[np.bool_], Any]:
        """Move atoms; returns who is alive and the record."""
        alive, record = np.ones(len(state), np.bool_), new_flights(len(state))
        follow_atoms(
            state, alive, record, self.rows, np.ones_like(self.rows), self.cols, self.depth, self.t_s,
            np.full(GRID.shape, STATIC), MOBILE, plane(), BEAMS, n_steps, np.full(len(state), 0.3), pairs,
        )  # fmt: skip
        return alive, record


def carriage(sites: float, speed: float = 0.13, ramp_s: float = 60e-6, hold_s: float = 30e-6) -> Light:
    """From site (5, 3) along the row, with ramps linear in depth."""
    n_ramp, n_hold = round(ramp_s / HOP_S), round(hold_s / HOP_S)
    n_way = max(1, round(abs(sites) * GRID.spacing_m / speed / HOP_S))
    way = [3 + sites * k / n_way for k in range(n_way + 1)]
    depth = [k / n_ramp for k in range(n_ramp)] + [1.0] * (n_way + 1)
    depth += [1 - k / n_ramp for k in range(n_ramp)] + [0.0] * n_hold
    col = [3.0] * n_ramp + way + [3 + sites] * (n_ramp + n_hold)
    return Light([5.0] * len(col), col, depth)


def at_rest(*sites: tuple[int, int]) -> Floats:
    state = np.zeros((len(sites), 6))
    for i, site in enumerate(sites):
        state[i, :2] = GRID.positions_m[site]
    return state


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
    site, spot = Site(0.0, 0.0, STATIC), Spot(0.1e-6, -0.05e-6, 0.3e-6, 0.1e-6, MOBILE, 0.2, 0.6, 1.0, -0.2)
    duration = 4e-6

    def slope(t: float, y: Floats) -> Floats:
        part = t / duration
        depth = MOBILE * (0.2 + 0.6 * part) * (1.0 - 0.2 * part)
        x0, y0 = 0.1e-6 + 0.3e-6 * part, -0.05e-6 + 0.1e-6 * part
        static = pull(y[0], y[1], y[2], STATIC, WAIST, STATIC_Z)
        mobile = pull(y[0] - x0, y[1] - y0, y[2], depth, WAIST, MOBILE_Z)
        return np.array([*y[3:], *(static[i] + mobile[i] for i in range(3))])

    expected = solve_ivp(slope, (0, duration), atom, rtol=1e-9, atol=1e-15).y[:, -1]
    move(atom, site, spot, Beams(*BEAMS), duration, 160)
    assert atom[:3] == pytest.approx(expected[:3], abs=1e-9)
    assert atom[3:] == pytest.approx(expected[3:], abs=1e-3)


def test_an_atom_is_carried_and_set_down() -> None:
    state = at_rest((5, 3))
    alive, record = carriage(4).act(state)
    assert alive[0]
    assert np.hypot(*(state[0, :2] - GRID.positions_m[5, 7])) < 0.3e-6
    assert 0 < record[0].held_s < 60e-6
    assert record[0].offset == pytest.approx(0, abs=1e-12)
    assert record[0].depth == pytest.approx(MOBILE)


def test_a_shallow_tweezer_leaves_the_atom_behind_and_a_distant_one_does_too() -> None:
    shallow = carriage(4)
    shallow.depth *= 0.05
    beside = carriage(4)
    beside.rows += 0.45
    for light in (shallow, beside):
        state = at_rest((5, 3))
        alive, _ = light.act(state)
        assert alive[0]
        assert np.hypot(*(state[0, :2] - GRID.positions_m[5, 3])) < WAIST


@pytest.mark.parametrize(("pairs", "left"), [(0.2, 0), (0.4, 1)])
def test_of_two_atoms_in_one_tweezer_collisions_leave_one_or_none(pairs: float, left: int) -> None:
    state = at_rest((5, 3), (5, 5), (5, 9))
    alive, record = carriage(3).act(state, pairs=pairs)
    assert alive[:2].sum() == left
    assert alive[2]
    assert (record["collided"][~alive] == 1).all()
    assert (record["lost_s"][~alive] > 60e-6).all()


def test_an_atom_in_flight_is_lost_when_nothing_catches_it() -> None:
    state = at_rest((5, 3))
    state[0, 3] = 1.0
    alive, record = carriage(3).act(state)
    assert not alive[0]
    assert record[0].lost_s < 10e-6


SURE = SimulationSettings(transport_loss=0.0, pair_survival=0.0)


def fly(
    program: ToneProgram,
    atoms: list[tuple[int, int]],
    settings: SimulationSettings = SURE,
    loss_factor: float = 1.0,
) -> tuple[set[tuple[int, int]], NDArray[Any], NDArray[Any]]:
    """The sites that hold atoms afterwards, and the tables of flights and jumps."""
    flight = RfTransport(GRID, spec(), settings)
    occupied = np.zeros(GRID.shape, np.bool_)
    for site in atoms:
        occupied[site] = True
    held, rng = Atoms(occupied, settings.temperature), np.random.default_rng(1)
    for pulse in PulseReceiver(PlayedRfSource(played(program)), 60e-6).receive_until(START_S + 10.0):
        flight.carry(held, pulse, np.ones(GRID.shape), rng, loss_factor)
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


def test_an_atom_is_cooled_between_batches() -> None:
    program = program_of(batch(((5, 2), (5, 4))), batch(((9, 2), (9, 4))), overhead_per_batch_s=0.5e-3)
    (pulse,) = PulseReceiver(PlayedRfSource(played(program)), 1e-3).receive_until(START_S + 10.0)
    occupied = np.zeros(GRID.shape, np.bool_)
    occupied[[5, 9], [2, 2]] = True
    atoms = Atoms(occupied, 15e-6)
    atoms.since_s[...] = START_S - 1.0
    waited: list[float] = []

    def relax(heat: NDArray[np.float64], elapsed_s: NDArray[np.float64]) -> NDArray[np.float64]:
        waited.append(float(elapsed_s[5, 4]))
        return heat

    RfTransport(GRID, spec(), SURE).carry(
        atoms, pulse, np.ones(GRID.shape), np.random.default_rng(1), 1.0, relax
    )
    assert waited[1] == pytest.approx(0.5e-3, abs=0.05e-3)


def test_a_row_that_moves_by_a_site_keeps_all_atoms() -> None:
    row = range(3, 10)
    sites, _, _ = fly(program_of(batch(*(((4, c), (4, c + 1)) for c in row))), [(4, c) for c in row])
    assert sites == {(4, c + 1) for c in row}


def test_an_atom_that_is_moved_over_another_costs_both() -> None:
    sites, flights, _ = fly(program_of(batch(((5, 2), (5, 8)))), [(5, 2), (5, 5)])
    assert sites == set()
    assert flights["fate"].tolist() == [b"collision", b"collision"]
    assert flights["lost_col"] == pytest.approx([5, 5], abs=0.3)
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


def test_the_loss_of_each_tone_beyond_one_per_axis_is_drawn() -> None:
    settings = SimulationSettings(transport_loss=0.0, transport_loss_per_tone=1.0)
    assert fly(program_of(batch(((5, 2), (5, 4)))), [(5, 2)], settings)[0] == {(5, 4)}
    two = program_of(batch(((5, 2), (5, 4)), ((5, 7), (5, 9))))
    assert fly(two, [(5, 2), (5, 7)], settings)[0] == set()


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
    state = draw_atoms(depths, kt, waist, rayleigh, np.random.default_rng(1))
    assert (energies(state, np.zeros((n, 2)), depths, waist, rayleigh) < 0).all()
    assert state[:, 3:].var() < 1.1 * min(kt, KELVIN * depth / 2)


@settings(max_examples=30)
@given(
    arrays(np.float64, (5, 3), elements=st.one_of(st.just(np.nan), st.floats(-30, 30))),
    arrays(np.float64, (5, 2), elements=st.one_of(st.just(np.nan), st.floats(-2, 6))),
)
def test_near_a_tweezer_are_the_sites_around_it(rows: Floats, cols: Floats) -> None:
    grid = SiteGrid(4, 3)
    near = np.zeros(grid.shape, np.bool_)
    for row, col in ((r, c) for k in range(5) for r in rows[k] for c in cols[k] if r == r and c == c):
        for site in np.ndindex(*grid.shape):
            near[site] |= site[0] - math.floor(row) in (0, 1) and site[1] - math.floor(col) in (0, 1)
    np.testing.assert_array_equal(RfTransport(grid, spec(), SURE)._near(rows, cols), near)


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
    transport = Transport(GRID, spec(), SURE)
    held, rng = Atoms(occupied, 15e-6), np.random.default_rng(1)
    transport.carry(held, program, program.n_segments, np.ones(GRID.shape), rng, 1.0)
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


class CachedTransport(RfTransport):
    """Finds the tones of each pulse once: they do not depend on the atoms."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.found: dict[int, Any] = {}

    def find_tones(self, pulse: RfPulse) -> Any:
        if id(pulse) not in self.found:
            self.found[id(pulse)] = list(super().find_tones(pulse))
        return self.found[id(pulse)]


def test_a_slow_move_leaves_the_atoms_as_warm_as_they_were() -> None:
    """By equipartition: the mean energy is 3 kT, and a few percent more as the well is not a parabola."""
    flight, rng, heat = CachedTransport(GRID, spec(), SURE), np.random.default_rng(1), list[float]()
    columns = np.array([0, 5, 10, 15])
    program = program_of(batch(*(((ROW, c), (ROW, c + 2)) for c in columns.tolist())))
    pulses = [*PulseReceiver(PlayedRfSource(played(program)), 60e-6).receive_until(START_S + 10.0)]
    for _ in range(50):
        atoms = Atoms(np.zeros(GRID.shape, np.bool_), 15e-6)
        atoms.occupied[ROW, columns] = True
        for pulse in pulses:
            flight.carry(atoms, pulse, np.ones(GRID.shape), rng, 1.0)
        heat.extend(atoms.heat[ROW, columns + 2][atoms.occupied[ROW, columns + 2]])
    assert len(heat) > 190
    assert 0.95 < np.mean(heat) / 15e-6 < 1.3


def simulated_loss(case: Broken) -> tuple[int, NDArray[Any], NDArray[Any]]:
    """How many of :data:`N_ATOMS` the simulation loses, with its tables."""
    light = MobileLightSettings(offset=(case.offset_m, 0.0), depth=case.depth_k, transit_time=TRANSIT_S)
    flight = CachedTransport(
        GRID, spec(), SimulationSettings(transport_loss=0.0, temperature=HOT_K, mobile_light=light)
    )
    outputs, rng = played(case.program), np.random.default_rng(7)
    pulses = [*PulseReceiver(PlayedRfSource(outputs), 60e-6).receive_until(START_S + 10.0)]
    columns = np.array(case.columns)
    n_kept, n_rows = 0, N_ATOMS // len(columns)
    for _ in range(n_rows):
        occupied = np.zeros(GRID.shape, np.bool_)
        occupied[ROW, columns] = True
        atoms = Atoms(occupied, HOT_K)
        for pulse in pulses:
            flight.carry(atoms, pulse, np.ones(GRID.shape), rng, 1.0)
        n_kept += int(np.count_nonzero(occupied[ROW, columns + WAY]))
    tables = flight.tables(START_S)
    return n_rows * len(columns) - n_kept, tables["flights"], tables["jumps"]


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


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_loss_is_the_predicted_one(case: Broken) -> None:
    n_lost, flights, jumps = simulated_loss(case)
    n_predicted = max(600, N_ATOMS)
    expected = predicted_loss(case, n_predicted)
    variance = N_ATOMS * expected * (1 - expected) * (1 + N_ATOMS / n_predicted) + 1.0
    print(f"{case.name}: lost {n_lost} of {N_ATOMS}, predicted {expected:.2%}")
    assert abs(n_lost - N_ATOMS * expected) < 4 * math.sqrt(variance)
    held = flights[~np.isnan(flights["held_s"])]
    if "pick_up_s" not in case.motion:  # else it moves before it is seen
        assert float(np.median(held["offset_m"])) == pytest.approx(case.offset_m, abs=5e-9)
    if case.name.startswith("a phase jump of 1 rad"):
        assert np.unique(jumps["kind"]).tolist() == [b"phase"]
    if {"pick_up_s", "drop_off_s"} & {*case.motion}:
        assert np.unique(jumps["kind"]).tolist() == [b"depth"]
    if case.name in ("nothing", "150 nm beside the sites", "10 % less depth", "twice the speed"):
        assert len(jumps) == 0
