"""Sites of the grid, shapes and targets on it."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pydantic import ValidationError

from labseq.builtin.patterns import BitmapSettings, CompactSettings, bitmap, compact, read_bitmap
from labseq.errors import LimitError
from labseq.model import SiteGrid
from labseq.plugin.geometry import from_the_centre, nearest_to_centre, place

SIZES = st.integers(1, 12)


def sites(mask: np.ndarray) -> set[tuple[int, int]]:
    return {(int(r), int(c)) for r, c in np.argwhere(mask)}


@settings(max_examples=40)
@given(SIZES, SIZES, SIZES, SIZES)
def test_centring_leaves_the_odd_row_or_column_below_and_right(
    rows: int, cols: int, more: int, wider: int
) -> None:
    placed = place(np.ones((rows, cols), np.bool_), (rows + more, cols + wider))
    filled_rows, filled_cols = np.flatnonzero(placed.any(axis=1)), np.flatnonzero(placed.any(axis=0))
    above, left = filled_rows[0], filled_cols[0]
    below, right = rows + more - 1 - filled_rows[-1], cols + wider - 1 - filled_cols[-1]
    assert placed.sum() == rows * cols
    assert below - above in (0, 1)
    assert right - left in (0, 1)


@pytest.mark.parametrize("shape", [(5, 2), (2, 5)])
def test_a_target_larger_than_the_grid_names_both_sizes(shape: tuple[int, int]) -> None:
    with pytest.raises(LimitError) as caught:
        compact(CompactSettings(rows=shape[0], cols=shape[1]), SiteGrid(4, 3))
    text = str(caught.value)
    assert f"{shape[0]} rows x {shape[1]} columns" in text
    assert "4 rows x 3 columns" in text


@pytest.mark.parametrize("origin", [(3, 0), (0, 2), (-1, 0)])
def test_a_target_that_sticks_out_says_where_it_would_fit(origin: tuple[int, int]) -> None:
    with pytest.raises(LimitError, match=r"rows 0 to 2 and columns 0 to 1 on a grid of 4 x 3"):
        place(np.ones((2, 2), np.bool_), (4, 3), origin)


def test_a_bitmap_clears_the_rest_of_its_drawing() -> None:
    target = bitmap(BitmapSettings(sites="#.#\n.#.", origin=(1, 1)), SiteGrid(4, 5))
    assert sites(target.fill) == {(1, 1), (1, 3), (2, 2)}
    assert sites(target.clear) == {(1, 2), (2, 1), (2, 3)}


def test_clear_none_leaves_the_rest_to_the_reservoir() -> None:
    target = bitmap(BitmapSettings(sites="#.#", clear="none"), SiteGrid(1, 5))
    assert sites(target.fill) == {(0, 1), (0, 3)}
    assert not target.clear.any()


def test_any_characters_can_stand_for_an_atom() -> None:
    assert read_bitmap("X o\n x ", fill="Xo").astype(int).tolist() == [[1, 0, 1], [0, 0, 0]]


def test_blank_lines_around_a_drawing_do_not_count() -> None:
    assert read_bitmap("\n\n#.\r\n.#\n\n").tolist() == [[True, False], [False, True]]


@given(st.lists(st.lists(st.booleans(), min_size=3, max_size=3), min_size=1, max_size=6))
def test_what_is_drawn_is_read(rows: list[list[bool]]) -> None:
    text = "\n".join("".join("#" if site else "." for site in row) for row in rows)
    if not any(map(any, rows)):
        with pytest.raises(ValueError, match="has no atom"):
            read_bitmap(text)
    else:
        assert read_bitmap(text).tolist() == rows


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "is empty"),
        ("##\n#\n##", "row 2 of the drawing has 1 characters, but row 1 has 2"),
        ("..\n..", "has no atom"),
    ],
)
def test_a_wrong_drawing_is_a_settings_error(text: str, what: str) -> None:
    with pytest.raises(ValidationError, match=what):
        BitmapSettings(sites=text)


@pytest.mark.parametrize(
    "values",
    [
        {"rows": 3},
        {"rows": 3, "cols": 3, "origin": (-1, 0)},
    ],
)
def test_wrong_settings_of_a_block_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        CompactSettings.model_validate(values)


SQUARE = SiteGrid(lattice="square")


def test_sites_equally_far_are_listed_by_row_and_column() -> None:
    assert from_the_centre(np.ones((2, 2), np.bool_), SQUARE).tolist() == [0, 1, 2, 3]
    assert from_the_centre(np.zeros((2, 2), np.bool_), SQUARE).tolist() == []


@pytest.mark.parametrize("shear", [1, -1])
def test_distances_are_those_on_the_lattice(shear: Literal[1, -1]) -> None:
    fill = np.ones((3, 3), np.bool_)
    kept = nearest_to_centre(fill, 7, SiteGrid(3, 3, shear=shear))
    far = np.eye(3, dtype=np.bool_)  # the acute corners of the rhombus
    far[1, 1] = False
    assert np.array_equal(~kept, far if shear > 0 else far[:, ::-1])
