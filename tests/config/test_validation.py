"""Values against settings models: every message with its place."""

# ruff: noqa: E501, RUF012 - messages are quoted as they are printed; pydantic copies defaults

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import pytest
from pydantic import Field, field_validator, model_validator

from labseq.config.document import Document
from labseq.config.validation import validate_values
from labseq.config.validation_errors import MAX_HINTS
from labseq.errors import ConfigError
from labseq.settings import Duration, Fraction, Length, NoSettings, Settings

LENGTH = "a length such as '4.49 um' (m, mm, um, nm)"
TIME = "a time such as '45 ms' (s, ms, us, ns, min, h)"


class Colour(Enum):
    RED = "red"
    BLUE = "blue"


class Inner(Settings):
    width: Length = 1e-6
    count: int = Field(default=1, ge=1, description="How many. And more")


class Cat(Settings):
    kind: Literal["cat"]
    lives: int = 9


class Dog(Settings):
    kind: Literal["dog"]
    tricks: list[str] = []


class Model(Settings):
    rows: int = Field(description="Rows of the block. Not columns")
    fraction: Fraction = 0.5
    exposure: Annotated[Duration, Field(gt=0, le=10)] = 0.1
    on: bool = False
    text: str = ""
    colour: Colour = Colour.RED
    pair: tuple[int, int] = (0, 0)
    files: set[str] = set()
    path: Path = Path()
    inner: Inner = Inner()
    many: list[Inner] = []
    named: dict[str, Inner] = {}
    by_number: dict[int, int] = {}
    either: int | list[int] | None = None
    window: Duration | tuple[Duration, ...] = 1.0
    shape: Inner | Literal["none"] = "none"
    pet: Annotated[Cat | Dog, Field(discriminator="kind")] | None = None
    other: int = Field(default=0, alias="else", multiple_of=3, lt=10)


def validate(text: str, **options: Any) -> Model:
    document = Document.parse(f"plan:\n  rows: 1\n{text}", "f.yaml")
    return document.validate(Model, ("plan",), **options)


def problems(text: str, **options: Any) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        validate(text, **options)
    return [str(problem).removeprefix("f.yaml:") for problem in caught.value.problems]


def test_right_settings() -> None:
    model = validate(
        "  fraction: 75 %\n  exposure: 3 s\n  pair: [1, 2]\n  files: [a]\n  path: x/y\n  colour: blue\n"
        "  inner: {width: 4.49 um}\n  many: [{}, {count: 2}]\n  named: {a: {count: 3}}\n  either: [1]\n"
        "  window: [60 ms, 0.1 s]\n  shape: none\n  pet: {kind: dog, tricks: [sit]}\n  else: 9\n  by_number: {'1': 2}"
    )
    assert model.model_dump(exclude_defaults=True) == {
        "rows": 1,
        "fraction": 0.75,
        "exposure": 3.0,
        "pair": (1, 2),
        "files": {"a"},
        "path": Path("x/y"),
        "colour": Colour.BLUE,
        "inner": {"width": 4.49e-6},
        "many": [{}, {"count": 2}],
        "named": {"a": {"count": 3}},
        "by_number": {1: 2},
        "either": [1],
        "window": (0.06, 0.1),
        "pet": {"kind": "dog", "tricks": ["sit"]},
        "else": 9,
    }


