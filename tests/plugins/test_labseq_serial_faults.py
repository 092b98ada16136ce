"""Serial instruments that fail: each fault is made by a process that really behaves like this."""

from __future__ import annotations

import importlib
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings as hypothesis_settings, strategies as st
from labseq_serial.device import SerialDevice

from labseq.guard import StopFlag
from labseq.plugin import Context, DeviceError, DeviceTimeoutError, LabseqError, StopRequested, TransientError
from labseq.sequencer.clock import RealClock

from .emergency import outsider
from .labseq_serial_rig import Simulator, opened, settings

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ptys")


@pytest.fixture
def simulator(tmp_path: Path) -> Iterator[Simulator]:
    with Simulator(tmp_path) as simulator:
        yield simulator


@pytest.fixture
def synth(simulator: Simulator) -> Iterator[SerialDevice]:
    with opened(simulator.port) as synth:
        yield synth


@pytest.mark.parametrize(
    ("fault", "kind", "text"),
    [
        ("silent", DeviceTimeoutError, "'TEMP\\?' within 250 ms; .*'baud_rate'"),
        ("garbage", DeviceError, "'TEMP\\?', '.*xff.*', is not ascii; .*'baud_rate', 'parity'"),
        ("partial", DeviceTimeoutError, "'21', .* within 250 ms; check 'read_ends_with'"),
        ("other", DeviceError, "temperature: 'TEMP\\?' was answered by 'WHAT'"),
        ("echo", DeviceError, "'TEMP\\?' was answered by 'TEMP\\?'"),
        ("endless", DeviceError, "the reply to 'TEMP\\?' does not end: 'xxx"),
    ],
)
def test_a_bad_reply_is_asked_for_twice_and_then_named(
    simulator: Simulator, synth: SerialDevice, fault: str, kind: type[Exception], text: str
) -> None:
    simulator.order("fault", fault, 2)
    with pytest.raises(kind, match=f"synth: .*{text}"):
        synth.read("temperature")
    assert simulator.log.count("TEMP?") == 2
    assert synth.read("temperature") == pytest.approx(294.65), "nothing of it is left"


def test_a_reply_that_comes_in_bits_is_put_together(simulator: Simulator, synth: SerialDevice) -> None:
    simulator.order("fault", "slow", 1)
    assert synth.read("temperature") == pytest.approx(294.65)
    assert simulator.log.count("TEMP?") == 1


def test_what_comes_unasked_is_dropped(simulator: Simulator, synth: SerialDevice) -> None:
    simulator.order("fault", "two", 1)
    assert synth.read("temperature") == pytest.approx(294.65)
    simulator.order("say", b"LATER\n".hex())
    assert synth.read("is_open") is False
    assert simulator.log.count("STATE?") == 1


def test_a_command_is_sent_again_only_if_the_profile_allows_it(
    simulator: Simulator, synth: SerialDevice
) -> None:
    simulator.order("fault", "other", 1)
    synth.command("open")
    assert simulator.log.count("OPEN") == 2
    simulator.order("fault", "silent", 1)
    with pytest.raises(DeviceTimeoutError, match="no reply to 'OPEN'"):
        synth.command("once")
    assert simulator.log.count("OPEN") == 3


def test_an_error_of_the_instrument_is_reported_and_not_repeated(
    simulator: Simulator, synth: SerialDevice
) -> None:
    with pytest.raises(DeviceError, match=r"synth: 'NONSENSE' .*'ERR -113,undefined header'"):
        synth.command("nonsense")
    assert simulator.log.count("NONSENSE") == 1


def test_a_wrong_baud_rate_is_suspected(simulator: Simulator) -> None:
    device = SerialDevice(settings(port=simulator.port, baud_rate=19200, timeout="250 ms"), Context("synth"))
    with pytest.raises(DeviceError, match=r"synth: .*'\*IDN\?'.*check .*'baud_rate'"):
        device.open()
    simulator.order("speed", 19200)
    device.open()
    device.close()


