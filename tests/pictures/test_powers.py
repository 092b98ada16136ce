"""Pictures of powers before and after."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from labseq.calibration.pictures import draw_powers
from labseq.pictures.figures import encode_figure


def powers(shape: tuple[int, int], spread: float = 0.05) -> Any:
    return np.exp(np.random.default_rng(1).normal(0, spread, shape))


def draw(before: Any, after: Any) -> Any:
    n_rows, n_cols = before.shape
    return draw_powers(before, after, np.full(n_rows, 1 / n_rows), np.full(n_cols, 1 / n_cols))


@pytest.mark.parametrize("shape", [(1, 1), (1, 20), (20, 1), (3, 2), (20, 20), (5, 30)])
def test_powers_of_any_grid_can_be_drawn(shape: tuple[int, int]) -> None:
    with Image.open(io.BytesIO(encode_figure(lambda: draw(powers(shape), powers(shape))))) as picture:
        assert picture.format == "PNG"


def test_powers_that_are_not_known_are_left_blank() -> None:
    before, after = powers((6, 8)), powers((6, 8), 0.04)
    before[2, 3] = np.nan
    figure = draw(before, after)
    assert np.ma.masked_invalid(figure.axes[0].images[0].get_array()).mask.sum() == 1
    assert encode_figure(lambda: draw(before, after))


def test_both_maps_have_the_same_colours_and_say_their_spread() -> None:
    figure = draw(powers((20, 20), 0.1), powers((20, 20), 0.04))
    first, second = (axes.images[0] for axes in figure.axes[:2])
    assert first.get_clim() == second.get_clim()
    assert figure.axes[0].get_title().startswith("before: ")
    assert float(figure.axes[1].get_title().split()[1]) == pytest.approx(4, abs=0.4)


@pytest.mark.parametrize("shape", [(20, 20), (3, 2), (1, 7)])
def test_rows_and_columns_are_counted_in_whole_numbers(shape: tuple[int, int]) -> None:
    figure = draw(powers(shape), powers(shape))
    encode_figure(lambda: figure)
    for axes in figure.axes[:4]:
        axis_of = (
            [axes.xaxis]
            if axes.get_xlabel() in ("row", "column") and not axes.images
            else [axes.xaxis, axes.yaxis]
        )
        for axis in axis_of:
            ticks = axis.get_majorticklocs()
            np.testing.assert_allclose(ticks, np.rint(ticks))


def test_all_letters_are_of_two_sizes() -> None:
    figure = draw(powers((4, 5)), powers((4, 5)))
    sizes = {label.get_size() for axes in figure.axes for label in (axes.xaxis.label, axes.yaxis.label)}
    ticks = {t.get_size() for axes in figure.axes for t in (*axes.get_xticklabels(), *axes.get_yticklabels())}
    assert len(sizes) == len(ticks) == 1
