"""The driver of serial instruments: what it does when all is well."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, ClassVar

import pytest
from labseq_serial.device import SerialDevice

from labseq import Context, DeviceError, LimitError
from labseq.roles import offers
from labseq.testing import DeviceContract
from labseq.testing.fakes import FakeClock

from .labseq_serial_rig import Counterpart, opened, settings

Factory = Callable[..., Any]
on_a_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ptys")


@pytest.fixture(scope="module")
def counterpart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Counterpart]:
    with Counterpart(tmp_path_factory.mktemp("serial")) as counterpart:
        yield counterpart


class Declared(DeviceContract):
    commands: ClassVar = {
        "open": {},
        "close": {},
        "toggle_on": {},
        "toggle_off": {},
        "set": {"frequency": "80 MHz"},
    }
    excessive_commands: ClassVar = {"a frequency beyond the limit": ("set", {"frequency": 201e6})}
    values: ClassVar = ("is_open", "frequency", "temperature")


class TestSimulatedInstrument(Declared):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(SerialDevice, settings(port="simulated"))


@on_a_pty
class TestInstrumentOnAPty(Declared):
    @pytest.fixture
    def factory(self, counterpart: Counterpart) -> Factory:
        return partial(SerialDevice, settings(port=counterpart.port))


@on_a_pty
def test_commands_and_values_cross_the_line_in_the_units_of_the_instrument(counterpart: Counterpart) -> None:
    with opened(counterpart.port) as synth:
        synth.command("set", frequency="80.5 MHz")
        assert synth.read("frequency") == 80.5e6
        assert counterpart.log[-2:] == ["FREQ 80.500000", "FREQ?"]
        synth.command("set", frequency=90e6)
        assert synth.poll() == {"is_open": False, "frequency": 90e6}
        assert synth.read("temperature") == pytest.approx(273.15 + 21.5)


@on_a_pty
def test_it_says_what_the_instrument_says_of_itself(counterpart: Counterpart) -> None:
    with opened(counterpart.port) as synth:
        n_asked = counterpart.log.count("*IDN?")
        told = synth.describe()
        assert counterpart.log.count("*IDN?") == n_asked + 1, "its latency is that of the line"
        assert (told["model"], told["serial_number"], told["firmware"]) == ("COUNTERPART", "0042", "1.7")
        synth.self_test()


@on_a_pty
def test_a_toggle_is_sent_only_where_it_brings_about_what_is_asked_for(counterpart: Counterpart) -> None:
    with opened(counterpart.port) as synth:
        synth.command("close")
        n_sent = counterpart.log.count("TOGGLE")
        for _ in range(2):
            synth.command("toggle_on")
            assert synth.read("is_open") is True
        assert counterpart.log.count("TOGGLE") == n_sent + 1
        with pytest.raises(
            DeviceError, match=r"synth: never: 'OPEN' was sent, .* is_open is true; expected false"
        ):
            synth.command("never")


@on_a_pty
def test_the_safe_state_sends_what_the_profile_says(counterpart: Counterpart) -> None:
    with opened(counterpart.port, on_open=["open"]) as synth:
        assert counterpart.log[-1] == "OPEN"
        synth.safe_state()
        assert counterpart.log[-2:] == ["FREQ 1.000000", "CLOSE"]


@on_a_pty
def test_what_fails_on_open_is_taken_back(counterpart: Counterpart) -> None:
    device = SerialDevice(settings(port=counterpart.port, on_open=["open", "nonsense"]), Context("synth"))
    with pytest.raises(DeviceError, match="'NONSENSE' was refused"):
        device.open()
    assert counterpart.log[-2:] == ["FREQ 1.000000", "CLOSE"]
    with pytest.raises(DeviceError, match="not open"):
        device.command("open")


@pytest.mark.parametrize(
    ("command", "arguments", "kind", "text"),
    [
        ("opne", {}, DeviceError, "unknown command 'opne'; expected one of 'open', 'close'"),
        ("set", {}, DeviceError, "'set' has no arguments; expected frequency"),
        ("open", {"now": 1}, DeviceError, "'open' has the arguments now; expected none"),
        ("set", {"frequency": "80 mm"}, DeviceError, "'80 mm' is a length, not a frequency"),
        ("set", {"frequency": True}, DeviceError, "True does not do; expected a frequency"),
        ("set", {"frequency": "0.2 GHz "}, None, ""),
        (
            "set",
            {"frequency": "201 MHz"},
            LimitError,
            "synth: frequency of 'set' is 201 MHz; the limit is 1 MHz to 200",
        ),
        ("set", {"frequency": float("nan")}, DeviceError, "expected a finite one"),
    ],
)
def test_commands_can_be_checked_before_anything_is_open(
    command: str, arguments: dict[str, Any], kind: type[Exception] | None, text: str
) -> None:
    device = SerialDevice(settings(port="simulated"), Context("synth"))
    if kind is None:
        device.check_command(command, **arguments)
    else:
        with pytest.raises(kind, match=text):
            device.check_command(command, **arguments)


@on_a_pty
def test_a_value_past_its_interlock_stops_everything(counterpart: Counterpart) -> None:
    with opened(counterpart.port) as synth:
        synth.check_interlocks()
        counterpart.order("set", "temperature", "25.60")
        try:
            text = "temperature is 25.6 degC; the interlock expects 15 degC to 25 degC; look at the chiller"
            with pytest.raises(DeviceError, match=text):
                synth.check_interlocks()
        finally:
            counterpart.order("set", "temperature", "21.50")


@on_a_pty
def test_an_interlock_that_cannot_be_read_stops_everything(counterpart: Counterpart) -> None:
    with opened(counterpart.port) as synth:
        counterpart.order("fault", "other", 2)
        with pytest.raises(DeviceError, match=r"synth: temperature: 'TEMP\?' was answered by 'WHAT'"):
            synth.check_interlocks()


def test_it_can_do_what_labseq_asks_of_such_devices() -> None:
    device = SerialDevice(settings(port="simulated"), Context("synth"))
    for ability in ("self_test", "poll", "check_interlocks", "check_command"):
        assert offers(device, ability)


@on_a_pty
def test_an_implausible_value_is_an_error(counterpart: Counterpart) -> None:
    with opened(counterpart.port) as synth:
        counterpart.order("set", "temperature", "9.9e37")
        try:
            with pytest.raises(DeviceError, match="implausible; expected -50 degC to 100 degC"):
                synth.read("temperature")
        finally:
            counterpart.order("set", "temperature", "21.50")


def test_a_reading_may_be_as_old_as_the_interlock_lets_it() -> None:
    clock, lock = FakeClock(), {"max": "25 degC", "max_age": "1 s"}
    values = {"temperature": {"ask": "TEMP?", "unit": "degC", "poll": True, "interlock": lock}}
    with opened("simulated", clock, values=values, commands={}, safe_state=[]) as synth:
        synth.poll()
        before_s = clock.now()
        synth.check_interlocks()
        assert clock.now() == before_s
        clock.sleep(1.0)
        synth.check_interlocks()
        assert clock.now() > before_s + 1.0


def test_a_simulated_line_takes_its_time() -> None:
    clock = FakeClock()
    with opened("simulated", clock, baud_rate=1200, pause="30 ms", wait_after_open="2 s") as synth:
        assert clock.now() >= 2.0
        before_s = clock.now()
        synth.command("set", frequency="80 MHz")
        n_bytes = len("FREQ 80.000000\n")
        assert clock.now() - before_s == pytest.approx(30e-3 + n_bytes * 10 / 1200)


def test_a_simulated_instrument_remembers_what_it_was_told() -> None:
    with opened("simulated") as synth:
        assert synth.read("frequency") == 0.0
        synth.command("set", frequency="80 MHz")
        assert synth.read("frequency") == 80e6
        assert synth.read("temperature") == pytest.approx(273.15 + 20.0), (
            "the middle of what its interlock allows"
        )
        synth.command("toggle_on")
        assert synth.poll()["is_open"] is True
        synth.command("toggle_off")
        assert synth.poll()["is_open"] is False
        synth.check_interlocks()


def test_an_instrument_that_echoes_and_prompts_is_read() -> None:
    text = r"""
  port: simulated
  write_ends_with: "\r"
  read_ends_with: "> "
  echo: true
  commands:
    manual: {send: mode=1, reply: ""}
    time: {send: "open={duration:.0f}", reply: "", arguments: {duration: {unit: ms, min: 1 ms, max: 10 s}}}
  values: {mode: {ask: "mode?", type: int}, duration: {ask: "open?", unit: ms}}
"""
    device = SerialDevice(settings(text), Context("shutter", clock=FakeClock()))
    device.open()
    device.command("manual")
    device.command("time", duration="45 ms")
    assert device.read("duration") == pytest.approx(45e-3)
    device.close()
