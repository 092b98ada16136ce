from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.config import MOTION_KEYS, Document, MotionSettings, ProfileSpec, load_profile
from labseq.config.profile import GridSettings, TimeoutSettings
from labseq.errors import ConfigError
from labseq.model import MotionSpec, SiteGrid
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
