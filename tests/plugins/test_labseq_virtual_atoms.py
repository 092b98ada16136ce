"""Newton's law in static and mobile tweezers, against references of other kinds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_virtual.flight import KELVIN
from labseq_virtual.flight_kernels import (
    COLLIDED,
    DEPTH,
    HELD_S,
    LOST_S,
    N_COLUMNS,
    OFFSET,
    energies,
    follow_atoms,
    move,
    pull,
)
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from labseq.model import SiteGrid

Floats = NDArray[np.float64]

GRID = SiteGrid()
WAIST, STATIC_Z, MOBILE_Z = 0.98e-6, math.pi * 0.98e-6**2 / 808e-9, math.pi * 0.98e-6**2 / 852e-9
BEAMS = np.array([WAIST, STATIC_Z, WAIST, MOBILE_Z])
STATIC, MOBILE = 300e-6 * KELVIN, 2.1e-3 * KELVIN
HOP_S = 2.5e-6
NOBODY = np.zeros(9)


def plane() -> Floats:
    a1, a2 = GRID.axes
    return np.vstack([GRID.positions_m[0, 0], a2, a1, np.linalg.inv(np.stack([a2, a1], axis=1))])


class Light:
    """The tones of a carriage: two columns of frames, as :func:`follow_atoms` takes them."""

    def __init__(self, row: list[float], col: list[float], depth: list[float]) -> None:
        self.rows, self.cols = (np.array(values, np.float64)[:, None] for values in (row, col))
        self.depth = np.array(depth, np.float64)[:, None]
        self.t_s: Floats = np.arange(len(row), dtype=np.float64) * HOP_S

    def act(self, state: Floats, n_steps: int = 25) -> tuple[NDArray[np.bool_], Floats]:
        """Move atoms; returns who is alive and the record."""
        alive, record = np.ones(len(state), np.bool_), np.full((len(state), N_COLUMNS), np.nan)
        follow_atoms(
            state, alive, record, self.rows, np.ones_like(self.rows), self.cols, self.depth, self.t_s,
            np.full(GRID.shape, STATIC), MOBILE, plane(), BEAMS, n_steps,
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


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_moving_agrees_with_an_adaptive_integrator(seed: int) -> None:
    rng = np.random.default_rng(seed)
    atom = np.concatenate([rng.normal(0, 0.15e-6, 2), rng.normal(0, 0.5e-6, 1), rng.normal(0, 0.05, 3)])
    site = np.zeros(4)
    tweezer = np.array([0.1e-6, -0.05e-6, 0.3e-6, 0.1e-6, MOBILE, 0.2, 0.6, 1.0, -0.2])
    duration = 4e-6

    def slope(t: float, y: Floats) -> Floats:
        part = t / duration
        depth = MOBILE * (0.2 + 0.6 * part) * (1.0 - 0.2 * part)
        x0, y0 = 0.1e-6 + 0.3e-6 * part, -0.05e-6 + 0.1e-6 * part
        static = pull(y[0], y[1], y[2], STATIC, WAIST, STATIC_Z)
        mobile = pull(y[0] - x0, y[1] - y0, y[2], depth, WAIST, MOBILE_Z)
        return np.array([*y[3:], *(static[i] + mobile[i] for i in range(3))])

    expected = solve_ivp(slope, (0, duration), atom, rtol=1e-9, atol=1e-15).y[:, -1]
    move(atom, site, STATIC, tweezer, BEAMS, duration, 160)
    assert atom[:3] == pytest.approx(expected[:3], abs=1e-9)
    assert atom[3:] == pytest.approx(expected[3:], abs=1e-3)


def test_energy_is_kept_in_a_static_tweezer() -> None:
    rng = np.random.default_rng(1)
    state = np.concatenate([rng.normal(0, 0.1e-6, (20, 3)), rng.normal(0, 0.05, (20, 3))], axis=1)
    sites, depth = np.zeros((20, 2)), np.full(20, STATIC)
    before = energies(state, sites, depth, WAIST, STATIC_Z)
    for atom in state:
        move(atom, np.zeros(4), STATIC, NOBODY, BEAMS, 1e-3, 10_000)
    after = energies(state, sites, depth, WAIST, STATIC_Z)
    assert after == pytest.approx(before, abs=2e-3 * STATIC)


def test_an_atom_is_carried_and_set_down() -> None:
    state = at_rest((5, 3))
    alive, record = carriage(4).act(state)
    assert alive[0]
    assert np.hypot(*(state[0, :2] - GRID.positions_m[5, 7])) < 0.3e-6
    assert 0 < record[0, HELD_S] < 60e-6
    assert record[0, OFFSET] == pytest.approx(0, abs=1e-12)
    assert record[0, DEPTH] == pytest.approx(MOBILE)


def test_a_sudden_start_shakes_the_atom_as_an_oscillator_says() -> None:
    """In the tweezer's frame the atom starts with its speed: it stays v / omega behind, at most."""
    speed, first = 0.05, 1
    light = carriage(3, speed, ramp_s=HOP_S, hold_s=0)
    omega = math.sqrt(4 * MOBILE / WAIST**2)
    behind: list[float] = []
    for last in range(first + 3, int(light.t_s.searchsorted(100e-6))):
        rows, cols, depth = (v[first:last, 0].tolist() for v in (light.rows, light.cols, light.depth))
        state = at_rest((5, 3))
        Light(rows, cols, depth).act(state, 100)
        way_m = (cols[-1] - 3) * GRID.spacing_m
        if way_m > 2 * WAIST:  # out of the static tweezer
            behind.append(abs(state[0, 0] - GRID.positions_m[5, 3, 0] - way_m))
    assert max(behind) < 1.6 * speed / omega
    assert max(behind) > 0.5 * speed / omega


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


def test_light_that_goes_out_between_sites_lets_the_atom_fall() -> None:
    light = carriage(1.5)
    state = at_rest((5, 3))
    state[0, 3] = 0.05
    alive, record = light.act(state)
    site = GRID.positions_m[5, 4]
    assert not alive[0] or np.hypot(*(state[0, :2] - site)) > WAIST
    assert alive[0] or record[0, LOST_S] > light.t_s[-30]


def test_two_atoms_in_one_tweezer_are_both_lost() -> None:
    state = at_rest((5, 3), (5, 5), (5, 9))
    alive, record = carriage(3).act(state)
    assert alive.tolist() == [False, False, True]
    assert record[:2, COLLIDED].tolist() == [1.0, 1.0]
    assert record[0, LOST_S] == record[1, LOST_S] > 60e-6


def test_atoms_that_no_tweezer_comes_near_are_left_alone() -> None:
    state = at_rest((5, 3), (15, 15))
    before = state[1].copy()
    carriage(3).act(state)
    np.testing.assert_array_equal(state[1], before)


def test_an_atom_in_flight_is_lost_when_nothing_catches_it() -> None:
    state = at_rest((5, 3))
    state[0, 3] = 1.0
    alive, record = carriage(3).act(state)
    assert not alive[0]
    assert record[0, LOST_S] < 10e-6
