"""Hardware profiles, right and wrong: values, and the first message about each mistake exactly."""

# ruff: noqa: E501 - messages are quoted as they are printed

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.config.addresses import Override, split_overrides
from labseq.config.document import Document
from labseq.config.profile import (
    BudgetSettings,
    CalibrationSettings,
    GridSettings,
    LinesChoice,
    ProfileSpec,
    load_profile,
)
from labseq.errors import ConfigError
from labseq.model import CALIBRATION_KINDS, LineSpec, MotionSpec, SiteGrid
from labseq.model.policies import Timeouts
from labseq.settings import Settings
from tests.config.wrong_files import wrong_files

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="module")
def loaded() -> tuple[Document, ProfileSpec]:
    return load_profile(DATA / "profile.yaml")


def test_choices(loaded: tuple[Document, ProfileSpec]) -> None:
    document, spec = loaded
    assert {role: (choice.use, choice.loc) for role, choice in spec.choices.items()} == {
        "camera": ("virtual", ("camera",)),
        "static_tweezers": ("virtual", ("static_tweezers",)),
        "mobile_tweezers": ("virtual", ("mobile_tweezers",)),
        "detector": ("threshold", ("detector",)),
        "simulation": ("virtual", ("simulation",)),
    }
    shutter = spec.devices["shutter"]
    assert (shutter.use, shutter.loc, shutter.key) == ("virtual", ("devices", "shutter"), "use")
    assert document.get((*spec.camera.loc, "readout")) == "5 ms"


def test_grid(loaded: tuple[Document, ProfileSpec]) -> None:
    grid = loaded[1].grid_model()
    assert (grid.shape, grid.spacing_m, grid.lattice, grid.shear) == ((20, 20), 4.49e-6, "triangular", -1)
    np.testing.assert_allclose(grid.row_frequency_hz, 100e6 - 1.6e6 * (np.arange(20) - 9.5))
    np.testing.assert_array_equal(grid.column_frequency_hz, SiteGrid().column_frequency_hz)


def test_motion(loaded: tuple[Document, ProfileSpec]) -> None:
    assert loaded[1].motion == MotionSpec(pick_up_s=60e-6, speed_m_s=0.13, max_tweezers=16)


def test_lines_have_the_names_that_they_stand_under_and_the_order_of_their_channels() -> None:
    text = "use: box\nchannels: {probe: {channel: 3, on: [image], lead: 2 ms}, mot: {channel: 1}}\n"
    lines = Document.parse(text, "p.yaml").validate(LinesChoice)
    assert lines.specs() == (LineSpec("mot", 1), LineSpec("probe", 3, ("image",), lead_s=2e-3))


def test_motion_keys_and_the_plugin_s_share_a_mapping(loaded: tuple[Document, ProfileSpec]) -> None:
    class Plugin(Settings):
        band_centre: str = ""

    document, spec = loaded
    loc, core_keys = spec.mobile_tweezers.loc, spec.mobile_tweezers.core_keys
    assert document.validate(Plugin, loc, core_keys=core_keys).band_centre == "100 MHz"
    wrong = document.override("mobile_tweezers.sped", "1", "--set")
    with pytest.raises(
        ConfigError, match=r"^--set: 'sped' is not a .* one of band_centre, clearance,.* 'speed'\?$"
    ):
        wrong.validate(Plugin, loc, core_keys=core_keys)


def test_what_may_be_left_out() -> None:
    text = (DATA / "profile.yaml").read_text(encoding="utf-8")
    short = text[: text.index("devices:")]
    document = Document.parse(short, "p.yaml")
    spec = document.validate(ProfileSpec)
    assert spec.devices == {}
    assert spec.simulation is None
    assert spec.plugin_folders == []
    assert spec.timeouts == Timeouts()
    empty = Document.parse(short + "devices:\nsimulation:\ntimeouts:\nplugin_folders:\n", "p.yaml")
    assert empty.validate(ProfileSpec) == spec


def test_default_budgets_are_those_of_a_computer_that_keeps_up() -> None:
    assert all(1e-3 <= budget_s <= 0.1 for budget_s in BudgetSettings().model_dump().values())


def test_the_grid_of_the_paper_is_the_default() -> None:
    grid, paper = GridSettings(rows=20, cols=20, spacing=4.49e-6).model(), SiteGrid()
    np.testing.assert_array_equal(grid.positions_m, paper.positions_m)
    np.testing.assert_array_equal(grid.row_frequency_hz, paper.row_frequency_hz)


def with_option(address: str, value: str) -> ProfileSpec:
    return load_profile(DATA / "profile.yaml", overrides=split_overrides([f"profile.{address}={value}"])[1])[
        1
    ]


