"""The kernels of PSCA as the paper describes it."""

from __future__ import annotations

import numpy as np

from labseq.plugin import kernel
from labseq_psca.kernels import (
    GRID,
    GROWING,
    PLAN,
    Bools,
    Growing,
    Ints,
    Moves,
    Offsets,
    add_line,
    choose_unlocking,
    compress_columns,
    count_columns,
    empty_plan,
    ended,
    exchange,
    place_in_order,
    weigh_columns,
)


@kernel("int64(bool_[::1], int64[::1], int64[::1], int64)")
def partner(row: Bools, need: Ints, spare: Ints, col: int) -> int:
    """Find the column that exchanges an atom with another one in a row.

    An atom comes from the most distant of the target's columns that have too many,
    else from the most distant other one: of the rules that were tried, with it the
    numbers of batches come nearest to the paper's. An atom goes to the nearest column.

    Args:
        row: bool (n_cols,), the row's atoms.
        need: int64 (n_cols,), fill sites of the column.
        spare: int64 (n_cols,), atoms that a column has too many, above 0, or too
            few; 0 if it takes no part.
        col: The other column: with a vacancy it looks for an atom, with an atom
            for a vacancy.

    Returns:
        The column, of equal ones the left one; -1 if there is none.
    """
    best = -1
    best_rank = 0
    for other in range(len(row)):
        if not row[col] and row[other] and spare[other] > 0:
            rank = abs(other - col) + (len(row) if need[other] > 0 else 0)
        elif row[col] and not row[other] and spare[other] < 0:
            rank = len(row) - abs(other - col)
        else:
            continue
        if rank > best_rank:
            best, best_rank = other, rank
    return best


@kernel("UniTuple(int64, 2)(bool_[:, ::1], int64[::1], int64[::1], int64, int64)")
def first_row(atoms: Bools, need: Ints, spare: Ints, col: int, order: int) -> tuple[int, int]:
    """Find the row that goes first by an order, of those in which a column can exchange an atom.

    Args:
        atoms: bool (n_rows, n_cols).
        need: int64 (n_cols,), fill sites of the column.
        spare: int64 (n_cols,), see :func:`partner`.
        col: The column, in need of an atom if its ``spare`` is below 0, else of a vacancy.
        order: HALF_FILLED, FULLEST or EMPTIEST.

    Returns:
        The row and the other column, or (-1, -1).
    """
    n_rows, n_cols = atoms.shape
    row = other = -1
    first = 0
    for r in range(n_rows):
        if atoms[r, col] == (spare[col] < 0):
            continue
        n_atoms = 0
        for c in range(n_cols):
            n_atoms += atoms[r, c]
        place = place_in_order(n_atoms, n_cols, order)
        if row >= 0 and place >= first:
            continue
        found = partner(atoms[r], need, spare, col)
        if found >= 0:
            row, other, first = r, found, place
    return row, other


@kernel("int64(int64[::1], int64[::1], int64[::1], int64[::1])")
def column_in_need(need: Ints, room: Ints, count: Ints, spare: Ints) -> int:
    """Find the column most in need of an atom; if there is none, the target's column with most too many.

    Args:
        need: int64 (n_cols,), fill sites of the column.
        room: int64 (n_cols,), its sites that may hold an atom.
        count: int64 (n_cols,), its atoms now.
        spare: Result, int64 (n_cols,), see :func:`partner`.

    Returns:
        The column, or -1 if all columns of the target hold what they need.
    """
    lacking = crowded = -1
    for col in range(len(need)):
        spare[col] = count[col] - need[col]
        if spare[col] < 0 and (lacking < 0 or spare[col] < spare[lacking]):
            lacking = col
        if spare[col] > 0 and need[col] > 0 and (crowded < 0 or spare[col] > spare[crowded]):
            crowded = col
    if lacking < 0 and crowded >= 0:
        for col in range(len(need)):
            if need[col] == 0:
                spare[col] = min(0, count[col] - room[col])
    return lacking if lacking >= 0 else crowded


@kernel(f"Tuple(({GROWING}))({GROWING}, bool_[:, ::1], {GRID}, {GRID}, int64, int64, int64)")
def sort_rows(
    moves: Moves,
    offsets: Offsets,
    n_batches: int,
    atoms: Bools,
    fill: Bools,
    clear: Bools,
    row_limit: int,
    column_limit: int,
    order: int,
) -> Growing:
    """Sort rows until every column of the target holds as many atoms as it has fill sites, no more.

    Each sort helps one column. Where none can help a column that lacks atoms, an
    atom moves within another column first; columns that cannot get rid of their
    surplus keep it.

    Args:
        moves: Of the growing plan, as ``offsets`` and ``n_batches``.
        offsets: int32, where each batch starts.
        n_batches: Number of batches so far.
        atoms: bool (n_rows, n_cols), no fewer than there are fill sites; updated.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Most atoms in a batch that moves along a row.
        column_limit: Most atoms in a batch that moves along a column.
        order: Which row goes first: HALF_FILLED, FULLEST or EMPTIEST.
    """
    n_rows, n_cols = atoms.shape
    need, room, count = count_columns(atoms, fill, clear)
    spare = np.empty(n_cols, np.int64)
    weight = np.empty(n_cols, np.int64)
    leave = np.empty(n_cols, np.int64)
    change = np.empty(n_cols, np.int64)
    source = np.empty(max(n_rows, n_cols), np.int64)
    goal = np.empty(max(n_rows, n_cols), np.int64)
    while True:
        col = column_in_need(need, room, count, spare)
        if col < 0:
            return moves, offsets, n_batches
        row, other = first_row(atoms, need, spare, col, order)
        if row >= 0:
            change[:] = 0
            change[col], change[other] = (1, -1) if spare[col] < 0 else (-1, 1)
            count[col] += change[col]
            count[other] += change[other]
            n_atoms = exchange(atoms[row], change, source, goal)
            moves, offsets, n_batches = add_line(
                moves, offsets, n_batches, source, goal, n_atoms, n_cols, row, True, row_limit, 0
            )
            continue
        if weigh_columns(need, room, count, weight, leave) == 0:
            return moves, offsets, n_batches
        for c in range(n_cols):
            if c != col:
                weight[c] = 0
        other, source[0], goal[0] = choose_unlocking(atoms, weight, leave)
        if other < 0:
            return moves, offsets, n_batches
        atoms[source[0], other] = False
        atoms[goal[0], other] = True
        moves, offsets, n_batches = add_line(
            moves, offsets, n_batches, source, goal, 1, n_rows, other, False, column_limit, 0
        )


@kernel(f"{PLAN}({GRID}, {GRID}, {GRID}, int64, int64, int64, int64)")
def plan_as_in_paper(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int, order: int
) -> tuple[Moves, Offsets]:
    """Plan row sorting, one column at a time, and column compression.

    Arguments and result as for :func:`labseq_psca.kernels.plan_best_way`.
    """
    atoms = occupied.copy()
    moves, offsets = empty_plan(atoms.size)
    moves, offsets, n = sort_rows(moves, offsets, 0, atoms, fill, clear, row_limit, column_limit, order)
    moves, offsets, n = compress_columns(moves, offsets, n, atoms, fill, clear, column_limit, slots)
    return ended(moves, offsets, n, False)
