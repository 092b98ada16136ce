"""Patterns that break one promise each."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np

from labseq.errors import LimitError
from labseq.geometry import block, pattern
from labseq.model import SiteGrid, TargetPattern
from labseq.testing import PatternContract

from .planted import Planted

SIZES, NUMBERS = itertools.cycle((4, 5, 6)), itertools.count()


def frame(grid: SiteGrid, size: int = 5) -> TargetPattern:
    """Right: the edge of a square."""
    rows, cols = block(size, size, grid.shape)
    mask = (rows % (size - 1) == 0) | (cols % (size - 1) == 0)
    return pattern(mask, grid, origin=None, clear="bounding_box", name="frame")


def gives_a_mask(grid: SiteGrid) -> Any:
    return frame(grid).fill


def forgets_the_grid(grid: SiteGrid) -> TargetPattern:
    frame(grid)
    return frame(SiteGrid(5, 5))


def fails_on_long_grids(grid: SiteGrid) -> TargetPattern:
    target = frame(grid)
    if grid.n_cols > grid.n_rows:
        raise IndexError("index 17 is out of bounds")
    return target


def has_no_edge(grid: SiteGrid) -> TargetPattern:
    target = frame(grid)
    return TargetPattern(np.zeros_like(target.fill), target.clear)


def grows(grid: SiteGrid) -> TargetPattern:
    return frame(grid, next(SIZES))


def has_a_new_name(grid: SiteGrid) -> TargetPattern:
    target = frame(grid)
    return TargetPattern(target.fill, target.clear, f"frame {next(NUMBERS)}")


def is_cut_off(grid: SiteGrid) -> TargetPattern:
    fill = np.zeros(grid.shape, np.bool_)
    fill[:5, :5] = True
    return TargetPattern(fill, np.zeros_like(fill))


def fails_somewhere_inside(grid: SiteGrid) -> TargetPattern:
    try:
        return frame(grid)
    except LimitError as error:
        raise IndexError("index 2 is out of bounds") from error


def reads_a_file(grid: SiteGrid) -> TargetPattern:
    Path(os.devnull).read_bytes()
    return frame(grid)


def draws_numbers(grid: SiteGrid) -> TargetPattern:
    np.random.random()  # noqa: NPY002 - the fault
    return frame(grid)


PLANTED = Planted(
    PatternContract(),
    frame,
    (
        (gives_a_mask, "test_fits_the_grid"),
        (forgets_the_grid, "test_fits_the_grid"),
        (fails_on_long_grids, "test_fits_the_grid"),
        (has_no_edge, "test_wants_atoms"),
        (grows, "test_same_grid_same_target"),
        (has_a_new_name, "test_same_grid_same_target"),
        (is_cut_off, "test_refuses_small_grids"),
        (fails_somewhere_inside, "test_refuses_small_grids"),
        (reads_a_file, "test_is_pure"),
        (draws_numbers, "test_is_pure"),
    ),
)
