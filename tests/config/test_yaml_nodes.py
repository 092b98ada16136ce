"""YAML text to nodes: scalars, anchors, limits, and line and column of every value."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import pytest
from hypothesis import example, given, settings, strategies as st

from labseq.config.document import Document
from labseq.config.yaml_nodes import MAX_DEPTH, MAX_VALUES, compose, resolve
from labseq.errors import ConfigError, Loc


def plain(text: str) -> object:
    node = compose(text, "f.yaml")
    assert node is not None
    return node.plain()


def problems(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        compose(text, "f.yaml")
    return [str(problem) for problem in caught.value.problems]


def test_scalars_are_of_yaml_1_2() -> None:
    assert plain("{do: off, at: 10:30, on: 2026-01-01, n: 0o10, t: true, q: '1', e: }") == {
        "do": "off",
        "at": "10:30",
        "on": "2026-01-01",
        "n": 8,
        "t": True,
        "q": "1",
        "e": None,
    }
    assert plain("a: |\n  #.#\n  .#.\nb: >-\n  x\n  y\n") == {"a": "#.#\n.#.\n", "b": "x y"}


def test_aliases_are_replaced_by_their_values() -> None:
    assert plain("a: &w [1, {x: 2}]\nb: *w\nc: &k word\nd: {*k : 3}") == {
        "a": [1, {"x": 2}],
        "b": [1, {"x": 2}],
        "c": "word",
        "d": {"word": 3},
    }


def test_all_that_can_be_found_is_reported() -> None:
    places = [line.split(": ")[0] for line in problems("a: !x 1\nb: 1\nb: 2\n<<: {}\n3: 4\nc: [\n")]
    assert places == [f"f.yaml:{place}" for place in ("1:4", "3:1", "4:1", "5:1", "6:4")]


@given(st.text("{}[],:;-?&*a' \n", max_size=24))
@example("{}[")  # a bracket that opens after the document's end
@example("{;,{2,{}}")  # a mapping as a key of a mapping that is a key itself
def test_brackets_in_any_order_are_a_value_or_an_error_with_its_place(text: str) -> None:
    try:
        compose(text, "f.yaml")
    except ConfigError as error:
        assert all(problem.line and problem.column for problem in error.problems)


def test_nesting_up_to_the_limit() -> None:
    deepest = "[" * MAX_DEPTH + "]" * MAX_DEPTH
    plain(deepest)
    half = MAX_DEPTH // 2
    first = "a: &a " + "[" * half + "]" * half
    plain(f"{first}\nb: {'[' * (half - 1)}*a{']' * (half - 1)}")
    for text, place in (
        (f"{first}\nb: {'[' * half}*a{']' * half}", f"2:{4 + half}"),
        (f"[{deepest}]", f"1:{MAX_DEPTH + 1}"),
    ):
        (message,) = problems(text)
        assert re.match(rf"f\.yaml:{place}: .* more than {MAX_DEPTH} deep", message)


def test_number_of_values_up_to_the_limit() -> None:
    fits = MAX_VALUES - 1  # the list is a value too
    assert plain("[" + "1," * fits + "]") == [1] * fits
    (message,) = problems("[" + "1," * (fits + 1) + "]")
    assert re.match(rf"f\.yaml:1:{2 + 2 * fits}: .* more than {MAX_VALUES} values", message)


def test_alias_bomb() -> None:
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    for old, new in zip("abcd", "bcde", strict=True):  # so few that a failing check ends
        lines.append(f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]")
    (message,) = problems("\n".join(lines))
    assert f"more than {MAX_VALUES} values" in message


@pytest.mark.parametrize(
    "text",
    [
        "[" * 300_000,
        "{a: " * 250_000,
        "a:\n" * 100_000,
        "!" * 300_000,
        "'" + "x\n" * 100_000,
        "%TAG ! tag:\n---\n!x y",
    ],
    ids=lambda text: text[:12],
)
def test_hostile_text_ends_in_a_plain_error(text: str) -> None:
    assert len(problems(text)) >= 1


def test_an_alias_without_its_anchor() -> None:
    (message,) = problems("a: &best 1\nb: *bset")
    assert re.match(r"f\.yaml:2:4: .*'&bset'.*'best'", message)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("Null", None),
        ("true", True),
        ("12", 12),
        ("+3", 3),
        ("010", 10),
        ("0o17", 15),
        ("0xfF", 255),
        (".5", 0.5),
        ("-1e3", -1000),
        ("1.5E+3", 1500),
        ("1e-3", 0.001),
        ("1e16", 1e16),
        ("1E+2", 100),
        ("100.0", 100.0),
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


@pytest.mark.parametrize("text", ["1" * 5000, "1." + "0" * 200, "0x" + "f" * 200])
def test_endless_numbers_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=f"{len(text)} characters"):
        resolve(text)


BLOCK = """\
# comment
top: 1

