from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from labseq.calibration.pictures import draw_powers, draw_sites, draw_thresholds
from labseq.pictures.figures import encode_figure


def positions(n_rows: int, n_cols: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.asarray(10.0 * np.moveaxis(np.indices((n_rows, n_cols)), 0, -1) + 20.0, np.float64)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5)])
def test_sites_on_any_frame_can_be_drawn(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    places = positions(*shape)
    off = rng.normal(0, 0.1, places.shape)
    off[0, 0] = np.nan
    mean = np.zeros((90, 80)) if shape == (1, 1) else rng.normal(500, 5, (90, 80))
    with Image.open(io.BytesIO(encode_figure(lambda: draw_sites(mean, places, off)))) as picture:
        assert picture.format == "PNG"


def test_arrows_show_where_the_spots_lie() -> None:
    places = positions(6, 4)
    off = np.zeros(places.shape)
    off[2, 1] = [0.0, 0.4]
    axes = draw_sites(np.zeros((90, 80)), places, off).axes[0]
    (arrows,) = (one for one in axes.collections if one.__class__.__name__ == "Quiver")
    assert arrows.U[9] > 0  # pyright: ignore[reportAttributeAccessIssue]
    assert np.count_nonzero(arrows.U) == 1  # pyright: ignore[reportAttributeAccessIssue]
    assert "0.4 px at most" in axes.get_title()
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # y points down, as on the camera


def test_thresholds_stand_in_the_histogram() -> None:
    rng = np.random.default_rng(1)
    signals = np.where(rng.random((50, 3, 4)) < 0.5, 3000.0, 500.0) + rng.normal(0, 100, (50, 3, 4))
    figure = draw_thresholds(signals, np.full((3, 4), 1600.0), "counts")
    assert figure.axes[0].get_xlabel() == "signal of all sites (counts)"
    line = figure.axes[1].lines[0]
    assert np.asarray(line.get_ydata()).tolist() == [1600.0] * 12


def powers(shape: tuple[int, int], spread: float = 0.05) -> Any:
    return np.exp(np.random.default_rng(1).normal(0, spread, shape))


def draw(before: Any, after: Any) -> Any:
    n_rows, n_cols = before.shape
    return draw_powers(before, after, np.full(n_rows, 1 / n_rows), np.full(n_cols, 1 / n_cols))


@pytest.mark.parametrize("shape", [(1, 1), (1, 20), (5, 30)])
def test_powers_of_any_grid_can_be_drawn(shape: tuple[int, int]) -> None:
    with Image.open(io.BytesIO(encode_figure(lambda: draw(powers(shape), powers(shape))))) as picture:
        assert picture.format == "PNG"


def test_powers_that_are_not_known_are_left_blank() -> None:
    before, after = powers((6, 8)), powers((6, 8), 0.04)
    before[2, 3] = np.nan
    figure = draw(before, after)
    assert np.ma.masked_invalid(figure.axes[0].images[0].get_array()).mask.sum() == 1


def test_both_maps_have_the_same_colours_and_say_their_spread() -> None:
    figure = draw(powers((20, 20), 0.1), powers((20, 20), 0.04))
    first, second = (axes.images[0] for axes in figure.axes[:2])
    assert first.get_clim() == second.get_clim()
    assert figure.axes[0].get_title().startswith("before: ")
    assert float(figure.axes[1].get_title().split()[1]) == pytest.approx(4, abs=0.4)
