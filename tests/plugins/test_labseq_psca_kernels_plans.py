"""Kernels of PSCA that make a plan's batches out of rows and columns."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from labseq_psca import kernels, kernels_paper
from numpy.typing import NDArray

from .labseq_psca_arrays import bools, ints

Sites = list[int]


def test_weights_of_columns() -> None:
    weight, leave = np.zeros(4, np.int64), np.zeros(4, np.int64)
    need, room, count = ints([3, 2, 0, 1]), ints([5, 5, 5, 2]), ints([1, 4, 1, 3])
    assert kernels.weigh_columns(need, room, count, weight, leave) == 2
    assert weight.tolist() == [2 * (80 + 4), 0, 0, 0]
    assert leave.tolist() == [-1, 20, 0, 0]  # the last has more atoms than room


def test_unlocking_moves_the_nearest_atom_within_its_column() -> None:
    atoms = bools([[1, 1], [1, 1], [0, 0], [0, 0]])
    assert kernels.choose_unlocking(atoms, ints([0, 90]), ints([0, -1])) == (0, 1, 2)
    assert kernels.choose_unlocking(atoms, ints([0, 90]), ints([-1, -1]))[0] == -1


def test_a_growing_plan_is_lengthened() -> None:
    moves, offsets = np.zeros((1, 4), np.int16), np.zeros(2, np.int32)
    n_batches = 0
    for line in range(4):
        moves, offsets, n_batches = kernels.add_line(
            moves, offsets, n_batches, ints([0, 1]), ints([1, 2]), 2, 3, line, line % 2 == 0, 1, 0
        )
    assert n_batches == 8
    assert offsets[:9].tolist() == list(range(9))
    assert moves[:4].tolist() == [[0, 1, 0, 2], [0, 0, 0, 1], [1, 1, 2, 1], [0, 1, 1, 1]]


@pytest.mark.parametrize("slots", [1, 2])
def test_ejection_slots_are_used_from_the_outermost_atom_on(slots: int) -> None:
    moves, offsets, n_batches = kernels.add_line(
        np.zeros((9, 4), np.int16),
        np.zeros(10, np.int32),
        0,
        ints([0, 1, 3, 4]),
        ints([-2, -1, 5, 6]),
        4,
        5,
        7,
        True,
        4,
        slots,
    )
    batches = [moves[offsets[i] : offsets[i + 1]].tolist() for i in range(n_batches)]
    if slots == 1:
        assert batches == [[[7, 0, 7, -1], [7, 4, 7, 5]], [[7, 1, 7, -1], [7, 3, 7, 5]]]
    else:
        assert batches == [[[7, 0, 7, -2], [7, 1, 7, -1], [7, 3, 7, 5], [7, 4, 7, 6]]]


class TestPaper:
    """Row sorting for one column at a time."""

    def test_the_most_distant_column_of_the_target_gives(self) -> None:
        row, need = bools([1, 1, 0, 0, 1, 1]), ints([0, 1, 1, 1, 1, 0])
        assert kernels_paper.partner(row, need, ints([2, 1, -1, 0, 1, 2]), 2) == 4
        assert kernels_paper.partner(row, need, ints([2, 0, -1, 0, 0, 2]), 2) == 5
        assert kernels_paper.partner(row, need, ints([0, 0, -1, 0, 0, 0]), 2) == -1

    def test_surplus_goes_to_the_nearest_column_with_room(self) -> None:
        row, need = bools([0, 0, 1, 1, 0]), ints([0, 0, 1, 1, 0])
        assert kernels_paper.partner(row, need, ints([-1, -1, 1, 0, -1]), 2) == 1

    def test_the_column_most_in_need_comes_first_and_surplus_last(self) -> None:
        spare = np.zeros(4, np.int64)
        room = ints([9, 9, 9, 9])
        assert kernels_paper.column_in_need(ints([3, 4, 2, 0]), room, ints([2, 2, 5, 1]), spare) == 1
        assert kernels_paper.column_in_need(ints([3, 4, 2, 0]), room, ints([3, 4, 5, 1]), spare) == 2
        assert spare.tolist() == [0, 0, 3, -8]
        assert kernels_paper.column_in_need(ints([3, 4, 2, 0]), room, ints([3, 4, 2, 1]), spare) == -1


class TestRepair:
    """Defects are filled from the side that costs least."""

    @staticmethod
    def repair(atoms: Any, fill: Any) -> tuple[list[list[Sites]], NDArray[np.bool_]]:
        moves, offsets, after = kernels.plan_repair(bools(atoms), bools(fill), 9, 9)
        return [moves[a:b].tolist() for a, b in pairwise(offsets.tolist())], after

    def test_the_nearest_of_the_four_sides(self) -> None:
        atoms = np.ones((7, 7), np.bool_)
        atoms[3, 1] = False
        fill = np.zeros((7, 7), np.bool_)
        fill[1:6, 1:6] = True
        assert self.repair(atoms, fill)[0] == [[[3, 0, 3, 1]]]

    def test_atoms_between_move_up_by_one_fill_site(self) -> None:
        batches, after = self.repair([[1, 0, 1, 0, 1, 1]], [[0, 1, 1, 0, 1, 0]])
        assert batches == [[[0, 0, 0, 1]]]
        batches, after = self.repair([[0, 0, 1, 0, 1, 1]], [[0, 1, 1, 0, 1, 0]])
        assert batches == [[[0, 2, 0, 1], [0, 4, 0, 2], [0, 5, 0, 4]]]
        assert after.tolist() == [[False, True, True, False, True, False]]

    def test_two_defects_of_a_line_are_filled_together(self) -> None:
        batches, _ = self.repair([[0, 1, 0, 1, 1, 1]], [[1, 1, 1, 1, 0, 0]])
        assert batches == [[[0, 1, 0, 0], [0, 3, 0, 1], [0, 4, 0, 2], [0, 5, 0, 3]]]

    def test_an_atom_comes_from_beside_where_the_line_has_none(self) -> None:
        batches, _ = self.repair(
            [[0, 0, 0, 1], [1, 0, 1, 1], [1, 1, 1, 1]],
            [[0, 0, 0, 0], [1, 1, 1, 1], [1, 1, 1, 1]],
        )
        assert batches == [[[0, 3, 0, 1]], [[0, 1, 1, 1]]]

    def test_what_no_shift_can_fill_is_left(self) -> None:
        batches, after = self.repair([[1, 0], [0, 0]], [[1, 1], [0, 0]])
        assert batches == []
        assert after.tolist() == [[True, False], [False, False]]
