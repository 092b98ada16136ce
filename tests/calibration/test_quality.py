from __future__ import annotations

import math

import pytest

from labseq.calibration.quality import DECIDING, why_worse
from labseq.model import CALIBRATION_KINDS, CalibrationEntry, CalibrationKind, SiteGrid
from labseq.testing.fakes import fake_calibration

GRID = SiteGrid(3, 4)


def entry(kind: CalibrationKind, figure: float, **others: float) -> CalibrationEntry:
    return fake_calibration(kind, GRID, quality={DECIDING[kind].figure: figure, **others})


@pytest.mark.parametrize("kind", CALIBRATION_KINDS)
def test_a_figure_half_as_large_again_is_worse_where_it_matters(kind: CalibrationKind) -> None:
    matters = DECIDING[kind].good_enough
    assert not why_worse(entry(kind, 1.4 * matters), entry(kind, matters))
    assert why_worse(entry(kind, 1.6 * matters), entry(kind, matters))
    assert not why_worse(entry(kind, 0.9 * matters), entry(kind, 0.1 * matters))
    assert not why_worse(entry(kind, matters), entry(kind, 100 * matters))


def test_fewer_sites_are_worse() -> None:
    old = entry("sites", 0.01, n_sites_found=12)
    assert "it found 11 sites, but the calibration in use found 12" in why_worse(
        entry("sites", 0.01, n_sites_found=11), old
    )
    assert not why_worse(entry("sites", 0.01, n_sites_found=12), old)
    assert not why_worse(entry("sites", 0.01), old)  # from a file: nothing was looked for


def test_a_peak_taken_from_the_neighbours_is_the_users_choice() -> None:
    good, lame = entry("thresholds", 1e-4, n_one_peak=0), entry("thresholds", 1e-4, n_one_peak=2)
    for in_use in (None, good):
        assert why_worse(lame, in_use).startswith("at 2 sites ")
    assert not why_worse(lame, lame)


def test_one_that_does_not_say_how_good_it_is_replaces_only_its_like() -> None:
    unknown = entry("overlay", math.nan)
    assert "it has no quality figure" in why_worse(unknown, entry("overlay", 1.0))
    assert not why_worse(unknown, unknown)
    assert not why_worse(entry("overlay", 1.0), unknown)


def test_nothing_is_worse_than_none_or_than_one_of_another_grid() -> None:
    bad = entry("overlay", 1.0)
    assert not why_worse(bad, None)
    assert not why_worse(bad, fake_calibration("overlay", SiteGrid(5, 5)))
