"""Settings that cameras have in common."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, strategies as st
from pydantic import ValidationError

from labseq.plugin import SensorMode
from labseq.plugin.camera import CameraSettings, Cooling

sizes = st.integers(1, 600)
corners = st.integers(0, 600)


def camera(**settings: Any) -> CameraSettings:
    return CameraSettings.model_validate(settings)


def test_a_region_begins_at_the_corner_unless_it_says_where() -> None:
    region = {"height": 100, "width": 60}
    assert camera().mode == SensorMode()
    assert camera(region=region).mode.region == (0, 0, 100, 60)
    assert camera(region=region | {"y": 7, "x": 9}).mode.region == (7, 9, 100, 60)
    assert camera(region=region, binning=2).mode.frame_shape((512, 512)) == (50, 30)


@given(corners, corners, sizes, sizes)
def test_a_region_fits_if_its_last_pixel_is_on_the_sensor(y: int, x: int, height: int, width: int) -> None:
    region = {"y": y, "x": x, "height": height, "width": width}
    setting_error = camera(region=region).sensor_conflict((512, 400))
    assert (setting_error == "") == (y + height <= 512 and x + width <= 400)
    if setting_error:
        assert f"`region` ends at row {y + height} and column {x + width}" in setting_error
        assert "512 x 400" in setting_error


@given(sizes, sizes, st.integers(1, 8))
def test_what_cannot_be_binned_is_refused(height: int, width: int, binning: int) -> None:
    fits = height % binning == 0 and width % binning == 0
    message = "" if fits else f"{height} x {width} pixels cannot be binned by {binning}; choose a `region`"
    assert camera(binning=binning).sensor_conflict((height, width)).startswith(message)
    assert bool(camera(binning=binning).sensor_conflict((height, width))) != fits
    region = {"height": height, "width": width}
    if fits:
        assert camera(region=region, binning=binning).sensor_conflict((600, 600)) == ""
    else:
        with pytest.raises(ValidationError, match="cannot be binned"):
            camera(region=region, binning=binning)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"region": {"height": 10}}, "width"),
        ({"region": {"height": 0, "width": 5}}, "greater than 0"),
        ({"region": {"y": -1, "height": 5, "width": 5}}, "greater than or equal to 0"),
        ({"region": [0, 0, 10, 10]}, "region"),
        ({"binning": 0}, "greater than 0"),
        ({"max_exposure": 0}, "greater than 0"),
        ({"max_exposure": "10 px"}, "'px' in '10 px' is not a unit of time"),
        ({"gain": 3}, "gain"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        camera(**settings)


@pytest.mark.parametrize("given_as", ["-70 degC", "203.15 K", 203.15])
def test_a_temperature_is_given_in_degrees_celsius_or_kelvins(given_as: Any) -> None:
    assert Cooling(given_as).temperature_k == pytest.approx(203.15)


@pytest.mark.parametrize("given_as", ["-70", -70, "-70 K", "-124 degC", "51 degC", "300 uK"])
def test_what_is_no_temperature_of_a_sensor_is_refused(given_as: Any) -> None:
    with pytest.raises(ValidationError, match=r"degC|'-70' has no unit"):
        Cooling(given_as)
