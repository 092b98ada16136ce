from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from labseq.config import load_profile
from labseq.config.profile import GridSettings, RfSettings
from labseq.errors import ConfigError
from labseq.model import RfSpec

CHANGES: dict[str, Any] = {
    "row_band": ["90 MHz", "110 MHz"],
    "column_band": ["90 MHz", "110 MHz"],
    "row_amplitudes": ["5 %", 0.1],
    "column_amplitudes": ["5 %", 0.1],
    "phases": "low_crest",
    "phase_seed": 7,
    "snap_within": "5 nm",
}
UNITS = ("_hz", "_v", "_db", "_w", "_m")


def test_defaults_are_the_core_s() -> None:
    assert RfSettings().spec() == RfSpec()


@pytest.mark.parametrize("key", RfSettings.model_fields)
def test_every_key_reaches_the_core(key: str) -> None:
    changed = RfSettings.model_validate({key: CHANGES.get(key, 1.25)}).spec()
    different = [name for name in RfSpec.__slots__ if getattr(changed, name) != getattr(RfSpec(), name)]
    assert different in ([key], *([key + unit] for unit in UNITS))


def test_every_key_is_described() -> None:
    assert all(field.description for field in RfSettings.model_fields.values())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"row_band": ["110 MHz", "90 MHz"]}, "the band goes from 110 MHz to 90 MHz; expected"),
        ({"column_amplitudes": [0.1, 0]}, "greater than 0"),
        ({"row_amplitudes": [1.5]}, "less than or equal to 1"),
        ({"max_peak": "0 V"}, "greater than 0"),
        ({"max_mean_power": "3 V"}, "'3 V' is a voltage, not a power"),
        ({"phases": "schroeder"}, "'random' or 'low_crest'"),
    ],
)
def test_settings_that_make_no_sense(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        RfSettings.model_validate(values)


def test_options_reach_a_profile_that_leaves_rf_out() -> None:
    beside = Path(__file__).parent / "data"
    option = ("mobile_tweezers.rf.max_peak", "1.5 V")
    assert load_profile("profile.yaml", beside=beside, overrides=[option])[1].motion.rf.max_peak_v == 1.5
    wrong = ("mobile_tweezers.rf.max_peek", "1.5 V")
    with pytest.raises(ConfigError, match=r"'max_peek' is not a setting of 'rf'.* did you mean 'max_peak'"):
        load_profile("profile.yaml", beside=beside, overrides=[wrong])


def grid_settings(**table: Any) -> GridSettings:
    return GridSettings.model_validate({"rows": 1, "cols": 3, "spacing": "4 um", "column_frequency": table})


def test_a_table_of_calibrated_tones() -> None:
    grid = grid_settings(table=["98 MHz", "100.1 MHz", "102 MHz"]).model()
    np.testing.assert_array_equal(grid.column_frequency_hz, [98e6, 100.1e6, 102e6])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (["98 MHz", "100 MHz"], "there are 2 tones for 3 sites"),
        (["98 MHz", "102 MHz", "100 MHz"], "the tones neither rise nor fall all along"),
        (["-1 MHz", "100 MHz", "102 MHz"], "greater than 0"),
    ],
)
def test_tables_that_make_no_sense(table: list[str], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        grid_settings(table=table)
