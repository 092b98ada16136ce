"""The rules of the check, as plainly as they can be written."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from labseq.model import Batch, MotionSpec, Occupancy, Plan, SiteGrid

Site = tuple[int, int]
Moves = list[tuple[Site, Site]]

Floats = NDArray[np.float64]

INSTANTS_PER_SITE = 4
INSTANTS_PER_LEG = 33


class Illegal(Exception):  # noqa: N818 - a verdict
    pass


def require(condition: bool) -> None:
    if not condition:
        raise Illegal


class NaiveChecker:
    """Keeps the atoms as a set of sites and the tones as dicts from start to goal."""

    def __init__(
        self, occupancy: Occupancy, dop: int, motion: MotionSpec, grid: SiteGrid | None = None
    ) -> None:
        self.grid = grid or SiteGrid(*occupancy.shape)
        self.n_rows, self.n_cols = occupancy.shape
        self.atoms: set[Site] = {(int(r), int(c)) for r, c in np.argwhere(occupancy)}
        self.dop, self.motion = dop, motion
        self.held: Counter[Site] = Counter()
        self.time_s = motion.overhead_per_cycle_s
        self.site_s = self.grid.spacing_m / motion.speed_m_s

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

    def play_paths(self, batch: Batch) -> int:
        """Play one batch with paths of tones, instant by instant; returns the number of tweezers."""
        paths, motion = batch.tones, self.motion
        assert paths is not None
        n_knots, n_rows, n_cols = paths.shape
        require(n_rows <= motion.max_row_tones and n_cols <= motion.max_column_tones)
        require(n_rows * n_cols <= min(self.dop, motion.max_tweezers))
        goals = dict(
            zip(map(tuple, batch.from_sites.tolist()), map(tuple, batch.to_sites.tolist()), strict=True)
        )
        require(0 < len(batch) == len(goals) == len(set(goals.values())) and set(goals) <= self.atoms)
        standing = self.atoms - set(goals)
        require(not standing & set(goals.values()))
        carried: dict[tuple[int, int], Site] = {}  # crossing -> the atom's goal
        for i, j in product(range(n_rows), range(n_cols)):
            if (at := (paths.row[0, i], paths.column[0, j])) in goals:
                carried[i, j] = goals[at]
        require(len(carried) == len(goals))
        end = {
            (i, j): min(paths.row_off[i], paths.column_off[j]) for i in range(n_rows) for j in range(n_cols)
        }
        all_on = [np.arange(n_rows), np.arange(n_cols)]
        self.fly([paths.row[[0, 0]], paths.column[[0, 0]]], all_on, standing, {})
        self.time_s += motion.overhead_per_batch_s + motion.pick_up_s
        for leg in range(n_knots - 1):
            tones = [(off > leg).nonzero()[0] for off in (paths.row_off, paths.column_off)]
            legs = [
                path[leg : leg + 2, on] for path, on in zip((paths.row, paths.column), tones, strict=True)
            ]
            spared = {
                (i, j): site
                for i, j in end
                if motion.empty_tweezers_may_land and end[i, j] == leg + 1 and (i, j) not in carried
                if self.on_grid(site := (paths.row[leg + 1, i], paths.column[leg + 1, j]))
            }
            self.fly(legs, tones, standing, spared)
            dropped = [crossing for crossing, knot in end.items() if knot == leg + 1]
            for i, j in dropped:
                if (i, j) in carried:
                    goal = carried.pop((i, j))
                    require(goal == (paths.row[leg + 1, i], paths.column[leg + 1, j]))
                    standing |= {goal} & {(r, c) for r in range(self.n_rows) for c in range(self.n_cols)}
            if any((off == leg + 1).any() for off in (paths.row_off, paths.column_off)):
                self.time_s += motion.drop_off_s
        self.atoms = standing
        self.held = Counter()
        return n_rows * n_cols

    def place_m(self, row: Floats, col: Floats) -> Floats:
        a1, a2 = self.grid.axes
        return row[..., None] * a2 + col[..., None] * a1

    def fly(
        self, legs: list[Floats], tones: list[NDArray[np.intp]], standing: set[Site], spared: dict[Site, Site]
    ) -> None:
        """Fly all tweezers along one leg: legs[axis] is (2, n_tones)."""
        slots, clearance_m = self.motion.eject_slots, self.motion.clearance_m
        ways_m = self.place_m(*np.meshgrid(*(leg[1] - leg[0] for leg in legs), indexing="ij"))
        self.time_s += float(np.hypot(*ways_m.T).max()) / self.motion.speed_m_s
        a1, a2 = self.grid.axes / self.grid.spacing_m
        least = clearance_m / self.grid.spacing_m / abs(a1[0] * a2[1] - a1[1] * a2[0])
        for part in np.linspace(0, 1, INSTANTS_PER_LEG):
            for axis, leg in enumerate(legs):
                at = leg[0] + part * (leg[1] - leg[0])
                require(bool(((at >= -slots) & (at <= (self.n_rows, self.n_cols)[axis] - 1 + slots)).all()))
                require(bool((np.diff(at) > least - 1e-6).all()))
        for (a, i), (b, j) in product(enumerate(tones[0]), enumerate(tones[1])):
            sites = np.array(sorted(standing - {spared.get((int(i), int(j)), (-9, -9))})).reshape(-1, 2)
            n = INSTANTS_PER_LEG
            while True:  # the finer, the closer it was
                part = np.linspace(0, 1, n)
                row, col = (
                    leg[0, k] + part * (leg[1, k] - leg[0, k]) for leg, k in zip(legs, (a, b), strict=True)
                )
                away_m = self.place_m(row[:, None] - sites[:, 0], col[:, None] - sites[:, 1])
                margin = np.hypot(away_m[..., 0], away_m[..., 1]).min(initial=np.inf) / clearance_m - 1
                if not 1e-8 < margin < 20 / n**2 or n > 20_000:
                    break
                n *= 8
            require(bool(margin > -1e-8))

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
    plan: Plan, occupancy: Occupancy, dop: int, motion: MotionSpec, grid: SiteGrid | None = None
) -> tuple[set[Site], list[float], list[int]] | None:
    """Atoms after the plan, end of each batch, tweezers in each; None if the plan is illegal."""
    checker = NaiveChecker(occupancy, dop, motion, grid)
    ends: list[float] = []
    n_tweezers: list[int] = []
    linked = plan.linked.tolist()
    try:
        for i, batch in enumerate(plan.batches):
            table = np.hstack([batch.from_sites, batch.to_sites]).tolist()
            moves = [((a, b), (c, d)) for a, b, c, d in table]
            leads = i + 1 < plan.n_batches and linked[i + 1]
            if batch.tones is not None:
                n_tweezers.append(checker.play_paths(batch))
            else:
                n_tweezers.append(checker.play(moves, linked[i], leads, i == 0))
            ends.append(checker.time_s)
    except Illegal:
        return None
    return checker.atoms, ends, n_tweezers
