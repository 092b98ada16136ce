"""Hardware profiles, right and wrong: values, and the first message exactly."""

# ruff: noqa: E501 - messages are quoted as they are printed

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from labseq.config.document import Document
from labseq.config.profile import (
    MOTION_KEYS,
    CalibrationSettings,
    ChannelSettings,
    GridSettings,
    MotionSettings,
    ProfileSpec,
    RfSettings,
    TimeoutSettings,
    load_profile,
)
from labseq.config.scan import read_scan
from labseq.config.sequence import load_sequence
from labseq.errors import ConfigError
from labseq.model import CALIBRATION_KINDS, MotionSpec, RfSpec, SiteGrid
from labseq.settings import Settings

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="module")
def loaded() -> tuple[Document, ProfileSpec]:
    return load_profile("profile.yaml", beside=DATA)


def with_options(*overrides: tuple[str, str]) -> ProfileSpec:
    return load_profile("profile.yaml", beside=DATA, overrides=overrides)[1]


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


def test_default_grid_is_the_paper_s() -> None:
    grid, paper = GridSettings(rows=20, cols=20, spacing=4.49e-6).model(), SiteGrid()
    np.testing.assert_array_equal(grid.positions_m, paper.positions_m)
    np.testing.assert_array_equal(grid.row_frequency_hz, paper.row_frequency_hz)


def test_motion(loaded: tuple[Document, ProfileSpec]) -> None:
    assert loaded[1].motion == MotionSpec(pick_up_s=60e-6, speed_m_s=0.13, max_tweezers=16)


def test_default_motion_is_the_core_s() -> None:
    assert MotionSettings().spec() == MotionSpec()


@pytest.mark.parametrize("key", MOTION_KEYS)
def test_every_motion_key_reaches_the_core(key: str) -> None:
    value: dict[str, Any] = {"speed_profile": "minimum_jerk", "rf": {"phases": "low_crest"}}
    changed = MotionSettings.model_validate({key: value.get(key, 7)}).spec()
    different = [
        field.name
        for field in dataclasses.fields(MotionSpec)
        if getattr(changed, field.name) != getattr(MotionSpec(), field.name)
    ]
    assert len(different) == 1
    assert different[0].removesuffix("_s").removesuffix("_m") == key


def test_every_key_of_a_line_reaches_the_core() -> None:
    channel = ChannelSettings.model_validate(
        {"channel": 3, "on": ["image"], "lead": "2 ms", "lag": "1 ms", "blinding": True, "active_low": True}
    )
    spec = channel.spec("probe")
    assert (spec.name, spec.channel, spec.on, spec.blinding, spec.active_low) == (
        *("probe", 3, frozenset({"image"})),
        *(True, True),
    )
    assert (spec.lead_s, spec.lag_s) == (2e-3, 1e-3)


def test_motion_keys_and_the_plugin_s_share_a_mapping(loaded: tuple[Document, ProfileSpec]) -> None:
    class Plugin(Settings):
        band_centre: str = ""

    document, spec = loaded
    loc, drop = spec.mobile_tweezers.loc, {"use", *MOTION_KEYS}
    assert document.validate(Plugin, loc, drop=drop, other_keys=MOTION_KEYS).band_centre == "100 MHz"
    wrong = document.override("mobile_tweezers.sped", "1", "--set")
    with pytest.raises(
        ConfigError, match=r"^--set: 'sped' is not a .* one of band_centre, pick_up,.* 'speed'\?$"
    ):
        wrong.validate(Plugin, loc, drop=drop, other_keys=MOTION_KEYS)


def test_what_may_be_left_out() -> None:
    text = (DATA / "profile.yaml").read_text(encoding="utf-8")
    short = text[: text.index("devices:")]
    document = Document.parse(short, "p.yaml")
    spec = document.validate(ProfileSpec)
    assert spec.devices == {}
    assert spec.simulation is None
    assert spec.plugin_folders == []
    assert spec.timeouts == TimeoutSettings()
    empty = Document.parse(short + "devices:\nsimulation:\ntimeouts:\nplugin_folders:\n", "p.yaml")
    assert empty.validate(ProfileSpec) == spec


def test_options_reach_the_profile() -> None:
    assert with_options(("mobile_tweezers.speed", "100 um/ms")).motion.speed_m_s == 0.1
    assert with_options(("timeouts.plan", "1 s")).timeouts.plan == 1.0
    assert with_options(("grid.column_frequency.step", "1 MHz")).grid.column_frequency.step == 1e6


