"""``labseq devices`` on profiles with broken parts: the table, the JSON, and the exit code."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from labseq.cli import main
from labseq.cli.devices import show_devices
from labseq.errors import ConfigError, StopRequested
from labseq.session import CheckedDevice, DevicesReport

PROFILE = """labseq: 1
name: bench
grid: {rows: 4, cols: 4, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold}
simulation: {use: virtual}
devices:
  shutter: {use: SHUTTER}
plugin_folders: [plugins]
timeouts: {call: 20 s}
"""

PLUGIN = """
import threading

import labseq
from labseq_virtual.devices import VirtualDevice
from labseq_virtual.settings import DeviceSettings

LABSEQ_API = 1


class Fine(VirtualDevice):
    def describe(self):
        return {"model": "SH-1", "serial_number": 17, "firmware": "2.4", "odd": float("nan")}

    def self_test(self):
        pass


def jam(self):
    raise OSError("jammed")


def refuse(self, settings, context):
    raise OSError("no port")


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.device("fine", Fine, DeviceSettings)
    registry.device("refusing", type("Refusing", (Fine,), {"__init__": refuse}), DeviceSettings)
    for method in ("open", "describe", "self_test", "safe_state", "close"):
        broken = type("Broken", (Fine,), {method: jam})
        registry.device(f"no_{method}", broken, DeviceSettings)
"""
OTHERS = ["simulation", "static_tweezers", "camera", "mobile_tweezers"]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plugins").mkdir()
    Path("plugins/shutters.py").write_text(PLUGIN, encoding="utf-8")


def write(shutter: str) -> None:
    Path("p.yaml").write_text(PROFILE.replace("SHUTTER", shutter), encoding="utf-8")


def rows(out: str) -> dict[str, str]:
    """Device -> its row, without the header."""
    return {line.split()[0]: line for line in out.splitlines()[1:]}


def test_a_device_that_is_fine_is_reported_with_model_serial_number_and_firmware(
    capsys: pytest.CaptureFixture[str],
) -> None:
    write("fine")
    assert show_devices("./p.yaml", (), "off", as_json=False) == 0
    out = capsys.readouterr().out
    header = ["device", "plugin", "model", "serial", "number", "firmware", "latency", "state"]
    assert out.splitlines()[0].split() == header
    shutter = rows(out)["shutter"].split()
    assert (shutter[:5], shutter[-1]) == (["shutter", "fine", "SH-1", "17", "2.4"], "ok")
    assert rows(out)["simulation"].endswith("ok, no self test")


@pytest.mark.parametrize(
    ("method", "says"),
    [("open", ""), ("describe", ""), ("self_test", ""), ("safe_state", "NOT SAFE: "), ("close", "closed: ")],
)
def test_a_device_that_fails_is_reported_with_its_reason_and_the_others_are_fine(
    method: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write(f"no_{method}")
    assert show_devices("./p.yaml", (), "off", as_json=False) == 3
    printed = rows(capsys.readouterr().out)
    assert f"{says}shutter: " in printed["shutter"]
    assert printed["shutter"].endswith("raised OSError: jammed")
    assert all(" ok" in printed[name] for name in OTHERS)


def test_a_device_that_cannot_be_constructed_is_a_fault_of_the_profile(
    capsys: pytest.CaptureFixture[str],
) -> None:
    write("refusing")
    assert show_devices("./p.yaml", (), "off", as_json=False) == 2
    printed = rows(capsys.readouterr().out)
    assert "p.yaml:10:12: " in printed["shutter"]
    assert "raised OSError: no port" in printed["shutter"]
    assert all(" ok" in printed[name] for name in OTHERS)


def test_after_a_stop_the_devices_that_were_tried_are_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stopped = StopRequested(2)
    report = DevicesReport([CheckedDevice("camera", failure=stopped)], {"camera": "ixon"}, stopped=stopped)
    monkeypatch.setattr("labseq.cli.devices.check_devices", lambda *_: report)
    with pytest.raises(StopRequested):
        show_devices("./p.yaml", (), "off", as_json=False)
    assert rows(capsys.readouterr().out)["camera"].endswith("stopped by Ctrl-C")


def as_json(*arguments: str) -> tuple[int, dict[str, Any]]:
    command = [sys.executable, "-m", "labseq", "devices", *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.count("\n") == 1, done.stderr
    return done.returncode, json.loads(done.stdout)


@pytest.mark.system
def test_json_reports_all_that_a_device_says_of_itself() -> None:
    write("fine")
    code, answer = as_json("./p.yaml", "--dry-run")
    assert code == 0
    write("no_self_test")
    code, answer = as_json("./p.yaml")
    assert (code, answer["problems"], answer["warnings"]) == (3, [], [])
    (shutter,) = [one for one in answer["devices"] if one["name"] == "shutter"]
    assert shutter == {
        "name": "shutter",
        "plugin": "no_self_test",
        "ok": False,
        "reason": shutter["reason"],
        "model": "SH-1",
        "serial_number": 17,
        "firmware": "2.4",
        "latency_s": None,
        "self_test": False,
        "described": {"model": "SH-1", "serial_number": 17, "firmware": "2.4", "odd": None},
    }
    assert "OSError: jammed" in shutter["reason"]


@pytest.mark.system
def test_json_reports_what_is_wrong_with_a_profile() -> None:
    write("gone")
    code, answer = as_json("./p.yaml")
    assert (code, answer["problems"][0]["what"]) == (2, "unknown device 'gone'")


def test_a_wrong_profile_ends_with_its_place(capsys: pytest.CaptureFixture[str]) -> None:
    write("gone")
    with pytest.raises(ConfigError):
        show_devices("./p.yaml", (), "off", as_json=False)
    with pytest.raises(SystemExit) as leaving:
        main(["devices", "./p.yaml"])
    out, err = capsys.readouterr()
    assert (leaving.value.code, out) == (2, "")
    assert err.startswith("p.yaml:10:18: unknown device 'gone'")
