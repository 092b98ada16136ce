from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.model import CALIBRATION_KINDS, CalibrationEntry, CalibrationKind, SiteGrid, grid_facts, same_grid
from labseq.testing.fakes import fake_calibration

GRID = SiteGrid(3, 4)


@pytest.mark.parametrize("kind", CALIBRATION_KINDS)
def test_values_are_arrays_that_nobody_can_change(kind: CalibrationKind) -> None:
    for value in fake_calibration(kind, GRID).values.values():
        assert value.dtype == np.float64
        assert not value.flags.writeable


def test_the_id_follows_from_kind_grid_values_and_time_alone() -> None:
    entry = fake_calibration("overlay", GRID)
    assert fake_calibration("overlay", GRID, quality={"error_m": 1.0}, origin={"run": "x"}).id == entry.id
    assert fake_calibration("overlay", GRID, taken_utc="2027-01-01T00:00:00+00:00").id != entry.id
    assert fake_calibration("overlay", GRID, values={"offset_m": [1e-12, 0.0]}).id != entry.id
    assert fake_calibration("overlay", SiteGrid(3, 5)).id != entry.id


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_yaml_takes_no_id_for_a_number(offset_m: float) -> None:
    entry_id = fake_calibration("overlay", GRID, values={"offset_m": [offset_m, 0.0]}).id
    assert len(entry_id) == 12
    assert entry_id[0] in "abcdef"


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        ("sites", {"positions_px": np.zeros((4, 3, 2))}, r"shape \(4, 3, 2\); expected \(3, 4, 2\)"),
        ("sites", {"frame": [512]}, r"'frame' has shape \(1,\)"),
        ("thresholds", {"thresholds": np.full((3, 4), np.nan)}, "not finite"),
        ("thresholds", {"thresholds": [["1"] * 4] * 3}, "not numbers"),
        ("thresholds", {"thresholds": np.ones((3, 4), np.bool_)}, "not numbers"),
        ("tweezers", {"row_amplitudes": [0.1, 0.2, 1.1]}, "outside of 0 to 1"),
        ("frequencies", {"row_hz": [1e8, 3e8, 2e8]}, "neither rises nor falls"),
        ("frequencies", {"row_hz": [-1.0, 1.0, 2.0]}, "not above 0 Hz"),
        ("overlay", {"offset_m": [np.inf, 0.0]}, "not finite"),
    ],
)
def test_what_makes_no_sense_is_refused(kind: CalibrationKind, values: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fake_calibration(kind, GRID, values=values)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "site"}, "not a kind"),
        ({"values": {}}, "'offset_m' is missing"),
        ({"grid": {}}, "the grid has no 'rows'"),
        ({"grid": {**grid_facts(GRID), "rows": 0}}, "no sites"),
        ({"taken_utc": "2026-11-20T08:00:00"}, "which has no time zone"),
        ({"taken_utc": "yesterday"}, "Invalid isoformat"),
    ],
)
def test_what_is_incomplete_is_refused(changes: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {
        "kind": "overlay",
        "values": {"offset_m": [0.0, 0.0]},
        "quality": {},
        "grid": grid_facts(GRID),
        "origin": {},
        "taken_utc": "2026-11-20T08:00:00+00:00",
    }
    with pytest.raises(ValueError, match=message):
        CalibrationEntry(**{**given, **changes})


@pytest.mark.parametrize(
    ("other", "same"),
    [
        (SiteGrid(3, 4), True),
        (SiteGrid(3, 4, row_frequency_hz=np.array([1e8, 2e8, 3e8])), True),
        (SiteGrid(4, 3), False),
        (SiteGrid(3, 4, spacing_m=4.5e-6), False),
        (SiteGrid(3, 4, shear=-1), False),
        (SiteGrid(3, 4, lattice="square"), False),
    ],
)
def test_grids_are_told_apart_by_their_sites(other: SiteGrid, same: bool) -> None:
    assert fake_calibration("overlay", GRID).is_for(other) is same


def test_a_square_lattice_has_no_shear() -> None:
    facts = (grid_facts(SiteGrid(2, 2, lattice="square", shear=shear)) for shear in (1, -1))
    assert same_grid(*facts)
