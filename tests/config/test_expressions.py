"""Expressions in files: against a reference that only adds up, and everything that can be wrong with them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from labseq.config.document import Document
from labseq.config.expressions import MAX_LENGTH, MAX_PARTS, MAX_PROBLEMS, POWERS
from labseq.config.sequence import load_sequence
from labseq.errors import ConfigError
from labseq.units import parse_any

VALUES = """variables: {hold: 20 ms, n: 3, way: 4.49 um, half: 50 %, turn: 90 deg, warm: 25 degC, zero: 0}
shot:
  - image: {exposure: 45 ms, name: x}
  - {name: sort, rearrange: {window: [60 ms, 0.04]}}
  - {name: a-b, image: {exposure: 1 s}}
"""
N_VALUES = VALUES.count("\n")


def value(text: str, more: str = "") -> Any:
    document = Document.parse(f"{VALUES}{more}it: {text}\n", "s.yaml").evaluated()
    return document.data["it"]


def refused(text: str, more: str = "") -> str:
    with pytest.raises(ConfigError) as caught:
        value(text, more)
    return "\n".join(str(problem).replace(f"s.yaml:{N_VALUES + 1}:", "") for problem in caught.value.problems)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("= 2 * shot.0.image.exposure", "0.09 s"),
        ("= variables.hold + 5 ms", "0.025 s"),
        ('"= min(variables.hold, 5 ms)"', "0.005 s"),
        ("= shot.sort.window.0 / 3", "0.02 s"),
        ("= shot.sort.window.1", 0.04),
        ("= 2 * variables.n", 6),
        ("= 7 / 2", 3.5),
        ("= 2 ** 3 ** 2", 512),
        ("= -2 ** 2", -4),
        ("= --3 - -2", 5),
        ("= variables.way / variables.hold", "0.0002245 m/s"),
        ("= 1 / variables.hold", "50.0 Hz"),
        ("= 2 MHz * 3 us", 6.0),
        ("= sqrt(4 um * 9 um)", "6e-06 m"),
        ("= (2 ms) ** 2 / 1 ms", "0.004 s"),
        ("= sin(variables.turn) + cos(0) + tan(0)", 2.0),
        ("= 75 % * 2", 1.5),
        ("= variables.warm - 5 K", "293.15 K"),
        ("= 25 degC - 5 K", "293.15 K"),
        ("= exp(log(3))", 3.0),
        ("= floor(2.7) + ceil(2.1) + round(2.6)", 8),
        ("= 0.1 + 0.2", 0.3),
        ("== 2 + 3", "= 2 + 3"),
    ],
)
def test_what_comes_out(text: str, expected: Any) -> None:
    assert value(text) == expected
    assert type(value(text)) is type(expected)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("= 2 * (3 + 4", "11: the '(' that opens here is never closed; expected ')'"),
        ("=", "5: the expression ends too early; expected a number, an address or '('"),
        (
            "= 2 3",
            "9: '3' is not allowed here; expected numbers, addresses, functions, brackets and + - * / **",
        ),
        ("= 2 + 3)", "12: ')' is not allowed here"),
        ("= variables.hold + 5", "22: a time and a number cannot be added; give the number its unit"),
        ('"= min(2 ms, 3)"', "8: a time and a number cannot be compared"),
        ("= variables.hodl", "7: there is no 'variables.hodl' in this file; did you mean 'hold'?"),
        (
            "= shot.0.image.gain",
            "7: there is no 'shot.0.image.gain' in this file; an expression can only use",
        ),
        ("= shot.0.image", "7: 'shot.0.image' is a mapping"),
        ("= shot.0.image.name", "7: 'shot.0.image.name' is 'x'; expected a number or a quantity"),
        ("= 1 / variables.zero", "9: this divides by zero"),
        ("= exp(1e9)", "7: this number is too large"),
        ("= 2 ** 1e6", "9: the exponent is 1e+06; expected a number from -1000 to 1000"),
        ("= (1 s) ** 0.5", "13: a time can only be raised to a whole power"),
        ("= (-2) ** 0.5", "12: a negative number can only be raised to a whole power"),
        ("= sqrt(-1)", "7: this function has no value here"),
        ("= sqrt(2 s)", "7: the square root of a time has no valid unit"),
        ("= exp(2 s)", "7: exp() of a time; expected a number"),
        ("= sin(1, 2)", "sin() takes 1 value, not 2"),
        ("= min(1)", "7: min() takes 2 values or more, not 1"),
        ("= sni(1)", "7: there is no function 'sni'; expected one of"),
        ("= __import__('os')", "18: ''' is not allowed here"),
        ("= variables.n.real", "has no 'real' in it"),
        ("= 1 s * 1 s", "5: the result is in s^2, which is not a unit of any setting"),
        ("= (1 m) ** 13", "13: powers of units go up to 12"),
        ("= it", "7: this is a circular reference: it -> it"),
        (f"= {'-' * 300}1", f"the expression has more than {MAX_PARTS} parts"),
        (f"= {'(' * 240}1{')' * 240}", "'(' is not allowed here"),
        (f"= {'1 + ' * 200}1", f"the expression has 803 characters; expected at most {MAX_LENGTH}"),
    ],
)
def test_a_wrong_expression_is_reported_with_its_place(text: str, message: str) -> None:
    in_quotes = ", " in text and not text.startswith('"')  # the place is then counted from the quotes
    found = refused(f"'{text}'" if in_quotes else text)
    assert (message.partition(": ")[2] if in_quotes else message) in found
    assert "\n" not in found


def test_a_circle_and_what_depends_on_it_is_reported_once() -> None:
    more = "a: = b + 1\nb: = c\nc: = 2 * a\n"
    (reported,) = refused("= a", more).splitlines()
    assert reported.endswith("this is a circular reference: a -> b -> c -> a")


@pytest.mark.parametrize("wrong", ["= b +", "= nothing", "= 1 s + 1"])
def test_an_expression_that_refers_to_a_wrong_one_is_not_reported_as_well(wrong: str) -> None:
    assert len(refused("= 2 * a", f"a: {wrong}\n").splitlines()) == 1


def test_a_long_chain_ends() -> None:
    chain = "".join(f"v{i}: = v{i + 1}\n" for i in range(1500)) + "v1500: 7\n"
    assert value("= v0", chain) == 7


def test_thousands_of_unknown_names_are_refused_without_comparing_all_of_them() -> None:
    many = "".join(f"v{i}: = w{i}.x\n" for i in range(2500))
    lines = refused("= 1", many).splitlines()
    assert len(lines) == MAX_PROBLEMS
    assert "expected one of variables, shot, v0, v1, v2, " in lines[0]
    assert ", v46, v47, and 2453 more; " in lines[0]
    assert max(map(len, lines)) < 500


def test_the_place_in_an_option_is_its_character() -> None:
    document = Document.parse(VALUES, "s.yaml").override(
        "variables.n", "= 2 + x", "--set variables.n== 2 + x"
    )
    with pytest.raises(
        ConfigError, match=r"^--set .*: there is no 'x' in this file \(character 7 of '= 2 \+ x'\)"
    ):
        document.evaluated()


def test_what_depends_on_an_override_is_worked_out_again() -> None:
    document = Document.parse(VALUES + "it: = 2 * variables.hold\n", "s.yaml").evaluated()
    assert document.override("variables.hold", "30 ms", "--set").data["it"] == "0.06 s"
    assert document.override("it", "5", "--set").data["it"] == 5
    assert document.data["it"] == "0.04 s"


def test_what_follows_from_a_value_through_another_one_is_known() -> None:
    document = Document.parse("a: 2\nb: = 2 * a\nc: = b + 1\nd: = 2 * e.f\ne: {f: 5}\n", "s.yaml").evaluated()
    assert document.expressions is not None
    assert document.expressions.following(("a",)) == [("b",), ("c",)]
    assert document.expressions.following(("e",)) == [("d",)]


def test_a_field_checks_the_result(tmp_path: Path) -> None:
    text = (
        "labseq: 1\nname: s\nshots: 1\ntarget: {pattern: compact}\nshot:\n  - image: {}\nattempts: = 7 / 2\n"
    )
    (tmp_path / "s.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"s.yaml:7:11: attempts is 3.5; expected a whole number"):
        load_sequence(tmp_path / "s.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{hold: text}", "a variable is 'text'; expected a number, or a number with a unit"),
        ("{hold: [1]}", "a variable is a list"),
        ("{a b: 1}", "a variable is called 'a b'; expected letters, digits and '_', a letter first"),
    ],
)
def test_wrong_variables(tmp_path: Path, text: str, message: str) -> None:
    rest = "labseq: 1\nname: s\nshots: 1\ntarget: {pattern: compact}\nshot:\n  - image: {}\n"
    (tmp_path / "s.yaml").write_text(f"{rest}variables: {text}\n")
    with pytest.raises(ConfigError) as caught:
        load_sequence(tmp_path / "s.yaml")
    assert message in str(caught.value)
    assert caught.value.problems[0].line == 7


# A naive reference: values as floats with a dict of powers, worked out while the text is put together.

Worked = tuple[str, float, dict[str, int]] | None
BASE = {"time": {"s": 1}, "length": {"m": 1}, "frequency": {"s": -1}, "voltage": {"V": 1}, "fraction": {}}


def literal(amount: float, unit: str) -> Worked:
    if not unit:
        return f"{amount!r}", amount, {}
    si, dimension = parse_any(f"{amount!r} {unit}")
    return f"{amount!r} {unit}", si, BASE[dimension]


def both(left: Worked, right: Worked, sign: str) -> Worked:
    if left is None or right is None:
        return None
    (a, x, p), (b, y, q) = left, right
    text = f"({a}) {sign} ({b})"
    if sign in "+-":
        return (text, x + y if sign == "+" else x - y, p) if p == q else None
    if sign == "/" and y == 0:
        return None
    way = 1 if sign == "*" else -1
    powers = {unit: p.get(unit, 0) + way * q.get(unit, 0) for unit in {*p, *q}}
    return text, x * y if sign == "*" else x / y, {unit: n for unit, n in powers.items() if n}


def minus(one: Worked) -> Worked:
    return None if one is None else (f"-({one[0]})", -one[1], one[2])


UNITS_TRIED = ["", "", "s", "ms", "us", "um", "kHz", "mV", "%"]
LEAVES = st.builds(
    literal, st.one_of(st.integers(0, 50), st.floats(0.01, 99.0)), st.sampled_from(UNITS_TRIED)
)
TREES: st.SearchStrategy[Worked] = st.recursive(
    LEAVES,
    lambda inner: st.one_of(st.builds(both, inner, inner, st.sampled_from("+-*/")), st.builds(minus, inner)),
    max_leaves=8,
)


def si_of(result: Any) -> tuple[float, tuple[int, ...]]:
    if isinstance(result, str):
        amount, dimension = parse_any(result)
        return amount, POWERS[dimension]
    return result, POWERS["fraction"]


@settings(max_examples=60)
@given(TREES)
def test_expressions_come_out_as_the_reference_works_them_out(tree: Worked) -> None:
    if tree is None:  # the reference could not work it out, and the text is gone with it
        return
    text, expected, powers = tree
    wanted = tuple(powers.get(unit, 0) for unit in ("s", "m", "V", "W", "K", "rad"))
    if len(text) + 2 > MAX_LENGTH or not math.isfinite(expected):
        return
    if wanted not in POWERS.values():
        assert "not a unit of any setting" in refused(f"'= {text}'") or "powers of units" in refused(
            f"'= {text}'"
        )
        return
    amount, found = si_of(value(f"'= {text}'"))
    assert found == wanted
    assert math.isclose(amount, expected, rel_tol=1e-9, abs_tol=1e-12)


@settings(max_examples=60)
@given(st.text("0123456789.+-*/() eamsn%,=xX_", max_size=40))
def test_any_text_is_worked_out_or_refused(text: str) -> None:
    quoted = f'"= {text}"'
    try:
        assert isinstance(value(quoted), int | float | str)
    except ConfigError as error:
        assert error.problems[0].line == N_VALUES + 1
