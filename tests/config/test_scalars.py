from __future__ import annotations

import math

import pytest

from labseq.config.yaml_nodes import MAX_DIGITS, resolve


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("~", None),
        ("Null", None),
        ("true", True),
        ("FALSE", False),
        ("12", 12),
        ("-0", 0),
        ("+3", 3),
        ("010", 10),
        ("0o17", 15),
        ("0xfF", 255),
        ("1.", 1.0),
        (".5", 0.5),
        ("-1e3", -1000.0),
        ("1E+2", 100.0),
        (".inf", math.inf),
        ("-.Inf", -math.inf),
    ],
)
def test_core_schema(text: str, value: object) -> None:
    assert resolve(text) == value
    assert type(resolve(text)) is type(value)


@pytest.mark.parametrize(
    "texts",
    ["yes no on off y TRue nULL", "10:30 2026-01-01 1_000 1.2.3", "0b1 -0x1 0o8 1e .", "inf nan + - << = ١٢"],
)
def test_everything_else_is_text(texts: str) -> None:
    for text in texts.split():
        assert resolve(text) == text


def test_nan() -> None:
    value = resolve(".nan")
    assert isinstance(value, float)
    assert math.isnan(value)


@pytest.mark.parametrize("text", ["1" * 5000, "1." + "0" * 200, "0x" + "f" * 200])
def test_endless_numbers_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=f"{len(text)} characters"):
        resolve(text)


def test_long_numbers_are_read() -> None:
    assert resolve("9" * MAX_DIGITS) == 10**MAX_DIGITS - 1