def test_options_reach_the_profile() -> None:
    assert with_option("timeouts.plan", "1 s").timeouts.plan_s == 1.0
    assert with_option("grid.column_frequency.step", "1 MHz").grid.column_frequency.step == 1e6
    assert with_option("mobile_tweezers.rf.max_peak", "1.5 V").motion.rf.max_peak_v == 1.5
    table = "[98 MHz, 100.1 MHz, 102 MHz]"
    options = [("grid.cols", "3"), ("grid.column_frequency", f"{{table: {table}}}")]
    grid = load_profile(DATA / "profile.yaml", overrides=[Override(*option) for option in options])[
        1
    ].grid_model()
    np.testing.assert_array_equal(grid.column_frequency_hz, [98e6, 100.1e6, 102e6])


@pytest.mark.parametrize(
    ("address", "value", "message"),
    [
        ("grid.rows", "0", "rows is 0; expected at least 1"),
        ("camra.gain", "3", "there is no 'camra' in "),
        ("devices.shuter.use", "x", "there is no 'shuter' in 'devices'; expected shutter; did you mean 'sh"),
        ("mobile_tweezers.rf.max_peek", "1 V", "'max_peek' is not a setting of 'rf'"),
        (
            "mobile_tweezers.rf.row_band",
            "[110 MHz, 90 MHz]",
            "row_band: the band goes from 110 MHz to 90 MHz",
        ),
        ("mobile_tweezers.rf.max_mean_power", "3 V", "max_mean_power: '3 V' is a voltage, not a power"),
        ("grid.column_frequency", "{centre: 95 MHz, step: 10 MHz}", "the lowest of the 20 tones is at 0 Hz"),
        ("grid.column_frequency.table", "[98 MHz, 100 MHz]", "there are 2 tones for 20 sites"),
        ("grid.column_frequency.table", "[98 MHz, 102 MHz, 100 MHz]", "table: the tones neither rise nor f"),
    ],
)
def test_a_wrong_option_is_named_in_full(address: str, value: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        with_option(address, value)
    assert f"--set profile.{address}={value}: {message}" in str(caught.value)


WRONG = """
static_tweezers: => static_tweezer:
  12:1: 'static_tweezer' is not a setting of a hardware profile; expected one of labseq, name, grid, camera, static_tweezers, mobile_tweezers, detector, devices, lines, simulation, equalise, calibrations, plugin_folders, variables, timeouts, budgets, alarms; did you mean 'static_tweezers'?
camera: {use: virtual, readout: 5 ms}⏎ => ∅
  2:1: 'camera' is missing (the camera's plugin)
camera: {use: virtual, readout: 5 ms} => camera: virtual
  11:9: there is only 'virtual' here; expected a mapping; write '{use: virtual}'
rows: 20 => rows: 0
  5:9: rows is 0; expected at least 1
4.49 um => 4.49 MHz
  7:12: spacing: '4.49 MHz' is a frequency, not a length; expected a length such as '4.49 um' (m, mm, um, nm)
lattice: tri => latice: tri
  8:3: 'latice' is not a setting of 'grid'; expected one of rows, cols, spacing, lattice, shear, row_frequency, column_frequency; did you mean 'lattice'?
shear: -1 => shear: 0
  9:10: shear is 0; expected 1 or -1
step: -1.6 MHz => step: 16 MHz
  10:18: the lowest of the 20 tones is at -52 MHz; expected all tones above 0 Hz; choose a smaller step
step: -1.6 MHz => step: 0
  10:42: step: a step of 0 puts all tones at one frequency; expected another value
speed: 130 um/ms => speed: 0
  18:10: speed is 0; expected more than 0
speed: 130 um/ms => speed: 130 um
  18:10: speed: '130 um' is a length, not a speed; expected a speed such as '130 um/ms' (m/s, mm/s, mm/ms, um/ms, um/us, um/s)
  use: virtual⏎  band =>   band
  15:3: 'use' is missing from 'mobile_tweezers' (the name of a plugin)
shutter: => camera:
  22:3: a device is called 'camera', like a role; expected another name
shutter: => my shutter:
  22:3: a device is called 'my shutter'; expected a word of letters, digits, '_' and '-' that begins with a letter
shutter: {use: virtual} => shutter: virtual
  22:12: there is only 'virtual' here; expected a mapping; write '{use: virtual}'
shutter: {use: virtual} => shutter: {us: virtual}
  22:12: 'use' is missing from 'shutter' (the name of a plugin); did you write 'us' for it?
shutter: {use: virtual} => shutter: {use: virtual, role: camera, blinding: {}}
  22:41: `blinding` is set for a camera; expected `role: device` with it
shutter: {use: virtual} => shutter: {use: virtual}⏎equalise: {device: shuter}
  23:20: there is no device 'shuter'; expected 'camera', 'shutter'
{call: 3 s} => {call:3 s}
  25:12: 'call:3 s' is not a setting of 'timeouts'; expected one of call, safe_state, plan, load; put a space after the ':'
grid: => shot:
  4:1: this is a sequence (it has the key 'shot'); expected a hardware profile
labseq: 1 => labseq: 3
  2:9: this file is for a newer labseq (its format is 3, this labseq reads 1); update labseq
"""


@pytest.mark.parametrize(("old", "new", "message"), wrong_files(WRONG))
def test_the_first_message(tmp_path: Path, old: str, new: str, message: str) -> None:
    good = (DATA / "profile.yaml").read_text(encoding="utf-8")
    assert old in good
    path = tmp_path / "p.yaml"
    path.write_bytes(good.replace(old, new, 1).encode())
    with pytest.raises(ConfigError) as caught:
        load_profile(path)
    assert str(caught.value.problems[0]) == f"{path}:{message}"


def calibrations(folder: Path, text: str, *overrides: tuple[str, str]) -> CalibrationSettings:
    path = folder / "bench.yaml"
    path.write_text((DATA / "profile.yaml").read_text("utf-8") + text, "utf-8")
    return load_profile(path, overrides=[Override(*override) for override in overrides])[1].calibrations


@pytest.mark.parametrize(
    ("text", "override", "use", "folder"),
    [
        ("", None, {}, None),
        ("calibrations: {use: }", None, {}, None),
        ("calibrations: off", None, dict.fromkeys(CALIBRATION_KINDS, "off"), None),
        ("calibrations: ../store", None, {}, "../store"),
        ("calibrations: {folder: ../store}", None, {}, "../store"),
        ("calibrations: {folder: store}", ("calibrations.folder", "other"), {}, "other"),
        ("calibrations: {use: {sites: a1, overlay: off}}", None, {"sites": "a1", "overlay": "off"}, None),
        ("", ("calibrations.use.sites", "a1"), {"sites": "a1"}, None),
        ("", ("calibrations", "off"), dict.fromkeys(CALIBRATION_KINDS, "off"), None),
    ],
)
def test_calibrations_are_chosen_by_file_and_option(
    tmp_path: Path, text: str, override: tuple[str, str] | None, use: dict[str, str], folder: str | None
) -> None:
    found = calibrations(tmp_path, text, *([override] if override else []))
    assert {kind: found.use.of(kind) for kind in CALIBRATION_KINDS if found.use.of(kind) is not None} == use
    assert found.folder == (folder and tmp_path / folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("calibrations: {use: {site: x}}", "'site' is not a setting of 'use'.*did you mean 'sites'"),
        ("calibrations: {use: {sites: 123}}", "sites is 123; expected text; put it in quotes"),
        ("calibrations: 5", "calibrations is 5; expected a mapping"),
    ],
)
def test_a_wrong_choice_of_calibrations_has_its_place(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"bench.yaml:26:\d+: {message}"):
        calibrations(tmp_path, text)


