"""``labseq devices`` and ``labseq safe`` on profiles with broken parts: output and exit code."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from labseq.errors import StopRequested
from labseq.safety.devices import CheckedDevice, DevicesReport

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

    def versions(self):
        return {"library": ("1.3", "1.2, 1.3"), "firmware": ("2.4", "2.3"), "board": ("", "")}


def jam(method):
    def fail(self):
        raise OSError("jammed")

    fail.__name__ = method
    return fail


def refuse(self, settings, context):
    raise OSError("no port")


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.device("fine", Fine, DeviceSettings)
    registry.device("refusing", type("Refusing", (Fine,), {"__init__": refuse}), DeviceSettings)
    for method in ("open", "describe", "self_test", "safe_state", "close", "versions"):
        broken = type("Broken", (Fine,), {method: jam(method)})
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
    """Device -> its row, without the header and the versions below."""
    return {line.split()[0]: line for line in out.split("\n\n", maxsplit=1)[0].splitlines()[1:]}


def test_a_device_that_works_is_reported_with_model_serial_number_and_firmware(call: Any) -> None:
    write("fine")
    code, out, _ = call("devices", "./p.yaml")
    assert code == 0
    header = ["device", "plugin", "model", "serial", "number", "firmware", "latency", "state"]
    assert out.splitlines()[0].split() == header
    shutter = rows(out)["shutter"].split()
    assert (shutter[:5], shutter[-1]) == (["shutter", "fine", "SH-1", "17", "2.4"], "ok")
    assert rows(out)["simulation"].endswith("ok, no self test")
    below = [line.split() for line in out.splitlines() if line.startswith("shutter")][1:]
    assert below == [
        ["shutter", "library", "1.3", "1.2,", "1.3"],
        ["shutter", "firmware", "2.4", "2.3", "differs"],
        ["shutter", "board", "unknown", "none"],
    ]


def test_versions_that_cannot_be_read_cost_a_row_and_not_the_self_test(call: Any) -> None:
    write("no_versions")
    code, out, _ = call("devices", "./p.yaml")
    assert (code, rows(out)["shutter"].split()[-1]) == (0, "ok")
    (below,) = [line for line in out.splitlines() if line.startswith("shutter")][1:]
    assert re.search(r"shutter +- +cannot be read: shutter: .*OSError: jammed", below)
    (shutter,) = [
        one
        for one in json.loads(call("devices", "./p.yaml", "--json")[1])["devices"]
        if one["name"] == "shutter"
    ]
    assert (shutter["ok"], shutter["self_test"], shutter["versions"]) == (True, True, {})
    assert "OSError: jammed" in shutter["versions_failure"]


@pytest.mark.parametrize(
    ("method", "says"), [("open", ""), ("self_test", ""), ("safe_state", "NOT SAFE: "), ("close", "closed: ")]
)
def test_a_device_that_fails_is_reported_with_its_reason_and_the_others_work(
    method: str, says: str, call: Any
) -> None:
    write(f"no_{method}")
    code, out, _ = call("devices", "./p.yaml")
    printed = rows(out)
    assert code == 3
    assert f"{says}shutter: " in printed["shutter"]
    assert re.search(r"raised OSError: jammed \(.*shutters\.py:\d+\)$", printed["shutter"])
    assert all(" ok" in printed[name] for name in OTHERS)


def test_a_device_that_cannot_be_constructed_is_a_fault_of_the_profile(call: Any) -> None:
    write("refusing")
    code, out, _ = call("devices", "./p.yaml")
    printed = rows(out)
    assert code == 2
    assert "p.yaml:10:12: " in printed["shutter"]
    assert "raised OSError: no port" in printed["shutter"]
    assert all(" ok" in printed[name] for name in OTHERS)


def test_after_a_stop_the_devices_that_were_tried_are_reported(
    monkeypatch: pytest.MonkeyPatch, call: Any
) -> None:
    stopped = StopRequested(2)
    report = DevicesReport([CheckedDevice("camera", failure=stopped)], {"camera": "ixon"}, stopped=stopped)
    monkeypatch.setattr("labseq.cli.devices.check_devices", lambda *_: report)
    write("fine")
    code, out, _ = call("devices", "./p.yaml")
    assert code == 130
    assert rows(out)["camera"].endswith("stopped by Ctrl-C")


def test_json_holds_all_that_a_device_says_of_itself(call: Any) -> None:
    write("no_self_test")
    code, out, err = call("devices", "./p.yaml", "--json")
    assert out.count("\n") == 1, err
    answer = json.loads(out)
    assert (code, answer["problems"], answer["warnings"]) == (3, [], [])
    (shutter,) = [one for one in answer["devices"] if one["name"] == "shutter"]
    assert "OSError: jammed" in shutter.pop("reason")
    assert shutter == {
        "name": "shutter",
        "plugin": "no_self_test",
        "ok": False,
        "model": "SH-1",
        "serial_number": 17,
        "firmware": "2.4",
        "versions": {
            "library": {"here": "1.3", "tried": "1.2, 1.3"},
            "firmware": {"here": "2.4", "tried": "2.3"},
            "board": {"here": "", "tried": ""},
        },
        "versions_failure": None,
        "latency_s": None,
        "self_test": False,
        "described": {"model": "SH-1", "serial_number": 17, "firmware": "2.4", "odd": None},
    }


def test_a_profile_with_an_error_ends_with_its_place(call: Any) -> None:
    write("gone")
    code, out, err = call("devices", "./p.yaml")
    assert (code, out) == (2, "")
    assert err.startswith("p.yaml:10:18: unknown device 'gone'")
    code, out, _ = call("devices", "./p.yaml", "--json")
    assert (code, json.loads(out)["problems"][0]["what"]) == (2, "unknown device 'gone'")


MOBILE, SHUTTER, CAMERA, STATIC = (
    f"{device:<20} safe" for device in ("mobile_tweezers", "shutter", "camera", "static_tweezers")
)
CAMERAS = "'andor', 'frames', 'genicam', 'pylablib', 'pylon', 'remote', 'virtual'"
NO_CAMERA = f"camera               NOT SAFE: p.yaml:4:15: unknown camera 'ixon'; expected one of {CAMERAS}"
JAM = "shutter              NOT SAFE: shutter: safe_state() raised OSError: jammed (shutters.py)"
TO_IXON = {"camera: {use: virtual": "camera: {use: ixon"}
TO_JAMMED = {"use: fine": "use: no_safe_state"}


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
def test_safe_reports_every_device_and_the_exit_code_is_that_of_the_worst(
    changes: dict[str, str], code: int, lines: list[str], call: Any
) -> None:
    write("fine")
    text = Path("p.yaml").read_text("utf-8")
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    Path("p.yaml").write_text(text, "utf-8")
    got, out, err = call("safe", "./p.yaml")
    printed = [re.sub(r" \(.*shutters\.py:\d+\)$", " (shutters.py)", line) for line in out.splitlines()]
    assert (got, printed) == (code, lines)
    assert ("p.yaml:2:7: name is 5" in err) == ("name: bench" in changes)


def test_standing_by_needs_devices_that_are_locked_and_ends_no_process_that_works(call: Any) -> None:
    write("virtual")
    code, _, error = call("safe", "./p.yaml", "--stand-by")
    assert code == 2
    assert error.startswith("error: p.yaml: all its devices are simulated")
    code, _, error = call("safe", "./p.yaml", "--stand-by", "--end")
    assert code == 2
    assert "leave out --end" in error
