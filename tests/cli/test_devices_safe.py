"""``labseq safe`` on profiles with broken parts: what is printed, and the exit code."""

from __future__ import annotations

from pathlib import Path

import pytest

from labseq.cli.devices import secure_profile

PROFILE = """labseq: 1
name: bench
grid: {rows: 10, cols: 10, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold}
simulation: {use: virtual}
devices:
  shutter: {use: virtual}
plugin_folders: [plugins]
"""

JAMMED = """
import labseq
from labseq_virtual.devices import VirtualDevice
from labseq_virtual.settings import DeviceSettings

LABSEQ_API = 1


class Jammed(VirtualDevice):
    def safe_state(self):
        raise OSError("jammed")


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.device("jammed", Jammed, DeviceSettings)
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plugins").mkdir()
    Path("plugins/jammed.py").write_text(JAMMED, encoding="utf-8")


MOBILE, SHUTTER, CAMERA, STATIC = (
    f"{device:<20} safe" for device in ("mobile_tweezers", "shutter", "camera", "static_tweezers")
)
CAMERAS = "'andor', 'frames', 'genicam', 'pylon', 'virtual'"
NO_CAMERA = f"camera               NOT SAFE: p.yaml:4:15: unknown camera 'ixon'; expected one of {CAMERAS}"
JAM = "shutter              NOT SAFE: shutter: safe_state() raised OSError: jammed"
TO_IXON = {"camera: {use: virtual": "camera: {use: ixon"}
TO_JAMMED = {"shutter: {use: virtual": "shutter: {use: jammed"}


@pytest.mark.parametrize(
    ("changes", "code", "lines"),
    [
        ({}, 0, [MOBILE, SHUTTER, CAMERA, STATIC]),
        (TO_IXON, 2, [MOBILE, SHUTTER, STATIC, NO_CAMERA]),
        (TO_JAMMED, 3, [MOBILE, JAM, CAMERA, STATIC]),
        (TO_IXON | TO_JAMMED, 3, [MOBILE, JAM, STATIC, NO_CAMERA]),
        ({"name: bench": "name: 5"}, 2, [MOBILE, SHUTTER, CAMERA, STATIC]),
    ],
)
def test_every_device_is_reported_and_the_exit_code_is_that_of_the_worst(
    changes: dict[str, str], code: int, lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    text = PROFILE
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    Path("p.yaml").write_text(text, encoding="utf-8")
    assert secure_profile("./p.yaml", ()) == code
    out, err = capsys.readouterr()
    assert out.splitlines() == lines
    assert ("p.yaml:2:7: name is 5" in err) == ("name: bench" in changes)