PULSE = {"channel": 0, "on": ["load"], "pulse": "1 ms"}
TRIGGER = {"channel": 0, "on": ["image"], "triggers": "camera"}


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"a": PULSE, "b": PULSE}, "'a' and 'b' are both on channel 0"),
        ({"a": TRIGGER, "b": TRIGGER | {"channel": 1}}, "'a' and 'b' both trigger the camera"),
        ({"a": TRIGGER | {"lead": "1 ms"}}, "lead is set for a trigger"),
        ({"a": PULSE | {"lag": "1 ms"}}, "both lag and pulse are set"),
        ({"a": PULSE | {"on": ["load", "idle"]}}, "a pulse has 'idle' among its steps"),
        (
            {"a": PULSE | {"channel": "ao0"}},
            "a whole number, or a name with a slash such as 'Dev1/port0/line3'",
        ),
    ],
)
def test_lines_that_contradict_themselves_are_refused(channels: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LinesChoice.model_validate({"use": "box", "channels": channels})


def test_lines_are_in_the_order_of_their_outputs() -> None:
    outputs = [10, "Dev1/port0/line10", "Dev1/port0/line9", 9]
    channels = {f"line_{i}": {"channel": output} for i, output in enumerate(outputs)}
    choice = LinesChoice.model_validate({"use": "box", "channels": channels})
    assert [spec.channel for spec in choice.specs()] == [9, 10, "Dev1/port0/line9", "Dev1/port0/line10"]
