"""Kernels of MTA1, for presorting between columns and scans, with names as in ``kernels_lines``.

``place`` and ``goal``, int64 (n_cols, n_rows), are the rows of each column's atoms, ascending, and their
goals. ``n_atoms``, int64 (n_cols,), is the number of atoms of each column.
"""

from __future__ import annotations

import numpy as np

from labseq.plugin import helper_kernel, kernel
from labseq.plugin.plan_kernels import (
    FINISHED_PLAN,
    GROWING_PLAN,
    FinishedPlan,
    GrowingPlan,
    add_move,
    column_sums,
    count_moves,
    empty_plan,
    end_batch,
    finished,
)
from labseq_rivals.kernels_lines import GRID, Bools, Ints, settle, supply_columns

Scans = tuple[Ints, int]
"""Number of lines that each scan passes, and number of scans."""


@helper_kernel()
def add_scan(scans: Scans, n_lines: int) -> Scans:
    """Add a scan that passes ``n_lines``."""
    passed, n_scans = scans
    if n_scans == len(passed):
        longer = np.empty(2 * n_scans + 1, np.int64)
        longer[:n_scans] = passed
        passed = longer
    passed[n_scans] = n_lines
    return passed, n_scans + 1


@helper_kernel()
def look_aside(atoms: Bools, col: int, side: int, distance: Ints) -> None:
    """Measure the distance of each vacancy of a column from the nearest atom in its row.

    Args:
        atoms: bool (n_rows, n_cols).
        side: Side to look at, -1 for the left, 1 for the right.
        distance: Result, int64 (n_rows,), in columns, 0 where there is no vacancy or no atom.
    """
    for row in range(len(atoms)):
        distance[row] = 0
        other = col + side
        while not atoms[row, col] and 0 <= other < atoms.shape[1]:
            if atoms[row, other]:
                distance[row] = abs(other - col)
                break
            other += side


@helper_kernel()
def choose_nearest(distance: Ints, chosen: Bools, n_wanted: int) -> int:
    """Mark up to ``n_wanted`` rows with the least distances above 0, and return the largest of these."""
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
    return farthest


@helper_kernel()
def fetch(
    plan: GrowingPlan,
    atoms: Bools,
    spare: Ints,
    col: int,
    side: int,
    distance: Ints,
    chosen: Bools,
    farthest: int,
) -> GrowingPlan:
    """Move the atoms of the chosen rows into a column by one horizontal scan.

    Updates ``atoms``, ``spare`` and ``distance``, which is 0 afterwards where an atom was moved.

    Args:
        atoms: bool (n_rows, n_cols).
        spare: int64 (n_cols,).
        side: Side of the atoms, -1 for the left, 1 for the right.
        distance: int64 (n_rows,), from :func:`look_aside`.
        chosen: bool (n_rows,), from :func:`choose_nearest`.
        farthest: The largest distance in the chosen rows.
    """
    for steps in range(farthest, 0, -1):
        source = col + side * steps
        n_before = count_moves(plan)
        for row in range(len(distance)):
            if chosen[row] and distance[row] == steps:
                plan = add_move(plan, row, source, row, col)
                atoms[row, source] = False
                atoms[row, col] = True
                distance[row] = 0
        n_taken = count_moves(plan) - n_before
        spare[source] -= n_taken
        spare[col] += n_taken
        plan = end_batch(plan, False)
    return plan


@helper_kernel()
def presort(
    plan: GrowingPlan, scans: Scans, atoms: Bools, spare: Ints, limit: int
) -> tuple[GrowingPlan, Scans]:
    """Supply the columns that lack atoms, in turns, until none does or nothing helps.

    The side with more atoms to spare in all gives its nearest atoms in the rows where the column has a
    vacancy, as many as it can spare. Their columns may lack atoms afterwards. Updates ``atoms`` and
    ``spare``.
    """
    n_rows, n_cols = atoms.shape
    distance = np.empty(n_rows, np.int64)
    chosen = np.empty(n_rows, np.bool_)
    for _ in range(n_cols):
        n_before = count_moves(plan)
        for col in range(n_cols):
            if spare[col] >= 0:
                continue
            left, right = np.sum(spare[:col]), np.sum(spare[col + 1 :])
            side = -1 if left >= right else 1
            n_wanted = min(-spare[col], max(left, right))
            look_aside(atoms, col, side, distance)
            while n_wanted > 0:
                chosen[:] = False
                farthest = choose_nearest(distance, chosen, min(n_wanted, limit))
                if farthest == 0:
                    break
                n_start = count_moves(plan)
                plan = fetch(plan, atoms, spare, col, side, distance, chosen, farthest)
                scans = add_scan(scans, farthest + 1)
                n_wanted -= count_moves(plan) - n_start
        if count_moves(plan) == n_before:
            break
    return plan, scans


