"""The description of an instrument: settings, templates, patterns, and their mistakes with line and caret."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, reject, strategies as st
from labseq_serial.device import SerialDevice
from labseq_serial.settings import CommandSettings, SerialSettings
from labseq_serial.values import Unit, ValueSettings
from pydantic import ValidationError

from labseq.config.document import Document
from labseq.config.yaml_nodes import compose
from labseq.plugin import ConfigError, Context, DeviceError
from labseq.testing.fakes import FakeClock

from .labseq_serial_rig import settings

GOOD = r"""
a:
  port: COM3
  write_ends_with: "\r"
  identify: {ask: "*IDN?", reply: "LAB.*"}
  commands:
    on: {send: OUT 1, makes: {is_on: true}}
    off: {send: OUT 0, reply: OK, error: "E.*"}
    set:
      send: "FREQ {f:.1f},{n:02d},{wave}"
      arguments:
        f: {unit: MHz, min: 1 MHz, max: 200 MHz}
        n: {type: int, min: 0, max: 15}
        wave: {type: text, choices: [SIN, SQU]}
  values:
    is_on: {ask: "OUT?", type: bool, words: [OFF, ON], interlock: {one_of: [true]}}
    t: {ask: "T?", unit: degC, min: 0 degC, max: 50 degC, interlock: {max: 30 degC}}
    n: {ask: "N?", type: int, reply: "N=(?P<value>[0-9]+)"}
  safe_state: [off]
  read_ends_with: "\n"
