"""Atoms that fly in played waveforms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from labseq_virtual.flight import KELVIN, RfTransport, draw_atoms
from labseq_virtual.flight_kernels import energies
from labseq_virtual.rf_analysis import PulseReceiver
from labseq_virtual.settings import MobileLightSettings, SimulationSettings
from numpy.typing import NDArray

from labseq.model import SiteGrid, ToneProgram
from labseq.testing.rf import FULL_SCALE_V, GRID, START_S, PlayedRfSource, SitePairs, played, program_of, spec

Floats = NDArray[np.float64]

SURE = SimulationSettings(transport_loss=0.0)


def fly(
    program: ToneProgram, atoms: list[tuple[int, int]], settings: SimulationSettings = SURE, seed: int = 1
) -> tuple[set[tuple[int, int]], NDArray[Any]]:
    """The sites that hold atoms afterwards, and the table of flights."""
    flight = RfTransport(GRID, spec(), settings)
    occupied = np.zeros(GRID.shape, np.bool_)
    for site in atoms:
        occupied[site] = True
    rng = np.random.default_rng(seed)
    for pulse in PulseReceiver(PlayedRfSource(played(program)), 60e-6).receive_until(START_S + 10.0):
        flight.carry(occupied, pulse, np.ones(GRID.shape), rng, 1.0)
    return {(int(row), int(col)) for row, col in np.argwhere(occupied)}, flight.tables(START_S)["flights"]


def batch(*pairs: tuple[tuple[int, int], tuple[int, int]]) -> SitePairs:
    return [source for source, _ in pairs], [goal for _, goal in pairs]


def test_atoms_are_where_the_plan_says() -> None:
    program = program_of(
        batch(((5, 2), (5, 1)), ((5, 4), (5, 4)), ((5, 9), (5, 13))),
        batch(((3, 7), (6, 7)), ((8, 7), (9, 7))),
    )
    atoms = [(5, 2), (5, 4), (5, 9), (3, 7), (8, 7), (12, 12)]
    sites, flights = fly(program, atoms)
    assert sites == {(5, 1), (5, 4), (5, 13), (6, 7), (9, 7), (12, 12)}
    assert flights["fate"].tolist() == [b"kept"] * 5
    assert flights["depth_K"] == pytest.approx(np.full(5, 2.1e-3), rel=0.01)
    assert flights["offset_m"] == pytest.approx(np.zeros(5), abs=1e-9)
    assert (flights["held_s"][:3] < program.joint_s[-1] / 2).all()


def test_rows_that_move_by_a_site_at_equal_distance_keep_all_atoms() -> None:
    sites, _ = fly(
        program_of(batch(*(((4, c), (4, c + 1)) for c in range(3, 10)))), [(4, c) for c in range(3, 10)]
    )
    assert sites == {(4, c) for c in range(4, 11)}


def test_an_atom_that_is_moved_over_another_costs_both() -> None:
    sites, flights = fly(program_of(batch(((5, 2), (5, 8)))), [(5, 2), (5, 5)])
    assert sites == set()
    assert flights["fate"].tolist() == [b"collision", b"collision"]
    assert flights["lost_col"] == pytest.approx([5, 5], abs=0.3)
    assert flights["lost_s"][0] == pytest.approx(0.5e-3 + 60e-6 + 3 * 4.49e-6 / 0.13, abs=10e-6)


def test_an_atom_that_is_set_down_on_another_costs_both() -> None:
    sites, flights = fly(program_of(batch(((5, 2), (5, 5)))), [(5, 2), (5, 5)])
    assert sites == set()
    assert flights["fate"].tolist() == [b"collision", b"collision"]


def test_an_atom_that_leaves_the_grid_is_ejected() -> None:
    sites, flights = fly(program_of(batch(((5, 2), (5, -1)))), [(5, 2)])
    assert sites == set()
    assert flights["fate"].tolist() == [b"ejected"]


def test_the_transport_loss_is_drawn_for_who_was_held() -> None:
    settings = SimulationSettings(transport_loss=1.0)
    sites, flights = fly(program_of(batch(((5, 2), (5, 4)))), [(5, 2), (9, 9)], settings)
    assert sites == {(9, 9)}
    assert flights["fate"].tolist() == [b"hand_over"]


@pytest.mark.parametrize("axis", [0, 1])
def test_a_misplaced_tweezer_is_told_and_far_ones_move_nothing(axis: int) -> None:
    program = program_of(batch(((5, 2), (5, 4))))
    for offset_m, moves in ((0.3e-6, True), (2.2e-6, False)):
        offset = (offset_m, 0.0) if axis == 0 else (0.0, offset_m)
        light = MobileLightSettings(offset=offset)
        sites, flights = fly(program, [(5, 2)], SimulationSettings(transport_loss=0.0, mobile_light=light))
        assert sites == ({(5, 4)} if moves else {(5, 2)})
        if moves:
            assert flights["offset_m"] == pytest.approx([offset_m], rel=0.05)
        else:
            assert len(flights) == 0


def test_half_the_volts_on_one_axis_are_a_quarter_of_the_depth() -> None:
    program = program_of(batch(((5, 2), (5, 4))))
    light = MobileLightSettings(tone_voltage=FULL_SCALE_V / 20 * 2**0.5)
    _, flights = fly(program, [(5, 2)], SimulationSettings(transport_loss=0.0, mobile_light=light))
    assert flights["depth_K"] == pytest.approx([2.1e-3 / 4], rel=0.01)


def test_hotter_atoms_are_lost_more_often() -> None:
    program = program_of(batch(*(((r, 2), (r, 6)) for r in (4,))))
    kept = [
        sum((4, 6) in fly(program, [(4, 2)], settings, seed)[0] for seed in range(40))
        for settings in (SURE, SimulationSettings(transport_loss=0.0, temperature=150e-6))
    ]
    assert kept[0] == 40 > kept[1]


@pytest.mark.parametrize(("temperature", "fine"), [(150e-6, True), (151e-6, False), (1.0, False)])
def test_a_temperature_that_the_tweezers_cannot_hold_is_refused(temperature: float, fine: bool) -> None:
    if fine:
        assert SimulationSettings(temperature=temperature).temperature == temperature
    else:
        with pytest.raises(
            ValueError, match="too hot for tweezers with a static_depth of 300 uK; expected at"
        ):
            SimulationSettings(temperature=temperature)


@pytest.mark.parametrize("depth", [1e-9, 15e-6, 30e-6, 300e-6])
def test_atoms_are_bound_and_no_hotter_than_their_tweezer_allows(depth: float) -> None:
    waist, rayleigh, n = 0.98e-6, 3.7e-6, 2000
    depths, kt = np.full(n, KELVIN * depth), KELVIN * 15e-6
    state = draw_atoms(depths, kt, waist, rayleigh, np.random.default_rng(1))
    assert (energies(state, np.zeros((n, 2)), depths, waist, rayleigh) < 0).all()
    assert state[:, 3:].var() < 1.1 * min(kt, KELVIN * depth / 2)


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


def test_the_same_seed_gives_the_same_flights() -> None:
    program = program_of(batch(((5, 2), (5, 4)), ((5, 7), (5, 12))))
    first, second = (
        fly(program, [(5, 2), (5, 7)], SimulationSettings(temperature=100e-6), 3)[1] for _ in range(2)
    )
    assert first.tobytes() == second.tobytes()