@helper_kernel()
def end_of_move(place: Ints, goal: Ints, n_atoms: Ints, n_rows: int, col: int, i: int, sense: int) -> int:
    """Row where a scan drops atom ``i``, its goal or the row before the next atom, or its own if it stays.

    An atom to be ejected waits until none is below it. ``sense`` is 1 for a downward scan, -1 for an upward
    one.
    """
    ahead = i + sense
    blocked = 0 <= ahead < n_atoms[col]
    if goal[col, i] >= n_rows:
        return place[col, i] if blocked or sense < 0 else n_rows
    end = goal[col, i] * sense
    if blocked:
        end = min(end, place[col, ahead] * sense - 1)
    return max(end, place[col, i] * sense) * sense


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, int64[:, ::1], int64[:, ::1], int64[::1], int64, int64)")
def scan(plan: GrowingPlan, place: Ints, goal: Ints, n_atoms: Ints, sense: int, limit: int) -> GrowingPlan:
    """Move a row of tweezers over all rows once, each with one atom of its column at a time.

    Atoms that are picked up on the same row and dropped on the same row make a batch. ``sense``
    is 1 for a downward scan, -1 for an upward one. Updates ``place`` and ``n_atoms``.
    """
    n_cols, n_rows = place.shape
    n_on = 0
    n_dropped = np.zeros(n_rows + 1, np.int64)  # by row, and an upward scan reaches none below 0
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
            n_before = count_moves(plan)
            for col in range(n_cols):
                if picked[col] == end:
                    plan = add_move(plan, row, col, end, col)
            n_picked -= count_moves(plan) - n_before
            plan = end_batch(plan, False)
    return plan


@helper_kernel()
def sort_columns(
    plan: GrowingPlan, scans: Scans, atoms: Bools, fill: Bools, clear: Bools, limit: int, may_eject: bool
) -> tuple[GrowingPlan, Scans]:
    """Scan downwards and upwards in turns until every atom is at its goal.

    No column may hold fewer atoms than it has fill sites. Atoms are ejected below the last row only.
    """
    n_rows, n_cols = atoms.shape
    place = np.empty((n_cols, n_rows), np.int64)
    goal = np.empty((n_cols, n_rows), np.int64)
    n_atoms = np.empty(n_cols, np.int64)
    for col in range(n_cols):
        line = atoms[:, col].copy(), fill[:, col].copy(), clear[:, col].copy()
        source, end = settle(line[0], line[1], line[2], False, may_eject)
        n = n_atoms[col] = len(source)
        place[col, :n], goal[col, :n] = source, end
    n_idle = 0
    sense = 1
    while n_idle < 2:
        n_held, n_before = np.sum(n_atoms), count_moves(plan)
        plan = scan(plan, place, goal, n_atoms, sense, limit)
        n_idle = 0 if count_moves(plan) > n_before else n_idle + 1
        if n_idle == 0:
            ejects = np.sum(n_atoms) < n_held
            scans = add_scan(scans, n_rows + 1 if ejects else n_rows)
        sense = -sense
    return plan, scans


@helper_kernel()
def scans_of_exchanges(scans: Scans, plan: GrowingPlan, first_batch: int) -> Scans:
    """Add a scan for each batch from ``first_batch`` on, over the lines between its outermost sites."""
    moves, offsets, _, n_batches = plan
    for batch in range(first_batch, n_batches):
        low, high = len(moves), 0
        axis = 1 if moves[offsets[batch], 0] == moves[offsets[batch], 2] else 0
        for n in range(offsets[batch], offsets[batch + 1]):
            start, end = int(moves[n, axis]), int(moves[n, axis + 2])
            low, high = min(low, start, end), max(high, start, end)
        scans = add_scan(scans, high - low + 1)
    return scans


@kernel(f"Tuple(({FINISHED_PLAN}, int64[::1]))({GRID}, {GRID}, {GRID}, int64, int64, int64)")
def plan_mta1(
    occupied: Bools, fill: Bools, clear: Bools, row_tones: int, column_tones: int, slots: int
) -> tuple[FinishedPlan, Ints]:
    """Plan MTA1.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_tones: Maximum number of tweezers in a column.
        column_tones: Maximum number of tweezers in a row.
        slots: Ejection slots on each side.

    Returns:
        The plan, and the number of lines that each scan passes, int64 (n_scans,).
    """
    atoms = occupied.copy()
    spare = column_sums(atoms) - column_sums(fill)
    plan, scans = empty_plan(2 * atoms.size), (np.empty(4 * len(atoms), np.int64), 0)
    plan, scans = presort(plan, scans, atoms, spare, row_tones)
    n_presorted = plan[3]
    plan = supply_columns(plan, atoms, spare, column_tones)
    scans = scans_of_exchanges(scans, plan, n_presorted)
    plan, scans = sort_columns(plan, scans, atoms, fill, clear, column_tones, slots > 0)
    return finished(plan), scans[0][: scans[1]].copy()
