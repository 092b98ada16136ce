"""Checking the devices of a profile: each is tried, each is closed, whatever the others do."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from labseq.errors import ConfigError, DeviceTimeoutError, StopRequested
from labseq.guard import StopFlag
from labseq.model.policies import Timeouts
from labseq.roles import Context
from labseq.safety.devices import N_READINGS, CheckedDevice, check_devices, check_each_device
from labseq.testing.fakes import Calls, FakeClock, Hang, RecordingDevice, RecordingSimulation

from .small_runs import PROFILE

TIMEOUTS = Timeouts(call_s=10.0, safe_state_s=10.0)
SHORT = Timeouts(call_s=0.2, safe_state_s=10.0)


class SelfTested(RecordingDevice):
    """A device with a self test."""

    def self_test(self) -> None:
        self.use("self_test")


def make(name: str, calls: Calls, kind: type[RecordingDevice] = SelfTested, **faults: Any) -> RecordingDevice:
    return kind(Context(name, clock=FakeClock()), calls, **faults)


def tried(
    *devices: RecordingDevice, timeouts: Timeouts = TIMEOUTS, stop: StopFlag | None = None
) -> list[CheckedDevice]:
    named: Any = [(device.name, device) for device in devices]
    return check_each_device(named, timeouts, stop or StopFlag())


def test_a_device_is_opened_identified_tested_read_made_safe_and_closed() -> None:
    class Warm(SelfTested):
        def warm(self) -> None:
            self.note("warm")

    calls = Calls()
    found, untested = tried(make("shutter", calls, Warm), make("other", calls, RecordingDevice))
    readings = N_READINGS * ["describe"]
    expected = ["warm", "open", "describe", "self_test", *readings, "safe_state", "close"]
    assert [call.method for call in calls[: len(expected)]] == expected
    assert (untested.ok, untested.tested) == (True, False)
    assert (found.ok, found.tested, found.described) == (
        True,
        True,
        {"model": "Warm", "serial_number": "fake"},
    )
    assert found.latency_s is not None


@pytest.mark.parametrize("method", ["open", "describe", "self_test", "safe_state", "close"])
def test_a_device_that_fails_is_made_safe_and_closed_and_the_next_one_is_tried(method: str) -> None:
    calls, error = Calls(), OSError("jammed")
    found, other = tried(make("bad", calls, fail_on={method: error}), make("good", calls))
    assert calls.names("bad")[-2:] == ["bad.safe_state", "bad.close"]
    error_text = {"safe_state": found.unsafe, "close": found.unclosed}.get(method, found.failure)
    assert str(error_text) == f"bad: {method}() raised OSError: jammed"
    assert (found.ok, other.ok) == (False, True)


@pytest.mark.parametrize("method", ["open", "self_test"])
def test_a_device_that_hangs_is_given_up_made_safe_and_closed(method: str) -> None:
    calls, hang = Calls(), Hang()
    found, other = tried(make("bad", calls, hang_on={method: hang}), make("good", calls), timeouts=SHORT)
    hang.release.set()
    assert isinstance(found.failure, DeviceTimeoutError)
    assert f"{method}() did not answer within 0.2 s and is abandoned" in str(found.failure)
    assert calls.names("bad")[-2:] == ["bad.safe_state", "bad.close"]
    assert other.ok


def test_after_a_stop_the_device_being_tried_is_made_safe_and_closed_and_no_other_is_opened() -> None:
    calls, stop = Calls(), StopFlag()

    class Interrupted(SelfTested):
        def describe(self) -> Mapping[str, Any]:
            stop.request()
            return super().describe()

    found = tried(make("one", calls, Interrupted), make("other", calls), stop=stop)
    assert calls.names() == ["one.open", "one.describe", "one.safe_state", "one.close"]
    assert [type(one.failure) for one in found] == [StopRequested]


def test_the_simulation_is_opened_first_and_closed_last() -> None:
    calls = Calls()
    simulation = RecordingSimulation(calls)
    devices = [("one", make("one", calls, fail_on={"open": OSError("gone")}))]
    named: Any = devices
    simulation_found, one = check_each_device(named, TIMEOUTS, StopFlag(), simulation)
    assert (calls.names()[0], calls.names()[-1]) == ("simulation.open", "simulation.close")
    assert (simulation_found.name, simulation_found.ok, one.ok) == ("simulation", True, False)


ORDER = ["simulation", "static_tweezers", "camera", "shutter", "mobile_tweezers"]


@pytest.fixture
def profile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "p.yaml"
    path.write_text(
        PROFILE + "devices: {shutter: {use: virtual}}\ntimeouts: {call: 100 s}\n", encoding="utf-8"
    )
    return path


def test_all_devices_of_a_profile_are_tried_in_the_order_of_opening(profile: Path) -> None:
    report = check_devices("./p.yaml")
    assert [found.name for found in report.devices] == ORDER
    assert all(found.ok for found in report.devices), report.devices
    assert {found.name for found in report.devices if found.tested} == {*ORDER} - {"simulation", "shutter"}
    assert report.stopped is None


def test_the_real_driver_of_a_simulated_card_describes_it(profile: Path) -> None:
    report = check_devices("./p.yaml", ["profile.mobile_tweezers={use: spcm, card: simulated}"])
    assert report.devices[-1].failure is None
    assert report.devices[-1].described["model"] == "M4i.6631-x8"
    assert report.plugins["mobile_tweezers"] == "spcm"


def test_a_wrong_profile_touches_nothing(profile: Path) -> None:
    with pytest.raises(ConfigError, match="unknown camera 'ixon'"):
        check_devices("./p.yaml", ["profile.camera.use=ixon"])