def test_another_instrument_is_refused(simulator: Simulator) -> None:
    identify = {"ask": "*IDN?", "reply": "THORLABS SC10.*"}
    device = SerialDevice(settings(port=simulator.port, identify=identify), Context("synth"))
    with pytest.raises(DeviceError, match=r"'LAB,SIMULATOR,0042,1.7', not 'THORLABS SC10.*'"):
        device.open()
    assert {*simulator.log} == {"*IDN?"}, "it was sent nothing else"


def test_a_second_user_is_reported_that_the_port_is_taken(simulator: Simulator, synth: SerialDevice) -> None:
    del synth
    second = SerialDevice(settings(port=simulator.port), Context("laser"))
    with pytest.raises(DeviceError, match=f"laser: .*{simulator.port}: another program has it open"):
        second.open()


@pytest.mark.parametrize(
    ("port", "text"),
    [
        ({"port": "/dev/ttyNOSUCH7"}, "cannot open /dev/ttyNOSUCH7: there is no such port"),
        ({"port": "/dev/null"}, "cannot open /dev/null: it is not a serial port"),
        ({"port": None, "usb": {"vid": 0x0403, "serial": "NOSUCH"}}, "no USB adapter has vid 0x0403, serial"),
        ({"port": "rfc2217://localhost:1"}, "cannot open rfc2217://localhost:1: "),
    ],
)
def test_a_port_that_is_not_there_is_named(port: dict[str, Any], text: str) -> None:
    with pytest.raises(DeviceError, match=f"synth: {text}"):
        SerialDevice(settings(**port), Context("synth")).open()


def test_an_adapter_is_found_by_its_numbers(simulator: Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    adapters = [adapter(simulator.port, "A1"), adapter("/dev/ttyUSB7", "A2")]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: adapters)
    with opened(None, usb={"vid": 0x0403, "serial": "A1"}) as synth:
        assert synth.read("is_open") is False
    text = "2 adapters have vid 0x0403: .*/dev/ttyUSB7 .A2.*; add 'serial'"
    with pytest.raises(DeviceError, match=text), opened(None, usb={"vid": 0x0403}):
        pass
    text = "no USB adapter has pid 0x0001; .*0x0403 0x6001 A1"
    with pytest.raises(DeviceError, match=text), opened(None, usb={"pid": 1}):
        pass


def adapter(port: str, serial_number: str) -> Any:
    found: Any = importlib.import_module("serial.tools.list_ports_common").ListPortInfo(port)
    found.vid, found.pid, found.serial_number = 0x0403, 0x6001, serial_number
    return found


@pytest.mark.parametrize("instant", ["before", "during"])
def test_an_unplugged_instrument_fails_the_shot_and_is_opened_again_in_the_next(
    simulator: Simulator, synth: SerialDevice, instant: str
) -> None:
    if instant == "before":
        simulator.order("unplug")
    else:
        simulator.order("fault", "unplug", 1)
    with pytest.raises(TransientError, match=r"synth: the line broke at 'OPEN' \(.*\); unplugged\?"):
        synth.command("open")
    with pytest.raises(DeviceError, match=r"synth: .*could not be opened again"):
        synth.command("open")
    with pytest.raises(DeviceError, match="could not be opened again"):
        synth.safe_state()
    simulator.order("plug")
    synth.command("open")
    assert synth.read("is_open") is True
    assert simulator.log.count("*IDN?") == 2, "it was asked again who it is"


def test_a_broken_line_is_opened_again_for_the_safe_state_but_not_set_up(simulator: Simulator) -> None:
    with opened(simulator.port, on_open=["open"]) as synth:
        simulator.order("unplug")
        with pytest.raises(TransientError):
            synth.read("temperature")
        simulator.order("plug")
        synth.safe_state()
        assert simulator.log[-3:] == ["*IDN?", "FREQ 1.000000", "CLOSE"]


