"""How atoms change between tweezers, against integrals and brute force."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_virtual import transport_kernels as kernels
from labseq_virtual.handover import SLOW, constants, merging_distance
from labseq_virtual.settings import SimulationSettings
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import ndtr

from labseq import SiteGrid

WAIST_M = 0.98e-6
REACH = np.stack(merging_distance(WAIST_M, WAIST_M))


def law(light: dict[str, Any] | None = None, **world: Any) -> NDArray[np.float64]:
    return constants(SiteGrid(), SimulationSettings.model_validate({**world, "mobile_light": light or {}}))


@pytest.mark.parametrize("x", [0.0, 0.5, 3.0, 20.0])
def test_thermal_energies_follow_boltzmann_in_three_dimensions(x: float) -> None:
    energy = (
        np.random.default_rng(1).chisquare(6, 400_000) / 2
    )  # three kinetic, three potential degrees of freedom
    assert np.mean(energy > x) == pytest.approx(kernels.exceeds(x), abs=4e-3)
    exact, _ = quad(lambda e: e**2 * math.exp(-e) / 2, x, math.inf)
    assert kernels.exceeds(x) == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0, 7.0, 25.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_wells_merge_where_the_middle_minimum_vanishes(ratio: float, side: int) -> None:
    log_ratio, merged_m = merging_distance(WAIST_M, WAIST_M)
    distance_m = float(np.interp(math.log(ratio), log_ratio, merged_m)) * (1 + 0.04 * side)
    x = np.linspace(-1e-6, 4.5e-6, 40_001)
    depth = np.exp(-2 * x**2 / WAIST_M**2) + ratio * np.exp(-2 * (x - distance_m) ** 2 / WAIST_M**2)
    n_minima = np.count_nonzero((depth[1:-1] > depth[:-2]) & (depth[1:-1] > depth[2:]))
    assert n_minima == (1 if side < 0 else 2)


@pytest.mark.parametrize("mobile_waists", [1.0, 1.5, 2.5, 3.5])
def test_the_deeper_and_the_wider_the_mobile_well_the_further_it_reaches(mobile_waists: float) -> None:
    log_ratio, merged_m = merging_distance(WAIST_M, mobile_waists * WAIST_M)
    reach_m = merged_m[log_ratio > math.log(2 * mobile_waists**2)]
    assert np.all(np.diff(reach_m) >= 0)
    assert len(reach_m) > 0
    assert np.all(reach_m > 0.9 * mobile_waists * WAIST_M)


def test_equal_wells_merge_at_two_standard_deviations() -> None:
    log_ratio, merged_m = merging_distance(WAIST_M, WAIST_M)
    assert np.interp(0.0, log_ratio, merged_m) == pytest.approx(WAIST_M, rel=0.03)


def test_a_mobile_tweezer_takes_only_from_a_shallower_one() -> None:
    taken = [kernels.takes(mobile, 0.3e-3, 0.0, REACH) for mobile in (0.29e-3, 0.3e-3, 0.31e-3)]
    assert taken == [False, False, True]


def test_a_static_tweezer_that_is_off_holds_nothing_back() -> None:
    assert kernels.takes(1e-3, 0.0, 1.8e-6, REACH)
    assert not kernels.takes(0.0, 0.0, 0.0, REACH)
    assert kernels.risks(0.0, 2e-3, 0.0, 0.0, 0, 60e-6, 1.0, law(transport_loss=0.0))[0] == 1.0


@given(st.floats(-1.0, 3.0))
def test_tables_are_read_along_straight_lines(x: float) -> None:
    assert kernels.interpolate(x, SLOW) == pytest.approx(float(np.interp(x, *SLOW)), abs=1e-15)


@pytest.mark.parametrize("x", [0.0, 0.5, 3.0])
def test_kinetic_energies_follow_maxwell(x: float) -> None:
    energy = np.random.default_rng(1).chisquare(3, 400_000) / 2
    assert np.mean(energy > x) == pytest.approx(kernels.kinetic_exceeds(x), abs=4e-3)


NEWTON = {0.0: (0.995, 1.0), 0.5: (0.98, 0.995), 0.9: (0.39, 0.565), 1.1: (0.115, 0.305)}
"""Survival of a drop-off in 0.5 and in 10 us at some distances in um: atoms moved by Newton's law."""


