"""What is sent to serial instruments, and what comes back: templates, patterns, units."""

from __future__ import annotations

import re
import string
from typing import Any

import pytest
from hypothesis import given, reject, strategies as st
from labseq_serial.commands import CommandSettings
from labseq_serial.device import SerialDevice
from labseq_serial.replies import example_of
from labseq_serial.templates import Template
from labseq_serial.units import Unit
from pydantic import ValidationError

from labseq import Context, DeviceError
from labseq.testing.fakes import FakeClock

from .labseq_serial_rig import settings

WORDS = st.text(string.ascii_letters, min_size=1, max_size=6)
LITERALS = st.text(" :;,=/#", min_size=1, max_size=3)


@st.composite
def numbers(draw: st.DrawFn) -> tuple[dict[str, Any], str, Any]:
    """An argument, its format, and a value within its limits."""
    if draw(st.booleans()):
        low, high = sorted(draw(st.tuples(st.integers(-999, 999), st.integers(-999, 999))))
        spec = draw(st.sampled_from(["", "d", "05d", "+d", ">6d"]))
        return {"type": "int", "min": low, "max": high}, spec, draw(st.integers(low, high))
    low, high = sorted(draw(st.tuples(st.integers(-999, 999), st.integers(-999, 999))))
    unit = draw(st.sampled_from([None, "MHz", "mA", "kHz"]))
    factor = {"MHz": 1e6, "kHz": 1e3}.get(unit or "", 1.0)
    spec = draw(st.sampled_from(["", ".3f", ".1f", "+.2e", "010.4f"]))
    limits = (
        {"min": f"{low} {unit}", "max": f"{high} {unit}", "unit": unit} if unit else {"min": low, "max": high}
    )
    return limits, spec, draw(st.floats(low, high)) * factor


@given(WORDS, st.lists(st.tuples(LITERALS, numbers()), min_size=1, max_size=4))
def test_what_is_formatted_is_read_again_by_the_simulated_instrument(word: str, places: list[Any]) -> None:
    send = word + "".join(f"{literal}{{a{k}:{spec}}}" for k, (literal, (_, spec, _)) in enumerate(places))
    arguments = {f"a{k}": declared for k, (_, (declared, _, _)) in enumerate(places)}
    try:
        command = CommandSettings.model_validate({"send": send, "arguments": arguments})
    except ValidationError:
        reject()  # limits with more digits than are sent
    values = {f"a{k}": value for k, (_, (_, _, value)) in enumerate(places)}
    text = command.text(values)
    read = command.values_in(text)
    assert read is not None
    assert command.text(read) == text
    for name, value in read.items():
        low, high = command.arguments[name].limits
        slack = 1e-9 * max(abs(low), abs(high))
        assert isinstance(value, float | int)
        assert low - slack <= value <= high + slack, "rounding leads beyond no limit"


@given(st.floats(-1e3, 1e3), st.sampled_from(["MHz", "ms", "degC", "mA", "um", "%", "W"]))
def test_units_are_converted_there_and_back(number: float, name: str) -> None:
    unit = Unit.of(name)
    assert unit.to_line(unit.from_line(number)) == pytest.approx(number, rel=1e-12, abs=1e-8)


@pytest.mark.parametrize("given_as", ["120 mA", "120mA", 120, 120.0])
def test_a_unit_that_labseq_does_not_know_is_taken_as_it_is(given_as: object) -> None:
    assert Unit.of("mA").read(given_as) == 120.0


@pytest.mark.parametrize("given_as", ["120 A", "mA", True, None, [1], float("inf")])
def test_what_is_no_number_in_the_unit_is_refused(given_as: object) -> None:
    with pytest.raises(ValueError, match="expected"):
        Unit.of("mA").read(given_as)


@pytest.mark.parametrize(
    "pattern",
    [
        "OK",
        "",
        "THORLABS SC10.*",
        r"(?P<model>THORLABS \w+) VERSION (?P<firmware>.*)",
        r"[+]?0,.*",
        r"^\d{4}-\d{2}$",
        r"(?:A|B(C|D))+[^x-z\]]?x{2,}",
        r"\x41\u00b0\.\s\S",
        r"a{b",
        r"[]a]+",
    ],
)
def test_a_reply_is_made_up_for_a_pattern(pattern: str) -> None:
    reply = example_of(pattern)
    assert reply is not None
    assert re.fullmatch(pattern, reply, re.DOTALL)


@pytest.mark.parametrize("pattern", [r"(?=x)x", r"(a)\1", "(?i:x)y(?!z)"])
def test_patterns_that_are_too_much_are_left_to_the_user(pattern: str) -> None:
    reply = example_of(pattern)
    assert reply is None or re.fullmatch(pattern, reply)


@pytest.mark.filterwarnings("ignore:Possible")  # a set that Python will once read differently
@given(
    st.from_regex(r"[A-Za-z0-9 .,=+*?\[\](){}|\\-]{0,12}", fullmatch=True), st.text(string.digits, max_size=3)
)
def test_whatever_the_pattern_what_is_made_up_matches_it(pattern: str, value: str) -> None:
    try:
        compiled = re.compile(pattern, re.DOTALL)
    except (re.error, OverflowError):
        return
    reply = example_of(pattern, value)
    assert reply is None or compiled.fullmatch(reply)


def test_fixed_widths_need_nothing_between_them() -> None:
    template = Template.parse("S{row:02d}{col:02d}{{}}")
    text = template.format({"row": 3, "col": 14})
    assert text == "S0314{}"
    assert template.read(text, {"row": int, "col": int}) == {"row": 3, "col": 14}


def test_an_argument_may_be_sent_twice() -> None:
    template = Template.parse("{a:02X}={a:02X}")
    assert template.read(template.format({"a": 0x1F}), {"a": int}) == {"a": 0x1F}
    assert template.read("1F=20", {"a": int}) is None


def test_a_dry_run_holds_every_kind_of_argument_against_its_value() -> None:
    text = r"""
  port: simulated
  write_ends_with: "\n"
  read_ends_with: "\n"
  commands:
    set:
      send: "SET {level:.2f};{n:d};{on};{wave}"
      arguments:
        level: {unit: mV, min: 0 V, max: 1 V}
        n: {type: int, min: 0, max: 9}
        on: {type: bool, words: [OFF, ON]}
        wave: {type: text}
  values:
    level: {ask: "LEVEL?", unit: mV, reply: "(?P<value>[0-9]+[.][0-9]{2}) mV"}
    n: {ask: "N?", type: int, reply: "N=(?P<value>[+][0-9])"}
    on: {ask: "ON?", type: bool, words: [OFF, ON]}
    wave: {ask: "WAVE?", type: text}
"""
    device = SerialDevice(settings(text), Context("source", clock=FakeClock()))
    device.open()
    device.command("set", level="125 mV", n=7.0, on=True, wave="SIN")
    read = {name: device.read(name) for name in ("level", "n", "on", "wave")}
    assert read == {"level": 0.125, "n": 7, "on": True, "wave": "SIN"}
    for text in ("ü", "A\nOUT ON", " A", "", "x" * 201):
        with pytest.raises(DeviceError, match="expected"):
            device.command("set", level=0, n=1, on=False, wave=text)
    assert device.read("wave") == "SIN"