def test_the_safe_state_goes_on_after_a_command_that_fails(simulator: Simulator) -> None:
    with opened(simulator.port, safe_state=["nonsense", "once", "close"]) as synth:
        with pytest.raises(DeviceError, match="'NONSENSE' was refused"):
            synth.safe_state()
        assert simulator.log[-3:] == ["NONSENSE", "OPEN", "CLOSE"]


def test_an_instrument_that_takes_nothing_is_a_timeout(simulator: Simulator) -> None:
    more: dict[str, Any] = {"flow_control": "xon_xoff", "timeout": "250 ms", "retries": 0}
    with opened(simulator.port, **more) as synth:
        simulator.order("answer", b"\x131\n".hex())  # XOFF, which holds from now or from the next on
        text = r"synth: 'STATE\?' could not be sent within 250 ms; see 'flow_control'"
        with pytest.raises(DeviceTimeoutError, match=text):
            read_twice(synth)


def read_twice(synth: SerialDevice) -> None:
    for _ in range(2):
        synth.read("is_open")


def test_a_stop_request_ends_the_wait_for_a_reply(simulator: Simulator) -> None:
    stop = StopFlag()
    with opened(simulator.port, RealClock(stop), timeout="60 s") as synth:
        simulator.order("fault", "silent", 1)
        asking = Asking(synth)
        stop.request()
        assert isinstance(asking.outcome(), StopRequested)


def test_the_safe_state_does_not_wait_for_somebody_elses_reply(simulator: Simulator) -> None:
    with opened(simulator.port, RealClock(StopFlag()), timeout="60 s") as synth:
        simulator.order("fault", "silent", 1)
        asking = Asking(synth)
        asking.has_begun(simulator)
        synth.safe_state()
        assert "aborted by the safe state" in str(asking.outcome())
        assert simulator.log[-2:] == ["FREQ 1.000000", "CLOSE"]


class Asking:
    """A thread that asks for the temperature."""

    def __init__(self, synth: SerialDevice) -> None:
        self._synth = synth
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._ask)
        self._thread.start()

    def has_begun(self, simulator: Simulator) -> None:
        while "TEMP?" not in simulator.log:
            pass

    def outcome(self) -> BaseException | None:
        self._thread.join(30.0)
        assert not self._thread.is_alive(), "it still waits"
        return self._error

    def _ask(self) -> None:
        try:
            self._synth.read("temperature")
        except LabseqError as error:
            self._error = error


@hypothesis_settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=40))
def test_whatever_comes_is_a_value_or_an_error(simulator: Simulator, noise: bytes) -> None:
    with opened(simulator.port, retries=0, identify=None) as synth:
        simulator.order("answer", (noise + b"\n").hex())
        try:
            assert isinstance(synth.read("temperature"), float)
        except DeviceError as error:
            assert str(error).isprintable()


def test_another_process_sends_the_commands_of_the_safe_state(simulator: Simulator) -> None:
    with opened(simulator.port, timeout="500 ms") as synth:
        synth.command("open")
        emergency = synth.emergency()
    assert emergency is not None
    n_before = len(simulator.log)
    with outsider({"synth": (str(emergency.script), emergency.arguments)}) as other:
        assert (other.prepared, other.heavy_modules) == ({"synth": None}, [])
        done = other.off()["synth"].text
        assert done == f"sent 'FREQ 1.000000', 'CLOSE' to {simulator.port}"
        assert simulator.log[n_before:] == ["FREQ 1.000000", "CLOSE"]
        simulator.order("fault", "silent", 2)
        assert "no answer to 'CLOSE'" in other.off()["synth"].text
        simulator.order("unplug")
        assert other.off()["synth"].text.startswith("SerialException: ")


def test_without_a_safe_state_or_a_port_there_is_nothing_to_send(simulator: Simulator) -> None:
    with opened(simulator.port, safe_state=[]) as synth:
        assert synth.emergency() is None
    with opened("simulated") as synth:
        assert synth.emergency() is None
