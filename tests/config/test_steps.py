from __future__ import annotations

import pytest

from labseq.builtin.probes import CheckOverlaySettings, CheckSitesSettings, ProbeSettings
from labseq.builtin.rearrange import RearrangeSettings
from labseq.builtin.steps import DeviceSettings
from labseq.config.document import Document


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
    assert settings.pattern == "cross"


def test_checks_read_their_limits() -> None:
    document = Document.parse("a: {limit_px: 0.3, exceeded: stop}\nb: {every: 5, limit: 80 nm}", "f.yaml")
    sites, overlay = (
        document.validate(CheckSitesSettings, ("a",)),
        document.validate(CheckOverlaySettings, ("b",)),
    )
    assert (sites.limit_px, sites.exceeded) == (0.3, "stop")
    assert (overlay.every, overlay.limit) == (5, 80e-9)


@pytest.mark.parametrize("value", ["2", "1.5", "true", "'on'", "null"])
def test_arguments_keep_their_type(value: str) -> None:
    document = Document.parse(f"device: {{name: a, do: b, arguments: {{x: {value}}}}}", "f.yaml")
    found, expected = (
        document.validate(DeviceSettings, ("device",)).arguments["x"],
        document.get(("device", "arguments", "x")),
    )
    assert (found, type(found)) == (expected, type(expected))