@pytest.mark.parametrize(
    ("address", "value", "message"),
    [
        ("grid.rows", "0", "rows is 0; expected at least 1"),
        ("camra.gain", "3", "there is no 'camra' in "),
        (
            "devices.shuter.use",
            "x",
            "there is no 'shuter' in 'devices'; expected shutter; did you mean 'shutter'?",
        ),
    ],
)
def test_wrong_options_are_named_in_full(address: str, value: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        with_options((address, value))
    assert str(caught.value).startswith(f"--set profile.{address}={value}: {message}")


def test_sequence_in_place_of_a_profile() -> None:
    with pytest.raises(ConfigError, match=r":14:1: this is a sequence .* expected a hardware profile$"):
        load_profile("sequence.yaml", beside=DATA)


@pytest.mark.parametrize("model", [ProfileSpec, GridSettings, MotionSettings, TimeoutSettings])
def test_every_setting_is_described(model: type[Settings]) -> None:
    assert all(field.description for field in model.model_fields.values())


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
        "p.yaml:2:1: 'camera' is missing (the camera's plugin)",
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
        "comb that begins at zero",
        "{centre: 100 MHz, step: -1.6 MHz}",
        "{centre: 95 MHz, step: 10 MHz}",
        "p.yaml:10:18: the lowest of the 20 tones is at 0 Hz; expected all tones above 0 Hz; choose a smaller step",
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


PROFILE = """labseq: 1
name: bench
grid: {rows: 3, cols: 4, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold}
"""


def read(folder: Path, text: str = "", *overrides: tuple[str, str]) -> CalibrationSettings:
    path = folder / "bench.yaml"
    path.write_text(PROFILE + text, "utf-8")
    return load_profile(path, beside=folder, overrides=overrides)[1].calibrations


def test_without_a_word_the_ones_in_use_count(tmp_path: Path) -> None:
    for text in ("", "calibrations:\n", "calibrations: {use: }\n"):
        settings = read(tmp_path, text)
        assert settings.folder is None
        assert {settings.use.of(kind) for kind in CALIBRATION_KINDS} == {None}


def test_off_puts_all_of_them_aside(tmp_path: Path) -> None:
    settings = read(tmp_path, "calibrations: off\n")
    assert {settings.use.of(kind) for kind in CALIBRATION_KINDS} == {"off"}


@pytest.mark.parametrize("text", ["calibrations: ../store\n", "calibrations: {folder: ../store}\n"])
def test_a_folder_is_relative_to_the_file(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, text).folder == tmp_path / ".." / "store"


def test_one_of_each_kind_may_be_chosen(tmp_path: Path) -> None:
    settings = read(tmp_path, "calibrations: {use: {sites: f102b3, overlay: off}}\n")
    assert [settings.use.of(kind) for kind in ("sites", "overlay", "tweezers")] == ["f102b3", "off", None]


def test_an_option_may_choose_where_the_file_says_nothing(tmp_path: Path) -> None:
    assert read(tmp_path, "", ("calibrations", "off")).use.sites == "off"
    assert read(tmp_path, "", ("calibrations.use.sites", "f102b3")).use.sites == "f102b3"
    folder = read(tmp_path, "calibrations: {folder: store}\n", ("calibrations.folder", "other")).folder
    assert folder == tmp_path / "other"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("calibrations: {use: {site: x}}", "'site' is not a setting of 'use'.*did you mean 'sites'"),
        ("calibrations: {use: {sites: 123}}", "sites is 123; expected text; put it in quotes"),
        ("calibrations: 5", "calibrations is 5; expected a mapping"),
        ("calibrations: {fold: x}", "'fold' is not a setting of 'calibrations'"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"bench.yaml:8:\d+: {message}"):
        read(tmp_path, text)


def test_calibrations_are_not_scanned(tmp_path: Path) -> None:
    read(tmp_path, "calibrations: {use: {sites: abc}}\n")
    sequence = tmp_path / "scan.yaml"
    sequence.write_text(
        "labseq: 1\nname: x\nprofile: bench\ntarget: {pattern: compact, rows: 2, cols: 2}\n"
        "planner: {use: psca}\nscan: {profile.calibrations.use.sites: [abc, def]}\nshot: [{image: {}}]\n",
        "utf-8",
    )
    document, *_ = load_sequence(sequence)
    scan = read_scan(document, [])
    assert scan is not None
    profile, _ = load_profile(tmp_path / "bench.yaml", beside=tmp_path)
    with pytest.raises(ConfigError, match="a scan cannot change"):
        scan.bound(profile)