MISTAKES = f"""
on: yes
  3:7: on is 'yes'; expected true or false; did you mean true?
on: 1
  3:7: on is 1; expected true or false
text: 2026
  3:9: text is 2026; expected text; put it in quotes
colour: rde
  3:11: colour is 'rde'; expected 'red' or 'blue'; did you mean 'red'?
pair: [1]
  3:9: pair has 1 entry; expected at least 2
pair: [1, 2, 3]
  3:9: pair has 3 entries; expected at most 2
pair: [1, x]
  3:13: pair.1 is 'x'; expected a whole number
files: a
  3:10: files is 'a'; expected a list ([a, b], or lines that begin with '- ')
fraction: 120 %
  3:13: fraction is '120 %'; expected at most 1 (in SI units)
exposure: 11 s
  3:13: exposure is '11 s'; expected at most 10 (in SI units)
exposure: 1.1e1
  3:13: exposure is 1.1e1, without a unit; expected a time such as '45 ms' (s, ms, us, ns, min, h); write '1.1e1 ms' or '1.1e1 s'
inner: [1]
  3:10: inner is a list; expected a mapping (key: value)
inner: {{cuont: 1}}
  3:11: 'cuont' is not a setting of 'inner'; expected one of width, count; did you mean 'count'?
many: [{{}}, {{count: 0x0}}]
  3:22: count is 0x0; expected at least 1
many: [{{COUNT: 1}}]
  3:11: 'COUNT' is not a setting of 'many.0'; expected one of width, count; did you mean 'count'?
named: {{a: {{width: 1 s}}}}
  3:22: width: '1 s' is a time, not a length; expected {LENGTH}
by_number: {{x: 1}}
  3:15: the key 'x' is 'x'; expected a whole number
else: 4
  3:9: else is 4; expected a multiple of 3
else: '{"1" * 150}'
  3:9: else is '{"1" * 57}...'; expected a whole number
either: x
  3:11: either is 'x'; expected a whole number or a list ([a, b], or lines that begin with '- ')
either: [1, x]
  3:15: either.1 is 'x'; expected a whole number
window: 1 K
  3:11: window: '1 K' is a temperature, not a time; expected {TIME}
window: {{}}
  3:11: window is a mapping; expected {TIME}
window: [1 s, -2 s]
  3:17: window.1 is '-2 s'; expected at least 0
shape: noen
  3:10: shape is 'noen'; expected 'none'
shape: {{count: 0}}
  3:18: count is 0; expected at least 1
pet: {{kind: cow}}
  3:15: kind is 'cow'; expected 'cat', 'dog'
pet: {{lives: 1}}
  3:8: 'kind' is missing from 'pet'
pet: {{kind: cat, live: 1}}
  3:20: 'live' is not a setting of 'pet'; expected one of kind, lives, tricks; did you mean 'lives'?
""".strip().splitlines()


@pytest.mark.parametrize(("text", "message"), [*zip(MISTAKES[::2], MISTAKES[1::2], strict=True)])
def test_a_mistake_gives_one_message(text: str, message: str) -> None:
    assert problems(f"  {text}") == [message.strip()]


def test_all_problems_in_file_order() -> None:
    found = problems("  inner: {cuont: 1, width: 1 K}\n  txt: 1\n  on: 5\n  pair: 5")
    assert [line.split(": ")[0] for line in found] == ["3:11", "3:28", "4:3", "5:7", "6:9"]


def test_problems_of_options_come_last() -> None:
    document = Document.parse("rows: x\non: 5\n", "f.yaml").override("rows", "1.5", "--set rows=1.5")
    with pytest.raises(ConfigError) as caught:
        document.validate(Model)
    assert [str(problem).split(": ")[0] for problem in caught.value.problems] == [
        "f.yaml:2:5",
        "--set rows=1.5",
    ]


@pytest.mark.parametrize("text", ["", "plan:", "plan: {}", "other: 1"])
def test_empty_and_missing_mappings_count_as_empty(text: str) -> None:
    document = Document.parse(f"first: 1\n{text}", "f.yaml")
    assert document.validate(Inner, ("plan",)) == Inner()
    with pytest.raises(ConfigError, match=r"'rows' is missing from 'plan' \(rows of the block\)$"):
        document.validate(Model, ("plan",))


def test_misspelt_key_is_not_missing_as_well() -> None:
    document = Document.parse("plan: {row: 1}", "f.yaml")
    with pytest.raises(ConfigError) as caught:
        document.validate(Model, ("plan",))
    (problem,) = caught.value.problems
    assert problem.hint == "did you mean 'rows'?"


def test_dropped_keys_are_left_out_and_not_offered() -> None:
    assert validate("  use: psca\n  speed: fast\n", core_keys={"use", "speed"}).rows == 1
    (problem,) = problems("  user: x", core_keys={"use", "speed"})
    assert "did you mean" not in problem
    assert ", speed" in problem
    assert "use," not in problem


