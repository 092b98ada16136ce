"""The rules of the check, as plainly as they can be written."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise, product

import numpy as np

from labseq.model import MotionSpec, Occupancy, Plan, SiteGrid

Site = tuple[int, int]
Moves = list[tuple[Site, Site]]

INSTANTS_PER_SITE = 4


class Illegal(Exception):  # noqa: N818 - a verdict
    pass


def require(condition: bool) -> None:
    if not condition:
        raise Illegal


class NaiveChecker:
    """Keeps the atoms as a set of sites and the tones as dicts from start to goal."""

    def __init__(self, occupancy: Occupancy, dop: int, motion: MotionSpec) -> None:
        self.n_rows, self.n_cols = occupancy.shape
        self.atoms: set[Site] = {(int(r), int(c)) for r, c in np.argwhere(occupancy)}
        self.dop, self.motion = dop, motion
        self.held: Counter[Site] = Counter()
        self.time_s = motion.overhead_per_cycle_s
        self.site_s = SiteGrid().spacing_m / motion.speed_m_s

    def on_grid(self, site: Site) -> bool:
        return site[0] in range(self.n_rows) and site[1] in range(self.n_cols)

    def in_slot(self, site: Site) -> bool:
        rows = range(-self.motion.eject_slots, self.n_rows + self.motion.eject_slots)
        cols = range(-self.motion.eject_slots, self.n_cols + self.motion.eject_slots)
        return not self.on_grid(site) and site[0] in rows and site[1] in cols

    def play(self, moves: Moves, linked: bool, leads: bool, first: bool) -> int:
        """Play one batch; returns the number of tweezers."""
        sources, goals = [a for a, _ in moves], [b for _, b in moves]
        require(len(moves) > 0)
        require(all(map(self.on_grid, sources)))
        require(all(self.on_grid(goal) or self.in_slot(goal) for goal in goals))
        if linked:
            require(not first and Counter(sources) == self.held)
        require(len(set(sources)) == len(sources) and set(sources) <= self.atoms)
        standing = self.atoms - set(sources)
        require(len(set(goals)) == len(goals) and not standing & set(goals))

        rows, cols = self.trajectories(moves, 0), self.trajectories(moves, 1)
        require(all(len(ends) == 1 for ends in (*rows.values(), *cols.values())))
        row_tones = {start: min(ends) for start, ends in rows.items()}
        column_tones = {start: min(ends) for start, ends in cols.items()}
        row_moves = any(start != end for start, end in row_tones.items())
        column_moves = any(start != end for start, end in column_tones.items())
        require(not (row_moves and column_moves))
        if not (linked or leads):
            require(all(a != b for a, b in moves))
        require(len(row_tones) <= self.motion.max_row_tones)
        require(len(column_tones) <= self.motion.max_column_tones)
        n_tweezers = len(row_tones) * len(column_tones)
        require(n_tweezers <= min(self.dop, self.motion.max_tweezers))

        longest = max(abs(b - a) for a, b in (*row_tones.items(), *column_tones.items()))
        for instant in range(longest * INSTANTS_PER_SITE + 1):
            travelled = instant / INSTANTS_PER_SITE
            where = [
                {start: self.place(start, end, travelled) for start, end in tones.items()}
                for tones in (row_tones, column_tones)
            ]
            for places in where:
                in_order = [places[start] for start in sorted(places)]
                require(all(b - a >= 1 for a, b in pairwise(in_order)))
            require(not any((r, c) in standing for r, c in product(where[0].values(), where[1].values())))

        self.atoms = standing | {goal for goal in goals if self.on_grid(goal)}
        self.held = Counter(goals)
        motion = self.motion
        self.time_s += 0 if linked else motion.overhead_per_batch_s + motion.pick_up_s
        self.time_s += longest * self.site_s + (0 if leads else motion.drop_off_s)
        return n_tweezers

    @staticmethod
    def trajectories(moves: Moves, axis: int) -> dict[int, set[int]]:
        ends: dict[int, set[int]] = {}
        for a, b in moves:
            ends.setdefault(a[axis], set()).add(b[axis])
        return ends

    @staticmethod
    def place(start: int, end: int, travelled: float) -> float:
        return min(start + travelled, end) if end >= start else max(start - travelled, end)


def naive(
    plan: Plan, occupancy: Occupancy, dop: int, motion: MotionSpec
) -> tuple[set[Site], list[float], list[int]] | None:
    """Atoms after the plan, end of each batch, tweezers in each; None if the plan is illegal."""
    checker = NaiveChecker(occupancy, dop, motion)
    ends: list[float] = []
    n_tweezers: list[int] = []
    linked = plan.linked.tolist()
    try:
        for i, batch in enumerate(plan.batches):
            table = np.hstack([batch.from_sites, batch.to_sites]).tolist()
            moves = [((a, b), (c, d)) for a, b, c, d in table]
            leads = i + 1 < plan.n_batches and linked[i + 1]
            n_tweezers.append(checker.play(moves, linked[i], leads, i == 0))
            ends.append(checker.time_s)
    except Illegal:
        return None
    return checker.atoms, ends, n_tweezers
