"""Kernels of MTA1's pre-sorting: columns that lack atoms get them from the side with more to spare."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import kernel
from labseq_scans._kernels_lines import GRID, Log, record

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Scanned = tuple[Log, int, int, Ints, int]
"""A growing plan (see ``_kernels_lines``), how many lines each of its scans passes, how many scans."""

SCANNED: Final = "int32[:, ::1], int64, int64, int64[::1], int64"


@kernel("int64[::1](int64[::1], int64, int64)")
def count_scan(passed: Ints, n_scans: int, n_lines: int) -> Ints:
    """Note how many lines scan ``n_scans`` passes; the list is lengthened if it is full."""
    if n_scans == len(passed):
        longer = np.empty(2 * n_scans + 1, np.int64)
        longer[:n_scans] = passed
        passed = longer
    passed[n_scans] = n_lines
    return passed


@kernel(f"void({GRID}, int64, int64, int64[::1])")
def look_aside(atoms: Bools, col: int, side: int, distance: Ints) -> None:
    """Measure how far the nearest atom beside each vacancy of a column is.

    Args:
        atoms: bool (n_rows, n_cols).
        col: The column.
        side: Where to look: -1 to the left, 1 to the right.
        distance: Result, int64 (n_rows,), in columns; 0 where there is no vacancy or no atom.
    """
    for row in range(len(atoms)):
        distance[row] = 0
        other = col + side
        while not atoms[row, col] and 0 <= other < atoms.shape[1]:
            if atoms[row, other]:
                distance[row] = abs(other - col)
                break
            other += side


@kernel(f"Tuple(({SCANNED}))({SCANNED}, bool_[:, ::1], int64[::1], int64, int64, int64, int64[::1])")
def fetch(
    log: Log,
    n_moves: int,
    n_batches: int,
    passed: Ints,
    n_scans: int,
    atoms: Bools,
    spare: Ints,
    col: int,
    side: int,
    n_wanted: int,
    distance: Ints,
) -> Scanned:
    """Move the nearest atoms of one side into a column by one horizontal scan.

    Args:
        log: Of the growing plan, as ``n_moves``, ``n_batches``, ``passed`` and ``n_scans``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        passed: int64 (>= n_scans,), lines that each scan passes.
        n_scans: Number of scans so far.
        atoms: bool (n_rows, n_cols); updated.
        spare: int64 (n_cols,), atoms that each column can spare; updated.
        col: The column.
        side: Where the atoms come from: -1 from the left, 1 from the right.
        n_wanted: Most atoms to move.
        distance: int64 (n_rows,), see :func:`look_aside`; 0 afterwards where an atom was moved.
    """
    chosen = np.zeros(len(distance), np.bool_)
    farthest = 0
    for _ in range(n_wanted):
        nearest = -1
        for row in range(len(distance)):
            if distance[row] > 0 and not chosen[row] and (nearest < 0 or distance[row] < distance[nearest]):
                nearest = row
        if nearest < 0:
            break
        chosen[nearest] = True
        farthest = distance[nearest]
    for steps in range(farthest, 0, -1):
        source = col + side * steps
        n_before = n_moves
        for row in range(len(distance)):
            if chosen[row] and distance[row] == steps:
                log = record(log, n_moves, n_batches, row, source, row, col)
                n_moves += 1
                atoms[row, source] = False
                atoms[row, col] = True
                distance[row] = 0
        n_taken = n_moves - n_before
        spare[source] -= n_taken
        spare[col] += n_taken
        n_batches += n_taken > 0
    if farthest > 0:
        passed = count_scan(passed, n_scans, farthest + 1)
        n_scans += 1
    return log, n_moves, n_batches, passed, n_scans


@kernel(f"Tuple(({SCANNED}))({SCANNED}, bool_[:, ::1], int64[::1], int64)")
def presort(
    log: Log, n_moves: int, n_batches: int, passed: Ints, n_scans: int, atoms: Bools, spare: Ints, limit: int
) -> Scanned:
    """Supply the columns that lack atoms, in turns, until none does or nothing helps.

    The side with more atoms to spare in all gives its nearest atoms in the rows
    where the column has a vacancy, as many as it can spare; their columns may lack
    atoms afterwards.

    Args:
        log: Of the growing plan, as ``n_moves``, ``n_batches``, ``passed`` and ``n_scans``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        passed: int64 (>= n_scans,), lines that each scan passes.
        n_scans: Number of scans so far.
        atoms: bool (n_rows, n_cols); updated.
        spare: int64 (n_cols,), atoms that each column can spare, below 0: that it lacks; updated.
        limit: Most atoms on at once.
    """
    n_rows, n_cols = atoms.shape
    distance = np.empty(n_rows, np.int64)
    for _ in range(n_cols):
        n_before = n_moves
        for col in range(n_cols):
            if spare[col] >= 0:
                continue
            left, right = np.sum(spare[:col]), np.sum(spare[col + 1 :])
            side = -1 if left >= right else 1
            n_wanted = min(-spare[col], max(left, right))
            look_aside(atoms, col, side, distance)
            while n_wanted > 0:
                n_start = n_moves
                log, n_moves, n_batches, passed, n_scans = fetch(
                    log,
                    n_moves,
                    n_batches,
                    passed,
                    n_scans,
                    atoms,
                    spare,
                    col,
                    side,
                    min(n_wanted, limit),
                    distance,
                )
                if n_moves == n_start:
                    break
                n_wanted -= n_moves - n_start
        if n_moves == n_before:
            break
    return log, n_moves, n_batches, passed, n_scans
