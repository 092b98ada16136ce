"""The static tweezers' depths, and the light that sets them."""

from __future__ import annotations

import numpy as np
import pytest
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import StaticArray

from labseq import DepthRamp, SiteGrid, TweezerAmplitudes

GRID = SiteGrid(12, 15)


def array(level: float = 1.0, **physics: float) -> StaticArray:
    """An array with the light on."""
    static = StaticArray(GRID, SimulationSettings.model_validate({"depth_disorder": 0.0} | physics))
    static.draw(np.random.default_rng(3))
    static.ramp(DepthRamp(0.0, level), np.zeros(GRID.shape, np.bool_))
    return static


def equal(factor: float = 1.0) -> TweezerAmplitudes:
    return TweezerAmplitudes(np.full(12, factor / 12), np.full(15, 1 / 15))


def test_equal_amplitudes_at_full_scale_give_the_nominal_depth() -> None:
    np.testing.assert_allclose(array().depth, np.ones(GRID.shape))
    static = array()
    static.drive(equal())
    np.testing.assert_allclose(static.depth, np.ones(GRID.shape))


def test_the_depth_goes_as_the_amplitude_squared() -> None:
    static = array()
    static.drive(equal(0.7))
    np.testing.assert_allclose(static.depth, np.full(GRID.shape, 0.49))


def test_disorder_of_the_sites_cannot_be_told_apart_from_rows_and_columns_and_stays() -> None:
    depth = array(depth_disorder=0.04).depth
    assert depth.std() == pytest.approx(0.04, rel=0.15)
    separable = depth.mean(axis=1, keepdims=True) * depth.mean(axis=0) / depth.mean()
    assert (depth / separable).std() == pytest.approx(0.04, rel=0.2)


def test_the_response_of_the_tones_is_undone_by_amplitudes() -> None:
    static = array(tone_response=0.1)
    depth = static.depth
    assert 0.08 < depth.std() < 0.25
    rows, cols = depth[:, 0] / depth[0, 0], depth[0]
    static.drive(TweezerAmplitudes(rows**-0.5 / 12, cols**-0.5 / 15))
    np.testing.assert_allclose(static.depth, np.ones(GRID.shape))


def test_atoms_are_lost_where_the_light_is_too_weak() -> None:
    static = array(depth_disorder=0.2, lost_below_depth=0.5)
    occupied = np.ones(GRID.shape, np.bool_)
    assert static.ramp(DepthRamp(1.0, 1.0), occupied) == np.count_nonzero(~occupied)
    n_before = np.count_nonzero(occupied)
    n_lost = static.ramp(DepthRamp(1.0, 0.5), occupied)
    assert 0 < n_lost == n_before - np.count_nonzero(occupied)
    np.testing.assert_array_equal(occupied, static.holds())
    static.switch_off()
    assert not static.holds().any()


class Outputs:
    """A ``ToneSource`` that answers what is put into it."""

    def __init__(self) -> None:
        self.heard: list[TweezerAmplitudes] = []

    def played(self, until_s: float) -> list[TweezerAmplitudes]:
        heard, self.heard = self.heard, []
        return heard


def test_outputs_that_are_listened_to_make_the_light_and_nothing_else_does() -> None:
    static, outputs = array(), Outputs()
    static.connect_outputs(outputs)
    occupied = np.zeros(GRID.shape, np.bool_)
    assert static.receive_until(0.0, occupied) == 0
    assert not static.holds().any()
    outputs.heard = [equal()]
    static.receive_until(1.0, occupied)
    np.testing.assert_allclose(static.depth, np.ones(GRID.shape))
    static.receive_until(2.0, occupied)
    np.testing.assert_allclose(static.depth, np.ones(GRID.shape))


def test_atoms_are_lost_in_a_dark_moment_between_two_looks_at_the_outputs() -> None:
    static, outputs = array(), Outputs()
    static.connect_outputs(outputs)
    occupied = np.ones(GRID.shape, np.bool_)
    outputs.heard = [equal(), equal(0.9)]
    assert static.receive_until(0.0, occupied) == 0
    outputs.heard = [equal(0.0), equal()]
    assert static.receive_until(1.0, occupied) == 12 * 15
    assert static.holds().all()


def test_nobody_is_listened_to_after_the_light_was_switched_off() -> None:
    static, outputs = array(), Outputs()
    static.connect_outputs(outputs)
    static.switch_off()
    outputs.heard = [equal()]
    static.receive_until(0.0, np.zeros(GRID.shape, np.bool_))
    assert not static.holds().any()


def test_the_same_machine_has_the_same_disorder() -> None:
    physics = {"depth_disorder": 0.04, "tone_response": 0.05}
    np.testing.assert_array_equal(array(**physics).depth, array(**physics).depth)
