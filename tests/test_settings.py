"""The types of settings: quantities in SI, durations, frozen models."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from labseq.settings import (
    Angle,
    Duration,
    Fraction,
    Frequency,
    Length,
    Settings,
    Speed,
    Temperature,
    Voltage,
)


class Model(Settings):
    time: Duration = 0.0
    length: Length = 0.0
    frequency: Frequency = 0.0
    speed: Speed = 1.0
    voltage: Voltage = 0.0
    temperature: Temperature = 0.0
    angle: Angle = 0.0
    fraction: Fraction = 0.0


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("time", "45 ms", 0.045),
        ("time", 2, 2.0),
        ("speed", "130 um/ms", 0.13),
        ("angle", "180 deg", 3.141592653589793),
        ("fraction", "75 %", 0.75),
    ],
)
def test_quantities_are_si(name: str, value: object, expected: float) -> None:
    assert getattr(Model.model_validate({name: value}), name) == expected


@pytest.mark.parametrize("value", [True, None, [1], "1 K", float("inf"), -1])
def test_no_duration(value: object) -> None:
    with pytest.raises(ValidationError):
        Model.model_validate({"time": value})


def test_settings_are_frozen_and_know_their_keys() -> None:
    model = Model()
    with pytest.raises(ValidationError):
        model.time = 1.0
    with pytest.raises(ValidationError):
        Model.model_validate({"tmie": 1})
