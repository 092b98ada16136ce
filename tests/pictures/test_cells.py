"""The cells around sites."""

from __future__ import annotations

from collections import Counter
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays

from labseq.model import SiteGrid
from labseq.pictures.figures import cell, neighbours, outline

KINDS: list[tuple[Literal["triangular", "square"], Literal[1, -1], int]] = [
    ("triangular", 1, 6),
    ("triangular", -1, 6),
    ("square", 1, 4),
]


@pytest.mark.parametrize(("lattice", "shear", "n"), KINDS)
def test_cells_fill_the_plane(
    lattice: Literal["triangular", "square"], shear: Literal[1, -1], n: int
) -> None:
    grid = SiteGrid(3, 3, lattice=lattice, shear=shear)
    corners = cell(grid)
    x, y = corners.T
    area = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
    a1, a2 = grid.axes / grid.spacing_m
    assert len(neighbours(grid)) == len(corners) == n
    assert area == pytest.approx(abs(a1[0] * a2[1] - a1[1] * a2[0]))


@pytest.mark.parametrize(("lattice", "shear", "n"), KINDS)
def test_one_site_is_bordered_by_its_cell(
    lattice: Literal["triangular", "square"], shear: Literal[1, -1], n: int
) -> None:
    grid = SiteGrid(1, 1, lattice=lattice, shear=shear)
    assert outline(np.array([[True]]), grid).shape == (n, 2, 2)


@given(arrays(np.bool_, (4, 5)), st.sampled_from(KINDS))
def test_borders_are_closed(
    sites: np.ndarray[tuple[int, int], np.dtype[np.bool_]],
    kind: tuple[Literal["triangular", "square"], Literal[1, -1], int],
) -> None:
    grid = SiteGrid(4, 5, lattice=kind[0], shear=kind[1])
    ends = Counter((round(x, 6), round(y, 6)) for x, y in outline(sites, grid).reshape(-1, 2).tolist())
    assert all(n % 2 == 0 for n in ends.values())
