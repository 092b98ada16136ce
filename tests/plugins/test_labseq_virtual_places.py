"""Where the mobile tweezers' tones put their light."""

from __future__ import annotations

import numpy as np
import pytest
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.transport import FrequencyMap, TonePositions
from numpy.typing import NDArray

from labseq import LimitError, SiteGrid

GRID = SiteGrid(5, 6)


@pytest.mark.parametrize("sign", [1, -1])
def test_frequencies_may_rise_or_fall_and_go_on_beyond_the_grid(sign: int) -> None:
    hz = 100e6 + sign * np.array([0.0, 1.0, 2.1]) * 1e6
    places = FrequencyMap(hz, 1e6, "row").sites(100e6 + sign * np.array([-1.0, 0.5, 1.0, 2.1, 3.2]) * 1e6)
    np.testing.assert_allclose(places, [-1.0, 0.5, 1.0, 2.0, 3.0])


def test_frequencies_out_of_order_are_refused() -> None:
    with pytest.raises(LimitError, match="column frequencies"):
        FrequencyMap(np.array([1.0, 3.0, 2.0]), 1.0, "column")


def test_a_grid_of_one_site_takes_the_usual_step() -> None:
    lone = FrequencyMap(np.array([100e6]), 1.6e6, "row")
    np.testing.assert_allclose(lone.sites(np.array([98.4e6, 101.6e6])), [-1.0, 1.0])


def test_errors_of_the_tweezers_places_are_what_the_settings_say() -> None:
    light = SimulationSettings.model_validate(
        {"mobile_light": {"offset": [0.3e-6, -0.2e-6], "magnification_error": 0.01}}
    ).mobile_light
    places = TonePositions(GRID, light)
    for axis, (offset_m, hz) in enumerate(
        [(-0.2e-6, GRID.row_frequency_hz), (0.3e-6, GRID.column_frequency_hz)]
    ):
        n = len(hz)
        expected = np.arange(n) + offset_m / GRID.spacing_m + 0.01 * (np.arange(n) - (n - 1) / 2)
        np.testing.assert_allclose(places.actual(axis, hz), expected)
        np.testing.assert_allclose(places.intended(axis, hz), np.arange(n))


def test_tones_have_errors_of_their_own_that_belong_to_the_machine() -> None:
    light = SimulationSettings.model_validate({"mobile_light": {"tone_error": 0.1e-6}}).mobile_light
    grid = SiteGrid(60, 80, row_frequency_hz=np.arange(1.0, 61.0), column_frequency_hz=np.arange(1.0, 81.0))
    places = TonePositions(grid, light)
    errors: list[NDArray[np.float64]] = []
    for _ in range(2):
        places.draw(np.random.default_rng(5))
        errors.append(places.actual(1, grid.column_frequency_hz) - np.arange(80))
    np.testing.assert_array_equal(errors[0], errors[1])
    assert errors[0].std() * grid.spacing_m == pytest.approx(0.1e-6, rel=0.3)
