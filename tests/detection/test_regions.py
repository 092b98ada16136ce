"""Squares of pixels around the sites."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.detection.sites import KnownSites, known_sites, region_corners
from labseq.detection.threshold import ThresholdSettings
from labseq.errors import LimitError
from labseq.model import SiteGrid
from labseq.roles import Context

GRID = SiteGrid(3, 4)


def known(settings: ThresholdSettings, grid: SiteGrid = GRID) -> KnownSites:
    return known_sites(settings, Context("detector", grid))


@given(
    y=st.floats(20, 60), x=st.floats(40, 80), angle=st.floats(-0.3, 0.3), region=st.sampled_from([1, 3, 5, 9])
)
def test_the_middle_pixel_is_the_nearest(y: float, x: float, angle: float, region: int) -> None:
    settings = ThresholdSettings(frame=(200, 200), centre_px=(y + 60, x + 40), angle=angle, region=region)
    sites = known(settings)
    off = region_corners(sites, region) + region // 2 - sites.positions_px.reshape(-1, 2)
    assert np.abs(off).max() <= 0.5


@given(y=st.floats(-20, 80), x=st.floats(-20, 110))
def test_squares_are_on_the_frame_or_refused(y: float, x: float) -> None:
    settings = ThresholdSettings(frame=(60, 90), centre_px=(y, x))
    try:
        corners = region_corners(known(settings), settings.region)
    except LimitError:
        return
    assert (corners >= 0).all()
    assert (corners + settings.region <= (60, 90)).all()


def test_a_square_over_the_edge_names_its_rows_and_columns() -> None:
    settings = ThresholdSettings(frame=(20, 20), centre_px=(1.0, 10.0))
    with pytest.raises(LimitError, match="rows -1 to 3 and columns 8 to 12"):
        region_corners(known(settings, SiteGrid(1, 1)), settings.region)
