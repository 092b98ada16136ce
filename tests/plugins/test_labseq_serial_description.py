"""The description of an instrument: settings, templates, patterns, and their mistakes with line and caret."""

from __future__ import annotations

import json
import re
import string
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, reject, strategies as st
from labseq_serial.device import SerialDevice
from labseq_serial.patterns import Template, example_of
from labseq_serial.settings import CommandSettings, SerialSettings
from labseq_serial.values import Unit
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
  safe_state: [off, {do: set, arguments: {f: 1 MHz, n: 0, wave: SIN}}]
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
        ("OUT 0,", "ÖUT 0,", "8:17: 'ÖUT 0' is not ascii; expected another 'encoding', or other characters"),
        ("OUT 0,", '"OUT 0\\r",', "8:17: 'OUT 0\\r' holds what ends a command; expected it without"),
        # templates and their arguments
        (
            "{f:.1f}",
            "{F:.1f}",
            "10:13: '{F}' is not an argument; expected one of 'f', 'n', 'wave'; did you mean",
        ),
        ("{f:.1f},", "", "12:9: the argument 'f' has no place in 'FREQ {n:02d},{wave}'; expected a placeho"),
        ("{f:.1f}", "{f:.1q}", "10:13: '{f:.1q}' is not a format of a float"),
        ("{n:02d}", "{n:.1f}", "10:13: '0.0' cannot be read back; expected a format of plain numbers"),
        ("{f:.1f}", "{f", "10:13: 'FREQ {f,{n:02d},{wave}' is not a template"),
        ("{f:.1f}", "{f.real}", "10:13: the placeholder '{f.real}' is not the name"),
        (",{n:02d},{wave}", "{n}{wave}", "10:13: the arguments cannot be separated in 'FREQ 200.015SQU'"),
        (
            "min: 1 MHz",
            "min: 1.04 MHz",
            "12:29: as 'FREQ 1.0,00,SIN' it would be 1 MHz, beyond the limit",
        ),
        ("min: 1 MHz", "min: 300 MHz", "12:29: min is 300 MHz, more than max, 200 MHz; expected min below"),
        (
            "min: 1 MHz",
            "min: 1 mm",
            "12:29: '1 mm' is a length, not a frequency; expected a frequency",
        ),
        (", max: 200 MHz", "", "12:12: 'max' is missing; expected both limits of a number that is sent"),
        ("unit: MHz", "unit: Mhz", "12:19: labseq knows no unit 'Mhz'; expected another one; did you mean"),
        ("min: 0, max: 15", "min: 0.2, max: 0.7", "13:29: there is no whole number within the limits"),
        ("type: int, min: 0, max: 15", "type: bool, max: 3", "13:25: 'max' is not for type bool; exp"),
        ("choices: [SIN, SQU]", "words: [a, b]", "14:28: 'words' is not for type text; expected type"),
        ("        n:", "        name:", "an argument is called 'name'; expected a word of letters"),
        # replies and effects
        ("reply: OK", "reply: '(OK'", "8:31: '(OK' is not a regular expression: missing ), unterminated"),
        (
            "reply: OK, ",
            "",
            "8:24: 'error' is about a reply, but no 'reply' is waited for; expected a",
        ),
        ("reply: OK", "reply: '(?=x)x'", "8:31: labseq cannot generate a reply like '(?=x)x'; expected an"),
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
        ("(?P<value>[0-9]+)", "(?P<value>[a-f]+)", "18:38: labseq cannot generate a reply like"),
        ('[0-9]+)"', '[0-9]+)", example: N=x', "the reply 'N=x' does not match: expected a reply like"),
        ("words: [OFF, ON]", "words: [ON, ON]", "16:45: false and true are both 'ON'; expected two words"),
        ("one_of: [true]", "max: 3", "'max' is not for a value of type bool; expected one_of"),
        ("one_of: [true]", "one_of: [ON]", "the value is of type bool; expected true or false"),
        ("{max: 30 degC}", "{}", "the interlock allows everything; expected min, max or one_of"),
        ("{max: 30 degC}", "{min: 40 degC, max: 30 degC}", "min is 40 degC, more than max, 30 degC"),
        # the safe state
        (
            "[off, ",
            "[of, ",
            "19:16: there is no command 'of'; expected one of 'on', 'off', 'set'; did",
        ),
        ("[off, ", "[set, ", "19:16: 'set' needs f, n, wave; expected {do: set, arguments: {f: ...}}"),
        ("[off, ", "[{do: off, arguments: {f: 1}}, ", "19:38: 'off' has no argument 'f'; expected none"),
        ("{f: 1 MHz,", "{f: 1 GHz,", "f is 1 GHz; expected 1 MHz to 200 MHz"),
        (", n: 0,", ", n: 1.5,", "n: 1.5 is not accepted; expected a whole number"),
        ("wave: SIN}", "wave: SAW}", "wave: 'SAW' is not accepted; expected one of SIN, SQU"),
    ],
)
def test_mistakes_in_a_description(right: str, wrong: str, message: str) -> None:
    text = GOOD.replace(right, wrong, 1)
    assert text != GOOD
    with pytest.raises(ConfigError) as caught:
        Document.parse(text, "p.yaml").validate(SerialSettings, ("a",))
    assert message in str(caught.value)


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


@pytest.mark.parametrize("given_as", ["120 A", "mA", True, None, [1], float("inf")])
def test_what_is_no_number_in_the_unit_is_refused(given_as: object) -> None:
    assert Unit.of("mA").read("120 mA") == Unit.of("mA").read(120) == 120.0
    with pytest.raises(ValueError, match="expected"):
        Unit.of("mA").read(given_as)


PATTERNS = r"""OK
THORLABS SC10.*
(?P<model>THORLABS \w+) VERSION (?P<firmware>.*)
[+]?0,.*
^\d{4}-\d{2}$
(?:A|B(C|D))+[^x-z\]]?x{2,}
\x41\u00b0\.\s\S
a{b
[]a]+"""


@pytest.mark.parametrize("pattern", ["", *PATTERNS.splitlines()])
def test_a_reply_is_made_up_for_a_pattern(pattern: str) -> None:
    reply = example_of(pattern)
    assert reply is not None
    assert re.fullmatch(pattern, reply, re.DOTALL)


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
        for arguments in declared.extremes():
            device.command(command, **arguments)
            for argument in set(arguments) & set(settings.values):
                assert device.read(argument) == pytest.approx(arguments[argument])
    device.safe_state()
    before = device.poll()
    device.safe_state()
    assert device.poll() == before
    device.close()
