"""Patterns that break one promise each."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np

from labseq.model import SiteGrid, TargetPattern
from labseq.plugin.geometry import block, pattern
from labseq.testing import PatternContract

from .planted import Planted

SIZES, NUMBERS = itertools.cycle((4, 5, 6)), itertools.count()


def frame(grid: SiteGrid, size: int = 5) -> TargetPattern:
    """Right: the edge of a square."""
    rows, cols = block(size, size, grid.shape)
    mask = (rows % (size - 1) == 0) | (cols % (size - 1) == 0)
    return pattern(mask, grid, origin=None, clear="bounding_box", name="frame")


def forgets_the_grid(grid: SiteGrid) -> TargetPattern:
    frame(grid)
    return frame(SiteGrid(5, 5))


def has_no_edge(grid: SiteGrid) -> TargetPattern:
    target = frame(grid)
    return TargetPattern(np.zeros_like(target.fill), target.clear)


def grows(grid: SiteGrid) -> TargetPattern:
    return frame(grid, next(SIZES))


def is_cut_off(grid: SiteGrid) -> TargetPattern:
    fill = np.zeros(grid.shape, np.bool_)
    fill[:5, :5] = True
    return TargetPattern(fill, np.zeros_like(fill))


def reads_a_file(grid: SiteGrid) -> TargetPattern:
    Path(os.devnull).read_bytes()
    return frame(grid)


PLANTED = Planted(
    PatternContract(),
    frame,
    (
        (forgets_the_grid, "test_fits_the_grid"),
        (has_no_edge, "test_wants_atoms"),
        (grows, "test_same_grid_same_target"),
        (is_cut_off, "test_refuses_small_grids"),
        (reads_a_file, "test_is_pure"),
    ),
)