"""


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        # the port and the characters
        ("port: COM3", "usb: {}", "3:8: this fits every adapter; expected vid, pid or serial"),
        ("port: COM3", "timeout: 1 s", "3:3: it has no port; expected 'port' or 'usb'"),
        ("COM3", "COM3\n  usb: {serial: A5}", "4:3: it has both 'port' and 'usb'; expected one of them"),
        (
            "COM3",
            "spy://COM3",
            "3:9: 'spy://COM3' is not a port; expected socket://host:port or rfc2217://host",
        ),
        ("COM3", "socket://localhost:99999", "3:9: 'socket://localhost:99999' is not a port; expected"),
        ('"\\r"', "'\\r'", "4:20: '\\r' holds a backslash; expected control characters"),
        ("OUT 0,", "ÖUT 0,", "8:17: 'ÖUT 0' is not ascii; use another 'encoding', or other characters"),
        ("OUT 0,", '"OUT 0\\r",', "8:17: 'OUT 0\\r' contains the end of a command; leave it out"),
        # templates and their arguments
        (
            "{f:.1f}",
            "{F:.1f}",
            "10:13: '{F}' is not an argument; expected one of 'f', 'n', 'wave'; did you mean",
        ),
        ("{f:.1f},", "", "12:9: the argument 'f' has no place in 'FREQ {n:02d},{wave}'; expected a placeho"),
        ("{f:.1f}", "{f:.1q}", "10:13: '{f:.1q}' is not a format of a float"),
        ("{f:.1f}", "{f:.1%}", "10:13: '100.0%' is not a plain number; expected a format such as .3f"),
        ("{f:.1f}", "{f", "10:13: 'FREQ {f,{n:02d},{wave}' is not a template"),
        ("{f:.1f}", "{f.real}", "10:13: the placeholder '{f.real}' is not the name"),
        (
            "min: 1 MHz",
            "min: 1.04 MHz",
            "12:29: min as '1.0' would be 1 MHz, beyond the limit",
        ),
        ("min: 1 MHz", "min: 300 MHz", "12:29: min is 300 MHz, more than max, 200 MHz; expected min below"),
        (
            "min: 1 MHz",
            "min: 1 mm",
            "12:29: '1 mm' is a length, not a frequency; expected a frequency",
        ),
        (", max: 200 MHz", "", "12:12: 'max' is missing; expected both limits of a number that is sent"),
        ("unit: MHz", "unit: Mhz", "12:19: labseq knows no unit 'Mhz'; did you mean"),
        ("min: 0, max: 15", "min: 0.2, max: 0.7", "13:29: there is no whole number within the limits"),
        ("type: int, min: 0, max: 15", "type: text, max: 3", "13:25: 'max' is not for type text; exp"),
        ("words: [OFF, ON]", "max: 3", "16:38: 'max' is not for type bool; expected type float or int"),
        ("        n:", "        name:", "an argument is called 'name'; expected a word of letters"),
        # replies and effects
        ("reply: OK", "reply: '(OK'", "8:31: '(OK' is not a regular expression: missing ), unterminated"),
        (
            "reply: OK, ",
            "",
            "8:24: 'error' is about a reply, but there is no 'reply'; expected a",
        ),
        ("reply: OK", "reply: OK, example: NO", "8:44: the reply 'NO' does not match; expected one like"),
        (
            "is_on: true",
            "is_onn: true",
            "7:31: there is no value 'is_onn'; expected one of 'is_on', 't'",
        ),
        ("is_on: true", "is_on: 1", "7:38: the value 'is_on' is of type bool; expected true or false"),
        ("is_on: true", "t: 1", "7:34: the value 't' is of type float; expected a value of another type"),
        # values and interlocks
        ("(?P<value>[0-9]+)", "([0-9]+)", "18:38: 'N=([0-9]+)' has no group 'value'; expected the value in"),
        ('[0-9]+)"', '[0-9]+)", example: N=x', "the reply 'N=x' does not match: expected a reply like"),
        ("words: [OFF, ON]", "words: [ON, ON]", "16:45: false and true are both 'ON'; expected two words"),
        ("one_of: [true]", "max: 3", "'max' is not for a value of type bool; expected one_of"),
        ("one_of: [true]", "one_of: [ON]", "the value is of type bool; expected true or false"),
        ("{max: 30 degC}", "{}", "the interlock allows everything; expected min, max or one_of"),
        ("{max: 30 degC}", "{min: 40 degC, max: 30 degC}", "min is 40 degC, more than max, 30 degC"),
        # the safe state
        ("[off]", "[of]", "19:16: there is no command 'of'; expected one of 'on', 'off', 'set'; did you"),
        ("[off]", "[set]", "19:16: 'set' needs f, n, wave; expected a command without arguments; declare"),
    ],
)
def test_mistakes_in_a_description(right: str, wrong: str, message: str) -> None:
    text = GOOD.replace(right, wrong, 1)
    assert text != GOOD
    with pytest.raises(ConfigError) as caught:
        Document.parse(text, "p.yaml").validate(SerialSettings, ("a",))
    assert message in str(caught.value)


def test_only_a_simulated_instrument_needs_examples_of_replies() -> None:
    text = GOOD.replace("reply: OK", "reply: OK|DONE")
    Document.parse(text, "p.yaml").validate(SerialSettings, ("a",))
    with pytest.raises(ConfigError, match=r"8:31: .* a reply of the pattern 'OK\|DONE'; .* add 'example'"):
        Document.parse(text.replace("COM3", "simulated"), "p.yaml").validate(SerialSettings, ("a",))


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


@given(numbers())
def test_no_format_leads_beyond_a_limit(number: tuple[dict[str, Any], str, Any]) -> None:
    declared, spec, value = number
    try:
        command = CommandSettings.model_validate({"send": f"{{a:{spec}}}", "arguments": {"a": declared}})
    except ValidationError:
        reject()  # limits with more digits than are sent
    argument = command.arguments["a"]
    low, high = argument.limits
    sent = argument.quantity.from_line(float(command.text({"a": value})))
    slack = 1e-9 * max(abs(low), abs(high))
    assert low - slack <= sent <= high + slack


@pytest.mark.parametrize("given_as", ["120 A", "mA", True, None, [1], float("inf")])
def test_what_is_no_number_in_the_unit_is_refused(given_as: object) -> None:
    assert Unit.of("mA").read("120 mA") == Unit.of("mA").read(120) == 120.0
    with pytest.raises(ValueError, match="expected"):
        Unit.of("mA").read(given_as)


@pytest.mark.parametrize(
    ("reply", "example", "expected"),
    [
        (r"C(?P<value>[-+.\d]+) deg", None, "C21.46 deg"),
        (r"C(?P<value>[-+.\d]+) ?deg", None, None),
        (r"C(?P<value>[-+.\d]+) ?deg", "C3.5deg", "C21.5deg"),
        (r"C(?P<value>\d\.\d) ?deg", "C3.5deg", "C3.5deg"),
    ],
)
def test_a_simulated_value_is_written_into_the_pattern_or_the_example(
    reply: str, example: str | None, expected: str | None
) -> None:
    value = ValueSettings.model_validate({"ask": "T?", "reply": reply, "example": example})
    assert value.reply_with(21.46) == expected


def test_arguments_are_written_as_their_formats_say() -> None:
    arguments = {name: {"type": "int", "min": 0, "max": 31} for name in ("row", "col")}
    command = CommandSettings.model_validate(
        {"send": "S{row:02d}{col:02X}{{}}={row}", "arguments": arguments}
    )
    assert command.text({"row": 3, "col": 31}) == "S031F{}=3"


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
        on: {type: text, choices: [OFF, ON]}
        wave: {type: text}
  values:
    level: {ask: "LEVEL?", unit: mV, reply: "(?P<value>[0-9]+[.][0-9]{2}) mV", example: "10.00 mV"}
    n: {ask: "N?", type: int, reply: "N=(?P<value>[0-9])"}
    on: {ask: "ON?", type: text}
    wave: {ask: "WAVE?", type: text}
"""
    device = SerialDevice(settings(text), Context("source", clock=FakeClock()))
    device.open()
    device.command("set", level="125 mV", n=7.0, on="ON", wave="SIN")
    read = {name: device.read(name) for name in ("level", "n", "on", "wave")}
    assert read == {"level": 0.125, "n": 7, "on": "ON", "wave": "SIN"}
    for text in ("ü", "A\nOUT ON", " A", "", "x" * 201):
        with pytest.raises(DeviceError, match="use another 'encoding'" if text == "ü" else "expected"):
            device.command("set", level=0, n=1, on="OFF", wave=text)
    assert device.read("wave") == "SIN"


