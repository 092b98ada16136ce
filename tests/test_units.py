import pytest
from hypothesis import given, strategies as st

from labseq.units import UNITS, expected, format_quantity, parse_quantity


@pytest.mark.parametrize(
    ("text", "dimension", "value"),
    [
        ("45 ms", "time", 0.045),
        ("60 µs", "time", 60e-6),
        ("4.49 um", "length", 4.49e-6),
        ("130 um/ms", "speed", 0.13),
        ("130 µm/ms", "speed", 0.13),
        ("80 MHz", "frequency", 80e6),
        ("75 %", "fraction", 0.75),
        ("0.75", "fraction", 0.75),
        ("300 uK", "temperature", 300e-6),
        ("0 degC", "temperature", 273.15),
    ],
)
def test_quantities_become_si(text, dimension, value):
    assert parse_quantity(text, dimension) == value


@pytest.mark.parametrize(
    ("text", "dimension", "message"),
    [
        ("45", "time", "'45' has no unit"),
        ("45 MHz", "time", "'45 MHz' is a frequency, not a time"),
        ("45 lightyears", "length", "'lightyears' in '45 lightyears' is not a unit of length"),
        ("steep", "angle", "'steep' is not an angle"),
        ("45 deg", "temperature", "'45 deg' is an angle, not a temperature"),
        ("", "time", "'' is not a time"),
        ("nan ms", "time", "is not a time"),
    ],
)
def test_wrong_quantities_say_what_was_expected(text, dimension, message):
    with pytest.raises(ValueError, match="expected") as caught:
        parse_quantity(text, dimension)
    assert message in str(caught.value)
    assert expected(dimension) in str(caught.value)


@given(st.text(max_size=40), st.sampled_from(sorted(UNITS)))
def test_any_text_is_a_number_or_a_value_error(text, dimension):
    try:
        assert isinstance(parse_quantity(text, dimension), float)
    except ValueError as error:
        assert "expected" in str(error)


@pytest.mark.parametrize(
    ("value", "shown"),
    [(1e300, "1e+300 s"), (-2e9, "-2e+09 s"), (123456789.0, "123456789 s"), (1e-20, "0 ns")],
)
def test_absurd_values_stay_short(value, shown):
    assert format_quantity(value, "time") == shown


@given(st.floats(1e-9, 1e3), st.sampled_from(["time", "length"]))
def test_what_is_shown_reads_back(value, dimension):
    shown = format_quantity(value, dimension, digits=9)
    assert parse_quantity(shown, dimension) == pytest.approx(value, rel=1e-2, abs=1e-9)


def test_every_dimension_has_a_name_and_a_format():
    for dimension in UNITS:
        assert dimension in expected(dimension)
        assert format_quantity(1.0, dimension)
        assert format_quantity(0.0, dimension).startswith("0 ")
