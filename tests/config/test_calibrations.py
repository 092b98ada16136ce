from __future__ import annotations

from pathlib import Path

import pytest

from labseq.config import CalibrationSettings, bind_scan, load_profile, load_sequence, read_scan
from labseq.errors import ConfigError
from labseq.model import CALIBRATION_KINDS

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
    document, _ = load_sequence(sequence)
    scan = read_scan(document, [])
    assert scan is not None
    profile, _ = load_profile(tmp_path / "bench.yaml", beside=tmp_path)
    with pytest.raises(ConfigError, match="a scan cannot change"):
        bind_scan(scan, profile)
