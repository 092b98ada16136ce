from __future__ import annotations

import pytest

from labseq.builtin.probes import CheckOverlaySettings, CheckSitesSettings, ProbeSettings
from labseq.builtin.rearrange import RearrangeSettings
from labseq.builtin.steps import DeviceSettings, ImageSettings, LoadSettings
from labseq.config.document import Document


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


@pytest.mark.parametrize(
    ("window", "expected"), [("40 ms", [0.04] * 3), ("[60 ms, 0.05 s, 1e-2 s]", [0.06, 0.05, 0.01])]
)
def test_one_window_for_all_cycles_or_one_for_each(window: str, expected: list[float]) -> None:
    text = f"rearrange: {{cycles: 3, window: {window}}}"
    settings = Document.parse(text, "f.yaml").validate(RearrangeSettings, ("rearrange",))
    assert [settings.window_of(cycle) for cycle in range(3)] == expected


def test_a_probe_reads_its_offset_with_units() -> None:
    document = Document.parse("probe: {offset: [0.3 um, -50 nm], pattern: cross}", "f.yaml")
    settings = document.validate(ProbeSettings, ("probe",))
    assert settings.offset == (0.3e-6, -50e-9)
    assert (settings.hold, settings.drop_off, settings.pattern, settings.sites) == (
        0.2e-3,
        5e-6,
        "cross",
        "seen",
    )


def test_checks_read_their_limits() -> None:
    document = Document.parse("a: {limit_px: 0.3, exceeded: stop}\nb: {every: 5, limit: 80 nm}", "f.yaml")
    assert document.validate(CheckSitesSettings, ("a",)).model_dump() == {
        "every": 1,
        "limit_px": 0.3,
        "spot_px": 1.2,
        "exceeded": "stop",
    }
    overlay = document.validate(CheckOverlaySettings, ("b",))
    assert (overlay.every, overlay.limit, overlay.offset, overlay.exceeded) == (5, 80e-9, 0.9e-6, "warn")


@pytest.mark.parametrize("value", ["2", "1.5", "true", "'on'", "null"])
def test_arguments_keep_their_type(value: str) -> None:
    document = Document.parse(f"device: {{name: a, do: b, arguments: {{x: {value}}}}}", "f.yaml")
    found, expected = (
        document.validate(DeviceSettings, ("device",)).arguments["x"],
        document.get(("device", "arguments", "x")),
    )
    assert (found, type(found)) == (expected, type(expected))
