from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.model import Plan, SiteGrid
from labseq.pictures.figures import HEAD_IN, MARGIN, Extent, extent_of, lay_out, place_sites
from labseq.testing.strategies import grids


@settings(deadline=None)
@given(grids(max_shape=(9, 9)))
def test_sites_stand_as_on_the_lattice(grid: SiteGrid) -> None:
    places = place_sites(np.argwhere(np.ones(grid.shape)), grid)
    expected = (grid.positions_m - grid.positions_m[0, 0]).reshape(-1, 2) / grid.spacing_m
    assert np.allclose(places, expected)


@settings(deadline=None)
@given(grids(max_shape=(9, 9)))
def test_a_panel_shows_every_site_and_where_atoms_are_ejected(grid: SiteGrid) -> None:
    n_rows, n_cols = grid.shape
    plan = Plan.from_batches([([(0, 0)], [(-1, 0)]), ([(n_rows - 1, n_cols - 1)], [(n_rows - 1, n_cols)])])
    for shown in (plan, Plan.from_batches([])):
        extent = extent_of(shown, grid)
        sites = np.argwhere(np.ones(grid.shape))
        x, y = place_sites(np.concatenate([sites, shown.moves[:, 2:]]), grid).T
        assert (extent.left, extent.right) == pytest.approx((x.min() - MARGIN, x.max() + MARGIN))
        assert (extent.top, extent.bottom) == pytest.approx((y.min() - MARGIN, y.max() + MARGIN))


@settings(deadline=None)
@given(st.floats(3, 200), st.floats(3, 200), st.integers(2, 40))
def test_panels_stand_on_the_sheet_beside_one_another(width: float, height: float, n_panels: int) -> None:
    sheet = lay_out(Extent(0.0, width, 0.0, height), n_panels)
    places = [sheet.place(i) for i in range(n_panels)]
    for left, bottom, across, up in places:
        assert left >= -1e-9
        assert bottom >= -1e-9
        assert left + across <= 1 + 1e-9
        assert bottom + up <= 1 - HEAD_IN / sheet.height_in + 1e-9
        assert across * sheet.width_in / width == pytest.approx(up * sheet.height_in / height)
    for (l1, b1, w, h), (l2, b2, _, _) in combinations(places, 2):
        assert abs(l1 - l2) >= w - 1e-9 or abs(b1 - b2) >= h - 1e-9


@pytest.mark.parametrize("n_panels", [2, 3, 4, 9, 20, 40])
def test_few_places_stay_empty(n_panels: int) -> None:
    sheet = lay_out(Extent(0.0, 33.0, 0.0, 20.0), n_panels)
    assert sheet.n_rows * sheet.n_cols - n_panels <= max(1, n_panels // 8)
