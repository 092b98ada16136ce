"""Wrong profiles, and what is said of them: the first message, exactly."""

# ruff: noqa: E501 - messages stand here as they are printed

from __future__ import annotations

from pathlib import Path

import pytest

from labseq.config import load_profile
from labseq.errors import ConfigError

GOOD = (Path(__file__).parent / "data" / "profile.yaml").read_text(encoding="utf-8")

CASES = [
    (
        "role misspelt",
        "static_tweezers:",
        "static_tweezer:",
        "p.yaml:12:1: 'static_tweezer' is not a setting of a hardware profile; expected one of labseq, name, grid, camera, static_tweezers, mobile_tweezers, detector, devices, lines, simulation, calibrations, plugin_folders, variables, timeouts, budgets; did you mean 'static_tweezers'?",
    ),
    (
        "role missing",
        "camera: {use: virtual, readout: 5 ms}\n",
        "",
        "p.yaml:2:1: 'camera' is missing (what takes images)",
    ),
    (
        "role by name alone",
        "camera: {use: virtual, readout: 5 ms}",
        "camera: virtual",
        "p.yaml:11:9: just 'virtual' stands here; expected a mapping; write '{use: virtual}'",
    ),
    (
        "role empty",
        "camera: {use: virtual, readout: 5 ms}",
        "camera:",
        "p.yaml:11:8: camera is empty; expected a mapping (key: value)",
    ),
    ("no rows", "rows: 20", "rows: 0", "p.yaml:5:9: rows is 0; expected at least 1"),
    ("too many columns", "cols: 20", "cols: 1001", "p.yaml:6:9: cols is 1001; expected at most 1000"),
    (
        "spacing as a frequency",
        "4.49 um",
        "4.49 MHz",
        "p.yaml:7:12: spacing: '4.49 MHz' is a frequency, not a length; expected a length such as '4.49 um' (m, mm, um, nm) or a plain number in m",
    ),
    ("spacing of zero", "4.49 um", "0 um", "p.yaml:7:12: spacing is '0 um'; expected more than 0"),
    (
        "grid key misspelt",
        "lattice: tri",
        "latice: tri",
        "p.yaml:8:3: 'latice' is not a setting of 'grid'; expected one of rows, cols, spacing, lattice, shear, row_frequency, column_frequency; did you mean 'lattice'?",
    ),
    (
        "lattice",
        "lattice: triangular",
        "lattice: triangel",
        "p.yaml:8:12: lattice is 'triangel'; expected 'triangular' or 'square'; did you mean 'triangular'?",
    ),
    ("shear", "shear: -1", "shear: 0", "p.yaml:9:10: shear is 0; expected 1 or -1"),
    (
        "comb below zero",
        "step: -1.6 MHz",
        "step: 16 MHz",
        "p.yaml:10:18: the lowest of the 20 tones is at -52 MHz; expected all tones above 0 Hz; choose a smaller step",
    ),
    (
        "comb of one frequency",
        "step: -1.6 MHz",
        "step: 0",
        "p.yaml:10:42: step: a step of 0 puts all tones at one frequency; expected another value",
    ),
    (
        "comb key misspelt",
        "{centre: 100",
        "{center: 100",
        "p.yaml:10:19: 'center' is not a setting of 'row_frequency'; expected one of centre, step, table; did you mean 'centre'?",
    ),
    (
        "comb as a number",
        "row_frequency: {centre: 100 MHz, step: -1.6 MHz}",
        "row_frequency: 100 MHz",
        "p.yaml:10:18: row_frequency is '100 MHz'; expected a mapping (key: value)",
    ),
    (
        "motion of zero speed",
        "speed: 130 um/ms",
        "speed: 0",
        "p.yaml:18:10: speed is 0; expected more than 0",
    ),
    (
        "motion with what cannot be seen",
        "speed: 130 um/ms",
        'speed: "130\\0"',
        r"p.yaml:18:10: speed: '\x00' in '130\x00' is not a unit of speed; expected a speed such as '130 um/ms' (m/s, mm/s, mm/ms, um/ms, um/us, um/s) or a plain number in m/s",
    ),
    (
        "motion in the wrong unit",
        "speed: 130 um/ms",
        "speed: 130 um",
        "p.yaml:18:10: speed: '130 um' is a length, not a speed; expected a speed such as '130 um/ms' (m/s, mm/s, mm/ms, um/ms, um/us, um/s) or a plain number in m/s",
    ),
    (
        "motion with half a tweezer",
        "max_tweezers: 16",
        "max_tweezers: 1.5",
        "p.yaml:19:17: max_tweezers is 1.5; expected a whole number",
    ),
    (
        "motion without a plugin",
        "  use: virtual\n  band",
        "  band",
        "p.yaml:15:3: 'use' is missing from 'mobile_tweezers' (the name of a plugin)",
    ),
    (
        "device called like a role",
        "shutter:",
        "camera:",
        "p.yaml:22:3: a device is called 'camera', like a role; expected another name",
    ),
    (
        "device with a space",
        "shutter:",
        "my shutter:",
        "p.yaml:22:3: a device is called 'my shutter'; expected a word of letters, digits, '_' and '-' that begins with a letter",
    ),
    (
        "device by name alone",
        "shutter: {use: virtual}",
        "shutter: virtual",
        "p.yaml:22:12: just 'virtual' stands here; expected a mapping; write '{use: virtual}'",
    ),
    (
        "device without use",
        "shutter: {use: virtual}",
        "shutter: {us: virtual}",
        "p.yaml:22:12: 'use' is missing from 'shutter' (the name of a plugin); did you write 'us' for it?",
    ),
    (
        "device empty",
        "shutter: {use: virtual}",
        "shutter:",
        "p.yaml:22:11: shutter is empty; expected a mapping (key: value)",
    ),
    (
        "timeout misspelt",
        "{call: 3 s}",
        "{cal: 3 s}",
        "p.yaml:25:12: 'cal' is not a setting of 'timeouts'; expected one of call, safe_state, plan, load; did you mean 'call'?",
    ),
    (
        "no space after a colon in braces",
        "{call: 3 s}",
        "{call:3 s}",
        "p.yaml:25:12: 'call:3 s' is not a setting of 'timeouts'; expected one of call, safe_state, plan, load; put a space after the ':'",
    ),
    ("timeout of zero", "{call: 3 s}", "{call: 0 s}", "p.yaml:25:18: call is '0 s'; expected more than 0"),
    (
        "a sequence",
        "grid:",
        "shot:",
        "p.yaml:4:1: this is a sequence (it has the key 'shot'); expected a hardware profile",
    ),
    (
        "newer format",
        "labseq: 1",
        "labseq: 3",
        "p.yaml:2:9: this file is written for a newer labseq: its format is 3, this labseq reads 1; update labseq",
    ),
]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("p.yaml")


def test_the_good_one_is_good(here: Path) -> None:
    here.write_text(GOOD, encoding="utf-8")
    load_profile("p.yaml", beside=Path())


@pytest.mark.parametrize(("old", "new", "message"), [pytest.param(*case[1:], id=case[0]) for case in CASES])
def test_first_message(here: Path, old: str, new: str, message: str) -> None:
    assert old in GOOD
    here.write_bytes(GOOD.replace(old, new, 1).encode())

    with pytest.raises(ConfigError) as caught:
        load_profile("p.yaml", beside=Path())

    assert str(caught.value.problems[0]) == message