GUIDE = Path(__file__).parents[2] / "docs" / "how-to" / "serial-devices.md"


def examples_of_the_guide() -> Iterator[tuple[str, dict[str, Any]]]:
    for text in re.findall(r"^```yaml\n(devices:.*?)^```$", GUIDE.read_text(), re.DOTALL | re.MULTILINE):
        node = compose(text, "guide")
        assert node is not None
        yield from node.plain()["devices"].items()


@pytest.mark.parametrize(("name", "example"), [*examples_of_the_guide()], ids=str)
def test_the_examples_of_the_guide_stand_their_own_dry_run(name: str, example: dict[str, Any]) -> None:
    described = {key: value for key, value in example.items() if key not in ("use", "blinding", "usb")}
    described["port"] = "simulated"
    settings = Document.parse(json.dumps({name: described}), "guide").validate(SerialSettings, (name,))
    device = SerialDevice(settings, Context(name, clock=FakeClock()))
    device.open()
    device.self_test()
    device.check_interlocks()
    for command, declared in settings.commands.items():
        limits = {name: argument.limits for name, argument in declared.arguments.items()}
        for k in (0, 1):
            arguments = {name: both[k] for name, both in limits.items()}
            device.command(command, **arguments)
            for argument in set(arguments) & set(settings.values):
                assert device.read(argument) == pytest.approx(arguments[argument])
    device.safe_state()
    before = device.poll()
    device.safe_state()
    assert device.poll() == before
    device.close()
