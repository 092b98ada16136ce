"""The light of spots on pixels."""

from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st

from labseq.detection.sites import pairs_within, spot_light

PLACES = st.tuples(st.floats(-3, 13), st.floats(-3, 13))


@given(PLACES, st.floats(0.2, 3.0))
def test_the_light_is_that_of_photons_drawn_one_by_one(place: tuple[float, float], width: float) -> None:
    rng = np.random.default_rng(0)
    y, x = np.rint(rng.normal(place, width, (20_000, 2))).astype(int).T
    inside = (y >= 0) & (y < 11) & (x >= 0) & (x < 11)
    drawn = np.bincount(y[inside] * 11 + x[inside], minlength=121).reshape(11, 11) / 20_000
    (light,) = spot_light(np.array([place]), np.zeros((1, 2), np.int64), 11, width)
    assert np.abs(light - drawn).max() < 5 * np.sqrt(0.25 / 20_000)


def test_all_light_falls_somewhere() -> None:
    (light,) = spot_light(np.array([[100.3, 200.7]]), np.array([[90, 190]]), 21, 1.2)
    assert abs(light.sum() - 1) < 1e-12
    assert np.unravel_index(light.argmax(), light.shape) == (10, 11)


@given(st.lists(PLACES, max_size=30), st.floats(0.1, 10))
def test_pairs_are_those_of_all_distances(places: list[tuple[float, float]], distance: float) -> None:
    points = np.array(places).reshape(-1, 2)
    gaps = np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=-1))
    near = gaps <= distance
    np.fill_diagonal(near, False)
    assert pairs_within(points, distance).tolist() == np.argwhere(near).tolist()
