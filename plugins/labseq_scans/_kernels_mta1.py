"""Kernels of MTA1: downward and upward scans after the pre-sorting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import kernel
from labseq_scans._kernels_columns import column_sums, supply_columns
from labseq_scans._kernels_lines import GRID, GROWING, Growing, Log, record, settle
from labseq_scans._kernels_presort import SCANNED, Scanned, count_scan, presort

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@kernel("int64(int64[:, ::1], int64[:, ::1], int64[::1], int64, int64, int64, int64)")
def end_of_move(place: Ints, goal: Ints, n_atoms: Ints, n_rows: int, col: int, i: int, sense: int) -> int:
    """Row where a scan drops an atom that it has picked up: at its goal, or before the next atom.

    An atom that is to be ejected waits until none is below it.

    Args:
        place: int64 (n_cols, n_rows), rows of each column's atoms, ascending.
        goal: int64 (n_cols, n_rows), where they go, ascending.
        n_atoms: int64 (n_cols,).
        n_rows: Number of rows.
        col: The atom's column.
        i: The atom's index in its column.
        sense: 1 for a downward scan, -1 for an upward one.

    Returns:
        The row; the atom's own if it stays.
    """
    ahead = i + sense
    blocked = 0 <= ahead < n_atoms[col]
    if goal[col, i] >= n_rows:
        return place[col, i] if blocked or sense < 0 else n_rows
    end = goal[col, i] * sense
    if blocked:
        end = min(end, place[col, ahead] * sense - 1)
    return max(end, place[col, i] * sense) * sense


@kernel(f"Tuple(({GROWING}))({GROWING}, int64[:, ::1], int64[:, ::1], int64[::1], int64, int64, int64)")
def scan(
    log: Log,
    n_moves: int,
    n_batches: int,
    place: Ints,
    goal: Ints,
    n_atoms: Ints,
    n_rows: int,
    sense: int,
    limit: int,
) -> Growing:
    """Move a row of tweezers over all rows once; each carries one atom of its column at a time.

    Atoms that are picked up on the same row and dropped on the same row make a batch.

    Args:
        log: Of the growing plan, as ``n_moves`` and ``n_batches``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        place: int64 (n_cols, n_rows), rows of each column's atoms, ascending; updated.
        goal: int64 (n_cols, n_rows), where they go, ascending.
        n_atoms: int64 (n_cols,); updated.
        n_rows: Number of rows.
        sense: 1 for a downward scan, -1 for an upward one.
        limit: Most tweezers on at once.
    """
    n_cols = len(n_atoms)
    n_on = 0
    n_dropped = np.zeros(n_rows + 1, np.int64)  # by row; an upward scan reaches none below 0
    following = np.zeros(n_cols, np.int64) if sense > 0 else n_atoms - 1
    picked = np.empty(n_cols, np.int64)
    for step in range(n_rows):
        row = step if sense > 0 else n_rows - 1 - step
        n_on -= n_dropped[row]
        n_picked = 0
        for col in range(n_cols):
            picked[col] = row
            i = following[col]
            if not (0 <= i < n_atoms[col] and place[col, i] == row):
                continue
            following[col] = i + sense
            end = end_of_move(place, goal, n_atoms, n_rows, col, i, sense)
            if end == row or n_on == limit:
                continue
            n_on += 1
            n_picked += 1
            n_dropped[end] += 1
            picked[col] = end
            place[col, i] = end
            if end == n_rows:
                n_atoms[col] -= 1
        end = row
        while n_picked > 0:
            end += sense
            n_before = n_moves
            for col in range(n_cols):
                if picked[col] == end:
                    log = record(log, n_moves, n_batches, row, col, end, col)
                    n_moves += 1
            n_picked -= n_moves - n_before
            n_batches += n_moves > n_before
    return log, n_moves, n_batches


@kernel(f"Tuple(({SCANNED}))({SCANNED}, {GRID}, {GRID}, {GRID}, int64, boolean)")
def sort_columns(
    log: Log,
    n_moves: int,
    n_batches: int,
    passed: Ints,
    n_scans: int,
    atoms: Bools,
    fill: Bools,
    clear: Bools,
    limit: int,
    may_eject: bool,
) -> Scanned:
    """Scan downwards and upwards in turns until every atom is where it goes.

    Args:
        log: Of the growing plan, as ``n_moves``, ``n_batches``, ``passed`` and ``n_scans``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        passed: int64 (>= n_scans,), lines that each scan passes.
        n_scans: Number of scans so far.
        atoms: bool (n_rows, n_cols), in no column fewer than it has fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        limit: Most tweezers on at once.
        may_eject: Whether atoms can be ejected below the last row.
    """
    n_rows, n_cols = atoms.shape
    place = np.empty((n_cols, n_rows), np.int64)
    goal = np.empty((n_cols, n_rows), np.int64)
    n_atoms = np.empty(n_cols, np.int64)
    for col in range(n_cols):
        n_atoms[col] = settle(
            atoms[:, col].copy(),
            fill[:, col].copy(),
            clear[:, col].copy(),
            False,
            may_eject,
            place[col],
            goal[col],
        )
    n_idle = 0
    sense = 1
    while n_idle < 2:
        n_held, n_before = np.sum(n_atoms), n_moves
        log, n_moves, n_batches = scan(log, n_moves, n_batches, place, goal, n_atoms, n_rows, sense, limit)
        n_idle = 0 if n_moves > n_before else n_idle + 1
        if n_idle == 0:
            ejects = np.sum(n_atoms) < n_held
            passed = count_scan(passed, n_scans, n_rows + 1 if ejects else n_rows)
            n_scans += 1
        sense = -sense
    return log, n_moves, n_batches, passed, n_scans


@kernel(f"Tuple(({SCANNED}))({GRID}, {GRID}, {GRID}, int64, int64, int64)")
def plan_mta1(
    occupied: Bools, fill: Bools, clear: Bools, row_tones: int, column_tones: int, slots: int
) -> Scanned:
    """Plan MTA1.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_tones: Most tweezers on at once in a column.
        column_tones: Most tweezers on at once in a row.
        slots: Ejection slots on each side.

    Returns:
        The log of atom moves, int32 (>= n_moves, 5), ``n_moves``, the number of batches,
        the lines that each scan passes, int64 (>= n_scans,), and ``n_scans``.
    """
    atoms = occupied.copy()
    spare = column_sums(atoms) - column_sums(fill)
    log = np.empty((2 * occupied.size, 5), np.int32)
    passed = np.empty(4 * len(atoms), np.int64)
    log, n_moves, n_batches, passed, n_scans = presort(log, 0, 0, passed, 0, atoms, spare, row_tones)
    n_first, n_presorted = n_moves, n_batches
    log, n_moves, n_batches = supply_columns(log, n_moves, n_batches, atoms, spare, column_tones)
    for batch in range(n_presorted, n_batches):
        low, high = max(atoms.shape), 0
        while n_first < n_moves and log[n_first, 0] == batch:
            along = 2 if log[n_first, 1] == log[n_first, 3] else 1
            for at in (along, along + 2):
                low = min(low, log[n_first, at])
                high = max(high, log[n_first, at])
            n_first += 1
        passed = count_scan(passed, n_scans, high - low + 1)
        n_scans += 1
    return sort_columns(log, n_moves, n_batches, passed, n_scans, atoms, fill, clear, column_tones, slots > 0)