grid:   # more
    rows: 20
    deep: {a: [1, {b: "x y"}], 'quoted key': 'it''s'}
list:
- 5
-   name: sort
    rearrange:
        window: [ 60 ms,
                  50 ms ]
- - inner
  - "two
    lines"
text: |
  one
  two
folded:
  plain over
  two lines
last: end
"""
PLACES: dict[Loc, tuple[int, int]] = {
    ("grid", "rows"): (5, 11),
    ("grid", "deep"): (6, 11),
    ("grid", "deep", "a", 1): (6, 19),
    ("grid", "deep", "a", 1, "b"): (6, 23),
    ("grid", "deep", "quoted key"): (6, 46),
    ("list",): (8, 1),
    ("list", 1): (9, 5),
    ("list", 1, "name"): (9, 11),
    ("list", 1, "rearrange"): (11, 9),
    ("list", 1, "rearrange", "window", 1): (12, 19),
    ("list", 2): (13, 3),
    ("list", 2, 0): (13, 5),
    ("list", 2, 1): (14, 5),
    ("text",): (16, 7),
    ("folded",): (20, 3),
    ("last",): (22, 7),
}
KEYS: dict[Loc, tuple[int, int]] = {
    ("grid",): (4, 1),
    ("grid", "deep", "a", 1, "b"): (6, 20),
    ("grid", "deep", "quoted key"): (6, 32),
    ("list", 1, "rearrange"): (10, 5),
    ("last",): (22, 1),
}


@pytest.mark.parametrize(("line_end", "mark"), [("\n", ""), ("\r\n", "\ufeff"), ("\r", "")])
def test_every_place(line_end: str, mark: str) -> None:
    document = Document.parse((mark + BLOCK.replace("\n", line_end)).encode(), "f.yaml")
    assert {loc: document.locate(loc) for loc in PLACES} == PLACES
    assert {loc: document.locate(loc, key=True) for loc in KEYS} == KEYS


def test_wide_characters_count_once() -> None:
    document = Document.parse("'µ é': {中: 1, \U0001f600: 2}", "f.yaml")
    assert document.locate(("µ é", "\U0001f600")) == (1, 18)


def test_empty_values_are_behind_their_key() -> None:
    document = Document.parse("a:\nb: {c: , d: }\ne:\n- \n", "f.yaml")
    assert document.locate(("a",)) == (1, 3)
    assert document.locate(("b", "c")) == (2, 7)
    assert document.locate(("e", 0)) == (4, 2)


def test_an_alias_has_its_own_place_and_its_items_that_of_the_anchor() -> None:
    document = Document.parse("a: &x\n  k: 1\nb: *x\n", "f.yaml")
    assert document.locate(("b",)) == (3, 4)
    assert document.locate(("b", "k")) == (2, 6)


def test_what_is_missing_is_at_its_nearest_parent() -> None:
    document = Document.parse("a: {b: [1]}\n", "f.yaml")
    assert document.locate(()) == (1, 1)
    assert document.locate(("z", "y")) == (1, 1)
    assert document.locate(("a", "z")) == (1, 4)
    assert document.locate(("a", "z"), key=True) == (1, 4)
    assert document.locate(("a", "b", 1)) == (1, 8)
    assert document.locate(("a", "b", 0, "z")) == (1, 9)
    assert document.locate(("a", "b", "z")) == (1, 8)


@dataclass
class Writer:
    """Writes a tree as YAML in many styles and notes where it puts what."""

    draw: Callable[[int], int]  # a number from 0 up to the one given
    lines: list[str] = field(default_factory=lambda: [""])
    values: dict[Loc, tuple[int, int]] = field(default_factory=dict[Loc, tuple[int, int]])
    keys: dict[Loc, tuple[int, int]] = field(default_factory=dict[Loc, tuple[int, int]])

    def put(self, text: str) -> None:
        self.lines[-1] += text

    def line(self, indent: int) -> None:
        if self.draw(3) == 0:
            self.put("  # comment: [")
        self.lines += ["", " # another"][: self.draw(2)]
        self.lines.append(" " * indent)

    def here(self) -> tuple[int, int]:
        return len(self.lines), len(self.lines[-1]) + 1

    def scalar(self, value: str | int) -> None:
        quotes = ["'", '"'] if isinstance(value, str) else [""]
        quote = quotes[self.draw(len(quotes) - 1)]
        self.put(f"{quote}{value}{quote}")

    def flow(self, value: Any, loc: Loc) -> None:
        self.values[loc] = self.here()
        if isinstance(value, dict | list):
            pairs = cast("dict[str, Any]", value).items() if isinstance(value, dict) else enumerate(value)
            self.put("{" if isinstance(value, dict) else "[")
            for key, inner in pairs:
                if self.draw(4) == 0:
                    self.line(30)
                if isinstance(value, dict):
                    self.keys[*loc, key] = self.here()
                    self.scalar(key)
                    self.put(": ")
                self.flow(inner, (*loc, key))
                self.put(" , "[self.draw(1) :])
            self.put("}" if isinstance(value, dict) else "]")
        else:
            self.scalar(value)

    def block(self, value: Any, loc: Loc, indent: int) -> None:
        """Write a filled mapping or list; the cursor stands at its indentation."""
        self.values[loc] = self.here()
        pairs = cast("dict[str, Any]", value).items() if isinstance(value, dict) else enumerate(value)
        for i, (key, inner) in enumerate(pairs):
            if i:
                self.line(indent)
            if isinstance(value, dict):
                self.keys[*loc, key] = self.here()
                self.scalar(key)
                self.put(":" + " " * (1 + self.draw(2)))
            else:
                self.put("- ")
            if isinstance(inner, dict | list) and inner and self.draw(2):
                if isinstance(value, dict):
                    self.line(indent + 2)
                self.block(inner, (*loc, key), indent + 2)
            else:
                self.flow(inner, (*loc, key))


words = st.text("abc µ{}[],:#&*!-", min_size=1, max_size=5)
trees = st.dictionaries(
    words,
    st.recursive(
        words | st.integers(0, 99),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
        max_leaves=8,
    ),
    min_size=1,
    max_size=4,
)


@settings(max_examples=60)
@given(trees, st.randoms(use_true_random=False), st.booleans())
def test_places_in_any_text(tree: dict[str, Any], random: Any, crlf: bool) -> None:
    writer = Writer(lambda most: random.randint(0, most))
    writer.block(tree, (), 0)
    text = ("\r\n" if crlf else "\n").join(writer.lines)

    document = Document.parse(text, "f.yaml")

    assert document.data == tree
    assert {loc: document.locate(loc) for loc in writer.values} == writer.values
    assert {loc: document.locate(loc, key=True) for loc in writer.keys} == writer.keys
