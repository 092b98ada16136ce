"""Kernels that Tetris and MTA1 share, for arrangements of a line and atoms for every column.

``source`` and ``goal`` are as in :mod:`labseq.plugin.plan_kernels`.

In all kernels ``atoms`` marks the sites that hold an atom, ``fill`` the sites that must hold an atom and
``clear`` the sites that must be empty. They are bool (n_rows, n_cols), or (n_sites,) for a line. ``limit`` is
the maximum number of atoms in a batch, and ``slots`` the number of ejection slots on each side. ``spare``,
int64 (n_cols,), is the number of atoms that each column can spare, or below 0 the number that it lacks.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel
from labseq.plugin.plan_kernels import GrowingPlan, add_line, count_moves, sites_of, unlock_row

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

GRID: Final = const("bool_", 2)
LINE: Final = const("bool_", 1)
IMPOSSIBLE: Final = 1 << 62

# Costs of an arrangement of a line, the worst first.
NOT_FILLED: Final = 1 << 52
NOT_CLEARED: Final = 1 << 42
EJECTED: Final = 1 << 32
ATOM_MOVED: Final = 1 << 18  # and 1 for each site of distance, at most 250,000 in 1000 sites


@helper_kernel()
def sum_costs(atoms: Bools, fill: Bools, clear: Bools, cost: Ints, taken: Bools) -> None:
    """Sum up the costs of the cheapest arrangements of a line's first sites, for every balance.

    Args:
        atoms: bool (n_sites,), as ``fill`` and ``clear``.
        fill: See the module.
        clear: See the module.
        cost: int64 (n_sites + 1, 2 n_most + 1), by number of sites and by balance + n_most. Its first row is
            given. Updated.
        taken: Result, bool (n_sites, 2 n_most + 1), True if the last of these sites then holds an atom.
    """
    n_most = cost.shape[1] // 2
    for site in range(len(atoms)):
        for place in range(cost.shape[1]):
            before = cost[site, place]
            if before == IMPOSSIBLE:
                continue
            for taking in range(2):
                after = place - taking
                total = before
                if atoms[site]:
                    after += 1
                    total += 0 if taking and place == n_most else ATOM_MOVED
                if not 0 <= after < cost.shape[1]:
                    continue
                total += abs(after - n_most)
                if taking:
                    total += NOT_CLEARED if clear[site] else 0
                else:
                    total += NOT_FILLED if fill[site] else 0
                if total < cost[site + 1, after]:
                    cost[site + 1, after] = total
                    taken[site, after] = taking == 1


@helper_kernel(f"UniTuple(int64[::1], 2)({LINE}, {LINE}, {LINE}, boolean, boolean)")
def settle(atoms: Bools, fill: Bools, clear: Bools, low: bool, high: bool) -> tuple[Ints, Ints]:
    """Find the cheapest arrangement of a line, as the sources and goals of its atoms.

    A dynamic programme over sites and balances. The balance is the number of atoms up to a site minus the
    number of goals up to it, so it is the number of atoms that cross from the site to the next. It starts
    below 0 by the number of atoms that are ejected at the low end, if ``low`` allows that, and ends above 0
    by the number ejected at the high end. Fill sites left empty count most, then atoms left on clear sites,
    ejections, atoms moved and distance. Ejections are distributed over both ends.
    """
    n_sites, source = len(atoms), sites_of(atoms)
    n_wrong = 0
    for site in range(n_sites):
        n_wrong += clear[site] if atoms[site] else fill[site]
    if n_wrong == 0:
        return source, source.copy()
    n_atoms = len(source)
    goal = np.empty(n_atoms, np.int64)
    cost = np.full((n_sites + 1, 2 * n_atoms + 1), IMPOSSIBLE, np.int64)
    taken = np.zeros((n_sites, 2 * n_atoms + 1), np.bool_)
    for n_left in range(n_atoms + 1 if low else 1):
        cost[0, n_atoms - n_left] = n_left * (EJECTED + n_left * ATOM_MOVED + 1)
    sum_costs(atoms, fill, clear, cost, taken)
    n_high = 0
    best = cost[n_sites, n_atoms]
    for n_left in range(1, n_atoms + 1 if high else 1):
        total = cost[n_sites, n_atoms + n_left]
        if total < IMPOSSIBLE and total + n_left * (EJECTED + n_left * ATOM_MOVED) < best:
            best = total + n_left * (EJECTED + n_left * ATOM_MOVED)
            n_high = n_left
    for n_left in range(n_high):
        goal[n_atoms - 1 - n_left] = n_sites + n_high - 1 - n_left
    n_to_go = n_atoms - n_high
    place = n_atoms + n_high
    for site in range(n_sites - 1, -1, -1):
        if taken[site, place]:
            n_to_go -= 1
            goal[n_to_go] = site
            place += 1
        if atoms[site]:
            place -= 1
    for n_left in range(n_to_go):
        goal[n_left] = n_left - n_to_go
    return source, goal


@helper_kernel()
def nearest_exchange(atoms: Bools, spare: Ints) -> tuple[int, int]:
    """Find the nearest pair of an atom that can be spared and a lacking vacancy in a row.

    Returns:
        The columns of the atom and the vacancy, or (-1, ``n_cols``) if there are none.
    """
    best_atom, best_vacancy = -1, len(atoms)
    atom = vacancy = -1
    for col in range(len(atoms)):
        if atoms[col] and spare[col] > 0:
            atom = col
        elif not atoms[col] and spare[col] < 0:
            vacancy = col
        else:
            continue
        if min(atom, vacancy) >= 0 and abs(atom - vacancy) < abs(best_atom - best_vacancy):
            best_atom, best_vacancy = atom, vacancy
    return best_atom, best_vacancy


@helper_kernel()
def row_of_nearest_exchange(atoms: Bools, spare: Ints) -> int:
    """Find the row with the nearest exchange, or -1 if no row has an exchange."""
    best_row, best = -1, len(spare) + 1
    for row in range(len(atoms)):
        atom, vacancy = nearest_exchange(atoms[row], spare)
        if abs(atom - vacancy) < best:
            best_row, best = row, abs(atom - vacancy)
    return best_row


@helper_kernel()
def supply_columns(plan: GrowingPlan, atoms: Bools, spare: Ints, limit: int) -> GrowingPlan:
    """Give every column as many atoms as it needs, row by row, the row with the nearest exchange first.

    All possible exchanges of a row are made, the nearest first. Its atoms keep their order, so atoms in
    between go on to the place of the next. There must be at least as many atoms as the columns need. Updates
    ``atoms`` and ``spare``.
    """
    n_cols = len(spare)
    while spare.min() < 0:
        n_moves = count_moves(plan)
        row = row_of_nearest_exchange(atoms, spare)
        if row < 0:
            plan = unlock_row(plan, atoms, spare)
        else:
            source = sites_of(atoms[row])
            col, to_col = nearest_exchange(atoms[row], spare)
            while col >= 0:
                atoms[row, col], atoms[row, to_col] = False, True
                spare[col] -= 1
                spare[to_col] += 1
                col, to_col = nearest_exchange(atoms[row], spare)
            plan = add_line(plan, (True, row, n_cols), source, sites_of(atoms[row]), limit, 0)
        if count_moves(plan) == n_moves:
            break
    return plan
