from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from labseq.geometry import from_the_centre, nearest_to_centre
from labseq.model import SiteGrid

SQUARE = SiteGrid(lattice="square")


def test_sites_equally_far_are_listed_by_row_and_column() -> None:
    assert from_the_centre(np.ones((2, 2), np.bool_), SQUARE).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("shear", [1, -1])
def test_distances_are_those_on_the_lattice(shear: Literal[1, -1]) -> None:
    fill = np.ones((3, 3), np.bool_)
    kept = nearest_to_centre(fill, 7, SiteGrid(3, 3, shear=shear))
    far = np.eye(3, dtype=np.bool_)  # the acute corners of the rhombus
    far[1, 1] = False
    assert np.array_equal(~kept, far if shear > 0 else far[:, ::-1])


def test_no_sites_and_enough_atoms() -> None:
    nothing = np.zeros((2, 2), np.bool_)
    assert from_the_centre(nothing, SQUARE).tolist() == []
    assert nearest_to_centre(nothing, 3, SQUARE) is nothing
