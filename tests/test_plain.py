from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.plain import dumps, plain_text, to_plain


class Colour(Enum):
    RED = "red"


@dataclass
class Point:
    x: np.float32
    y: float


class Spiteful:
    def __repr__(self) -> str:
        raise RuntimeError("no")


LOOP: list[Any] = []
LOOP.extend([LOOP, LOOP, LOOP])


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.int64(3), 3),
        (np.bool_(True), True),
        (np.float32("nan"), None),
        (float("-inf"), None),
        (np.array([[1.5, np.inf]]), [[1.5, None]]),
        (np.array(3), 3),
        (Colour.RED, "red"),
        (Point(np.float32(0.5), float("nan")), {"x": 0.5, "y": None}),
        ({1: 2, None: 3, (1, 2): 4}, {"1": 2, "None": 3, "[1, 2]": 4}),
        ({3, 1}, [1, 3]),
        (PurePosixPath("a/b"), "a/b"),
        (datetime(2026, 11, 20, tzinfo=UTC), "2026-11-20T00:00:00+00:00"),
        (b"ab", "b'ab'"),
        (1j, "1j"),
        (Spiteful(), "<Spiteful>"),
    ],
)
def test_values_become_plain(value: object, expected: object) -> None:
    assert to_plain(value) == expected


def test_a_list_that_holds_itself_ends() -> None:
    assert "[...]" in dumps(LOOP)


def test_very_large_integers_are_written_in_hexadecimal() -> None:
    assert json.loads(dumps(1 << 100_000)) == hex(1 << 100_000)


def test_very_deep_lists_end() -> None:
    deep: list[Any] = []
    for _ in range(3000):
        deep = [deep]
    json.loads(dumps(deep))


def test_plain_text_takes_out_what_hdf5_refuses() -> None:
    assert plain_text("µ\0\udc80") == "µ\\x00\\udc80"


plain_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@settings(max_examples=25)
@given(plain_values)
def test_what_is_plain_already_comes_back(value: Any) -> None:
    assert json.loads(dumps(value)) == value


@given(st.text(st.characters()))
def test_plain_text_is_utf_8_without_nul(text: str) -> None:
    assert b"\0" not in plain_text(text).encode()
