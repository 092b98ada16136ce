from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from labseq.bench.pictures import ComparisonDrawing, Curve, Histogram, save_comparison
from labseq.errors import ConfigError

N = np.array([25.0, 100.0, 225.0, 400.0])
CURVE = Curve("psca: $N^{0.50(1)}$", N, N**0.5, 0.1 * np.ones(4), law=(1.0, 0.5))
QUOTED = Curve("the paper", N[:2], N[:2], np.zeros(2), is_quoted=True)
LIMIT = Curve("bound", N, 0.8 * N**0.5, np.zeros(4), law=(0.8, 0.5), is_limit=True)
SPREAD = Histogram("DOP 2", np.bincount([3, 4, 4, 5, 7]))


def drawing(
    *curves: Curve, histograms: tuple[Histogram, ...] = (), logarithmic: bool = True
) -> ComparisonDrawing:
    words = ("figure 2b", "10 loadings, seed 1", "atoms", "batches", "batches of psca")
    return ComparisonDrawing(*words, curves, histograms, logarithmic)


def n_colours(path: Path) -> int:
    with Image.open(path) as image:
        return len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0))


@pytest.mark.parametrize(
    "what",
    [
        drawing(CURVE, QUOTED, LIMIT),
        drawing(CURVE, histograms=(SPREAD,), logarithmic=False),
        drawing(histograms=(SPREAD, SPREAD)),
        drawing(Curve("one point", N[:1], N[:1], np.array([np.nan]))),
        drawing(Curve("nothing", N, np.full(4, np.nan), np.full(4, np.nan))),
        drawing(histograms=(Histogram("never", np.zeros(0, np.int64)),)),
        drawing(),
    ],
)  # fmt: skip
def test_whatever_was_done_can_be_drawn(what: ComparisonDrawing, tmp_path: Path) -> None:
    path = tmp_path / "figure.png"
    save_comparison(path, what)
    assert n_colours(path) > 1


def test_two_panels_are_twice_as_wide_as_one(tmp_path: Path) -> None:
    one, two = tmp_path / "one.png", tmp_path / "two.png"
    save_comparison(one, drawing(CURVE))
    save_comparison(two, drawing(CURVE, histograms=(SPREAD,)))
    with Image.open(one) as small, Image.open(two) as large:
        assert (large.width, large.height) == (2 * small.width, small.height)


def test_every_curve_has_a_colour_of_its_own(tmp_path: Path) -> None:
    one, three = tmp_path / "one.png", tmp_path / "three.png"
    save_comparison(one, drawing(CURVE))
    save_comparison(three, drawing(CURVE, CURVE, CURVE))
    assert n_colours(three) > n_colours(one)


def test_a_picture_that_cannot_be_written_is_an_error_in_words(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the picture cannot be written"):
        save_comparison(tmp_path / "nowhere" / "figure.png", drawing(CURVE))
