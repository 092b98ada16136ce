"""Line and column are right, wherever a value stands: the heart of every message."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import pytest
from hypothesis import given, settings, strategies as st

from labseq.config import Document
from labseq.errors import Loc

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
    ("top",): (2, 6),
    ("grid",): (5, 5),
    ("grid", "rows"): (5, 11),
    ("grid", "deep"): (6, 11),
    ("grid", "deep", "a"): (6, 15),
    ("grid", "deep", "a", 0): (6, 16),
    ("grid", "deep", "a", 1): (6, 19),
    ("grid", "deep", "a", 1, "b"): (6, 23),
    ("grid", "deep", "quoted key"): (6, 46),
    ("list",): (8, 1),
    ("list", 0): (8, 3),
    ("list", 1): (9, 5),
    ("list", 1, "name"): (9, 11),
    ("list", 1, "rearrange"): (11, 9),
    ("list", 1, "rearrange", "window"): (11, 17),
    ("list", 1, "rearrange", "window", 0): (11, 19),
    ("list", 1, "rearrange", "window", 1): (12, 19),
    ("list", 2): (13, 3),
    ("list", 2, 0): (13, 5),
    ("list", 2, 1): (14, 5),
    ("text",): (16, 7),
    ("folded",): (20, 3),
    ("last",): (22, 7),
}
KEYS: dict[Loc, tuple[int, int]] = {
    ("top",): (2, 1),
    ("grid",): (4, 1),
    ("grid", "deep", "a", 1, "b"): (6, 20),
    ("grid", "deep", "quoted key"): (6, 32),
    ("list", 1, "name"): (9, 5),
    ("list", 1, "rearrange"): (10, 5),
    ("text",): (16, 1),
    ("last",): (22, 1),
}


@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_every_place(line_end: str, mark: str) -> None:
    document = Document.parse((mark + BLOCK.replace("\n", line_end)).encode(), "f.yaml")
    assert {loc: document.locate(loc) for loc in PLACES} == PLACES
    assert {loc: document.locate(loc, key=True) for loc in KEYS} == KEYS


def test_wide_characters_count_once() -> None:
    document = Document.parse("'µ é': {中: 1, \U0001f600: 2}", "f.yaml")
    assert document.locate(("µ é", "\U0001f600")) == (1, 18)


def test_tabs_in_text_count_once() -> None:
    assert Document.parse('{a: "x\ty", b: 1}', "f.yaml").locate(("b",)) == (1, 15)


def test_empty_values_are_behind_their_key() -> None:
    document = Document.parse("a:\nb: {c: , d: }\ne:\n- \n", "f.yaml")
    assert document.locate(("a",)) == (1, 3)
    assert document.locate(("b", "c")) == (2, 7)
    assert document.locate(("e", 0)) == (4, 2)


def test_alias_is_where_it_stands_and_its_inside_where_it_is_written() -> None:
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


@settings(max_examples=150, deadline=None)
@given(trees, st.randoms(use_true_random=False), st.booleans())
def test_places_of_whatever_is_written(tree: dict[str, Any], random: Any, crlf: bool) -> None:
    writer = Writer(lambda most: random.randint(0, most))
    writer.block(tree, (), 0)
    text = ("\r\n" if crlf else "\n").join(writer.lines)

    document = Document.parse(text, "f.yaml")

    assert document.data == tree
    assert {loc: document.locate(loc) for loc in writer.values} == writer.values
    assert {loc: document.locate(loc, key=True) for loc in writer.keys} == writer.keys