def test_nothing_to_set() -> None:
    document = Document.parse("camera: {use: x, gain: 3}", "f.yaml")
    document.validate(NoSettings, ("camera",), core_keys={"use", "gain"})
    with pytest.raises(ConfigError) as caught:
        document.validate(NoSettings, ("camera",), core_keys={"use"})
    assert str(caught.value).startswith("f.yaml:1:18: ")
    assert "'gain'" in str(caught.value)


def test_of_very_many_unknown_keys_only_the_first_are_compared_with_the_known_ones() -> None:
    text = "".join(f"width{i}: 1\n" for i in range(MAX_HINTS + 2))
    with pytest.raises(ConfigError) as caught:
        Document.parse(text, "f.yaml").validate(Inner)
    hints = [problem.hint for problem in caught.value.problems]
    assert hints == ["did you mean 'width'?"] * MAX_HINTS + ["", ""]


def test_python_and_numpy_values() -> None:
    values = {"rows": np.int64(3), "pair": np.array([1, 2]), "path": Path("a") / "b", "colour": Colour.BLUE}
    made = validate_values(Model, {**values, "exposure": "45 ms"}, "planner 'x'")
    assert made.model_dump(exclude_defaults=True) == {
        "rows": 3,
        "pair": (1, 2),
        "path": Path("a") / "b",
        "colour": Colour.BLUE,
        "exposure": 0.045,
    }


@pytest.mark.parametrize(
    ("model", "values", "message"),
    [
        (Model, {"rows": 3.0}, "rows is 3.0; expected a whole number; write 3"),
        (Model, {"rows": "3"}, "rows is '3'; expected a whole number; write 3 without quotes"),
        (Model, {"rows": 1, "rwos": 3}, "'rwos' is not a setting of it; expected one of rows, fraction, "),
        (Model, {"rows": 1, "pair": (1, None)}, "pair.1 is empty; expected a whole number"),
        (Model, {"rows": 1, "fraction": float("nan")}, "fraction is nan; expected a finite number"),
        (
            Model,
            {"rows": object()},
            "a value of type object is not a setting; expected a number, text, list or",
        ),
        (Model, {"rows": 1, "window": 1e300}, "window is 1e+300; expected at most 720 h, which is 30 days"),
        (None, {"a": 1}, "it takes no settings, but 'a' is given; remove it"),
    ],
)
def test_wrong_python_values_name_what_they_are_for(model: Any, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        validate_values(model, values, "planner 'x'")
    assert str(caught.value).startswith(f"planner 'x': {message}")


class Custom(Settings):
    pair: tuple[int, ...] = ()
    limit: int = 5

    @model_validator(mode="before")
    @classmethod
    def _any(cls, value: Any) -> Any:
        return value

    @field_validator("limit")
    @classmethod
    def _limit(cls, limit: int) -> int:
        if limit == 13:
            raise KeyError("unlucky")
        if limit == 12:
            raise ValueError("12 is reserved; expected another number; ask the night shift")
        if limit == 11:
            raise AssertionError("11 is\n   odd")
        return limit

    @model_validator(mode="after")
    def _together(self) -> Self:
        if self.limit < len(self.pair):
            raise ValueError("more numbers than the limit")
        return self


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("limit: 12", "1:12: limit: 12 is reserved; expected another number; ask the night shift"),
        ("limit: 11", "1:12: limit: 11 is odd"),
        ("limit: 13", "1:4: the plugin's check of these settings failed: KeyError: 'unlucky'"),
        ("limit: 1, pair: [1, 2]", "1:4: a: more numbers than the limit"),
        ("pair: [1, x]", "1:15: pair.1 is 'x'"),
        ("pair: 5", "1:11: pair is 5; expected a list"),
    ],
)
def test_validators_of_plugins(text: str, message: str) -> None:
    document = Document.parse(f"a: {{{text}}}", "f.yaml")
    with pytest.raises(ConfigError) as caught:
        document.validate(Custom, ("a",))
    assert str(caught.value).removeprefix("f.yaml:").startswith(message)


def test_lists_become_tuples_behind_validators_too() -> None:
    assert Document.parse("a: {pair: [1, 2]}", "f.yaml").validate(Custom, ("a",)).pair == (1, 2)
