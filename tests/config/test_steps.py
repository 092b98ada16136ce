from __future__ import annotations

import pytest
from pydantic import BaseModel

from labseq.config import (
    DeviceSettings,
    Document,
    ImageSettings,
    LoadSettings,
    RearrangeSettings,
    WaitSettings,
)

STEPS: list[type[BaseModel]] = [LoadSettings, ImageSettings, RearrangeSettings, WaitSettings, DeviceSettings]


def rearrange(text: str) -> RearrangeSettings:
    return Document.parse(f"rearrange: {{{text}}}", "f.yaml").validate(RearrangeSettings, ("rearrange",))


def test_defaults() -> None:
    assert LoadSettings().duration == 0.5
    assert ImageSettings().exposure == 0.045
    assert RearrangeSettings().model_dump() == {
        "cycles": 1,
        "window": 0.06,
        "exposure": 0.045,
        "stop_when": "defect_free",
        "window_mode": "early",
    }
    assert DeviceSettings(name="shutter", do="open").timeout == 10.0


def test_one_window_for_all_cycles() -> None:
    settings = rearrange("cycles: 3, window: 40 ms")
    assert [settings.window_of(cycle) for cycle in (1, 2, 3)] == [0.04, 0.04, 0.04]


def test_a_window_for_each_cycle() -> None:
    settings = rearrange("cycles: 3, window: [60 ms, 0.05, 1e-2]")
    assert [settings.window_of(cycle) for cycle in (1, 2, 3)] == [0.06, 0.05, 0.01]


@pytest.mark.parametrize("value", ["2", "1.5", "true", "'on'", "null"])
def test_arguments_keep_their_type(value: str) -> None:
    document = Document.parse(f"device: {{name: a, do: b, arguments: {{x: {value}}}}}", "f.yaml")
    arguments = document.validate(DeviceSettings, ("device",)).arguments
    expected = document.get(("device", "arguments"))
    assert arguments == expected
    assert type(arguments["x"]) is type(expected["x"])


def test_empty_arguments() -> None:
    document = Document.parse("device: {name: a, do: b, arguments: }", "f.yaml")
    assert document.validate(DeviceSettings, ("device",)).arguments == {}


@pytest.mark.parametrize("model", STEPS)
def test_every_setting_is_described(model: type[BaseModel]) -> None:
    assert all(field.description for field in model.model_fields.values())
