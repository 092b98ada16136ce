"""Pictures of calibrations."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from labseq.calibration.pictures import draw_sites, draw_thresholds
from labseq.pictures.figures import encode_figure


def positions(n_rows: int, n_cols: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.asarray(10.0 * np.moveaxis(np.indices((n_rows, n_cols)), 0, -1) + 20.0, np.float64)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (6, 4)])
def test_sites_on_any_frame_can_be_drawn(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    places = positions(*shape)
    off = rng.normal(0, 0.1, places.shape)
    off[0, 0] = np.nan
    for mean in (rng.normal(500, 5, (90, 80)), np.zeros((90, 80))):
        data = encode_figure(lambda mean=mean: draw_sites(mean, places, off))
        with Image.open(io.BytesIO(data)) as picture:
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