@pytest.mark.parametrize("distance_um", NEWTON)
def test_an_atom_let_go_beside_its_site_is_lost_about_as_newton_says(distance_um: float) -> None:
    law_ = law(temperature=15e-6, transport_loss=0.0)
    for ramp_s, survived in zip((0.5e-6, 10e-6), NEWTON[distance_um], strict=True):
        spilled, _, _ = kernels.risks(300e-6, 2.1e-3, distance_um * 1e-6, 0.0, 0, ramp_s, 1.0, law_)
        assert 1 - spilled == pytest.approx(survived, abs=0.17)


def test_a_slow_drop_off_on_the_site_keeps_the_atom() -> None:
    spilled, _, _ = kernels.risks(300e-6, 2.1e-3, 0.0, 0.0, 0, 60e-6, 1.0, law(temperature=15e-6))
    assert spilled < 1e-4


@pytest.mark.parametrize(
    ("static", "mobile", "lost"), [(300e-6, 2.1e-3, 0.03), (300e-6, 4.2e-3, 0.06), (150e-6, 2.1e-3, 0.06)]
)
def test_the_hand_over_loss_goes_as_the_ratio_of_the_depths(
    static: float, mobile: float, lost: float
) -> None:
    _, hand_over, transport = kernels.risks(static, mobile, 0.0, 0.0, 5, 60e-6, 1.5, law(transport_loss=0.02))
    assert hand_over == pytest.approx(lost)
    assert transport == 0.0


def test_more_tones_make_shallower_tweezers() -> None:
    law_ = law({"depth": 2e-3, "depth_drop_per_tone": 0.1})
    assert kernels.mobile_depth(1.0, 0, law_) == pytest.approx(2e-3)
    assert kernels.mobile_depth(0.5, 10, law_) == pytest.approx(0.5e-3)


def test_a_tweezer_below_the_adiabatic_depth_loses_its_atoms_and_the_scatter_softens_the_step() -> None:
    law_ = law({"adiabatic_depth": 1e-3, "shallow_loss": 0.3, "intermodulation": 0.02})
    depth = np.array([0.9e-3, 0.999e-3, 1e-3, 1.001e-3, 1.1e-3])
    soft = [kernels.shallow(each, 0.13, 19, law_) for each in depth]
    assert soft == pytest.approx(0.3 * ndtr((1e-3 - depth) / (0.02 * depth)))
    sharp = [kernels.shallow(each, 0.13, 0, law_) for each in depth]
    assert sharp == pytest.approx([0.3, 0.3, 0.15, 0.0, 0.0])


def test_the_adiabatic_depth_goes_as_the_speed_squared() -> None:
    law_ = law({"adiabatic_depth": 1e-3, "shallow_loss": 0.3})
    lost = [kernels.shallow(2e-3, speed, 5, law_) for speed in (0.0, 0.13, 0.19)]
    assert lost == pytest.approx([0.0, 0.0, 0.3], abs=1e-3)


@given(
    st.floats(0.0, 5e-3), st.floats(0.0, 5e-3), st.floats(0.0, 5e-6), st.floats(0.0, 1.0),
    st.integers(0, 40), st.floats(0.0, 1e-3), st.floats(0.0, 100.0),
)  # fmt: skip
def test_risks_are_probabilities(
    static: float,
    mobile: float,
    distance_m: float,
    fallen: float,
    further: int,
    ramp_s: float,
    factor: float,
) -> None:
    law_ = law({"adiabatic_depth": 1e-3, "shallow_loss": 1.0}, transport_loss_per_tone=0.01)
    risks = kernels.risks(static, mobile, distance_m, fallen, further, ramp_s, factor, law_)
    for value in (*risks, kernels.shallow(mobile, 0.2, further, law_)):
        assert 0 <= value <= 1
