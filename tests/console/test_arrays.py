from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.console.arrays import (
    ATOM,
    DEFECT,
    DENSE,
    EMPTY,
    HALF_BLOCKS,
    RESERVOIR,
    ROOMY,
    SURPLUS,
    UNICODE,
    draw_array,
    site_kinds,
)
from labseq.model import TargetPattern

FILL = np.array([[0, 1, 1], [0, 0, 0]], np.bool_)
CLEAR = np.array([[0, 0, 0], [0, 1, 1]], np.bool_)
TARGET = TargetPattern(FILL, CLEAR)
X = UNICODE.sites[SURPLUS]
OCCUPANCY = np.array([[1, 1, 0], [0, 1, 0]], np.bool_)


def plain(lines: Any) -> list[str]:
    return [line.plain.rstrip() for line in lines]


def test_site_kinds() -> None:
    assert site_kinds(OCCUPANCY, TARGET).tolist() == [[RESERVOIR, ATOM, DEFECT], [EMPTY, SURPLUS, EMPTY]]


@pytest.mark.parametrize(
    ("scale", "shear", "expected"),
    [
        (ROOMY, 1, ["· ● ○", f"   {X}"]),
        (ROOMY, -1, [" · ● ○", f"  {X}"]),
        (ROOMY, 0, ["· ● ○", f"  {X}"]),
        (DENSE, 0, ["·●○", f" {X}"]),
        (HALF_BLOCKS, 0, ["▀▀▀"]),
    ],
)
def test_drawing(scale: Any, shear: int, expected: list[str]) -> None:
    assert plain(draw_array(OCCUPANCY, TARGET, shear, scale, UNICODE)) == expected


def test_each_kind_has_a_colour_of_its_own() -> None:
    line = draw_array(OCCUPANCY, TARGET, 0, DENSE, UNICODE)[0]
    colours = [
        str(span.style.color.name)
        for span in line.spans
        if not isinstance(span.style, str) and span.style.color
    ]
    assert colours == ["bright_black", "green", "red"]


def test_half_blocks_tell_upper_from_lower() -> None:
    fill = np.ones((3, 4), np.bool_)
    target = TargetPattern(np.zeros_like(fill), np.zeros_like(fill))
    occupancy = np.array([[1, 0, 1, 0], [0, 1, 1, 0], [1, 0, 0, 0]], np.bool_)
    assert plain(draw_array(occupancy, target, 0, HALF_BLOCKS, UNICODE)) == ["▀▄█", "▀"]


@given(
    st.integers(1, 30),
    st.integers(1, 30),
    st.sampled_from([-1, 0, 1]),
    st.sampled_from([ROOMY, DENSE, HALF_BLOCKS]),
)
def test_a_drawing_has_the_size_that_was_promised(n_rows: int, n_cols: int, shear: int, scale: Any) -> None:
    sites = np.ones((n_rows, n_cols), np.bool_)
    lines = draw_array(sites, TargetPattern(sites, ~sites), shear, scale, UNICODE)
    width, height = scale.size(n_rows, n_cols, shear)
    assert len(lines) == height
    assert max(line.cell_len for line in lines) <= width
