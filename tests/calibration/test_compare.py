from __future__ import annotations

import math

import numpy as np
import pytest

from labseq.calibration.compare import compare
from labseq.errors import ConfigError
from labseq.model import SiteGrid
from labseq.testing.fakes import fake_calibration

GRID = SiteGrid(3, 4)


def test_sites_that_drifted() -> None:
    before = fake_calibration("sites", GRID)
    moved = before.values["positions_px"] + [0.5, -0.25]
    after = fake_calibration("sites", GRID, values={"positions_px": moved}, quality={"residual_px": 0.05})
    values, figures = compare(before, after)
    positions = next(one for one in values if one.name == "positions_px")
    assert positions.unit == "px"
    assert positions.mean == pytest.approx((0.5, -0.25))
    assert positions.greatest == pytest.approx(0.5)
    assert positions.rms == pytest.approx(math.sqrt((0.25 + 0.0625) / 2))
    assert [(one.name, one.before, one.after) for one in figures] == [("residual_px", 0.02, 0.05)]


def test_values_of_other_shapes_have_no_difference() -> None:
    values, _ = compare(fake_calibration("tweezers", GRID), fake_calibration("tweezers", SiteGrid(4, 4)))
    assert [math.isnan(one.greatest) for one in values] == [True, False]
    assert np.isfinite(values[1].rms)


def test_calibrations_of_different_kinds_are_not_compared() -> None:
    with pytest.raises(ConfigError, match="expected two calibrations of one kind"):
        compare(fake_calibration("sites", GRID), fake_calibration("overlay", GRID))
