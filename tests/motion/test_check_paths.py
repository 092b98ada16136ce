"""The check of batches with paths of tones: every rule, by examples and against a naive checker."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest

from labseq.errors import InvalidPlanError
from labseq.model import Batch, MotionSpec, Occupancy, Plan, PlanReport, SiteGrid, TargetPattern, TonePaths
from labseq.motion import check_plan

from .naive_checker import naive

Knots = list[list[float]]


def grid_of(text: str) -> Occupancy:
    return np.array([[site == "#" for site in row] for row in text.split()])


def paths(row: Knots, column: Knots, row_off: Any = (), column_off: Any = ()) -> TonePaths:
    return TonePaths(np.array(row), np.array(column), np.array(row_off), np.array(column_off))


def along(start: list[float], end: list[float]) -> TonePaths:
    """Column tones that go straight, on row 0."""
    return paths([[0], [0]], [start, end])


def batch(moves: list[tuple[int, int, int, int]], tones: TonePaths) -> Batch:
    table = np.array(moves, np.int16).reshape(-1, 4)
    return Batch(table[:, :2], table[:, 2:], tones=tones)


def check(
    atoms: str, *batches: Batch, dop: int = 20, grid: SiteGrid | None = None, **motion: Any
) -> PlanReport:
    occupancy = grid_of(atoms)
    target = TargetPattern.none((occupancy.shape[0], occupancy.shape[1]))
    return check_plan(Plan.from_batches(batches), occupancy, target, dop, grid, MotionSpec(**motion))


def test_a_grid_of_atoms_goes_through_lanes() -> None:
    straight = paths([[0, 2], [0.5, 2.5], [0.5, 2.5], [1, 3]], [[0, 2], [0, 2], [1, 3], [1, 3]])
    moves = [(0, 0, 1, 1), (0, 2, 1, 3), (2, 0, 3, 1), (2, 2, 3, 3)]
    report = check("#.#. .... #.#. ....", batch(moves, straight))
    assert report.predicted.tolist() == grid_of(".... .#.# .... .#.#").tolist()
    assert report.n_tweezers.tolist() == [4]
    ways = 0.5 + 1 + 0.5
    site_s = SiteGrid().spacing_m / MotionSpec().speed_m_s
    assert report.duration_s == pytest.approx(13e-3 + 120e-6 + ways * site_s)


def test_a_diagonal_leg_takes_as_long_as_its_longest_way() -> None:
    diagonal = paths([[0], [1]], [[0], [1]])
    for grid, way in (
        (SiteGrid(2, 2), 3**0.5),
        (SiteGrid(2, 2, shear=-1), 1),
        (SiteGrid(2, 2, lattice="square"), 2**0.5),
    ):
        took_s = check("#. ..", batch([(0, 0, 1, 1)], diagonal), grid=grid).duration_s
        assert took_s == pytest.approx(13e-3 + 120e-6 + way * grid.spacing_m / MotionSpec().speed_m_s)


RIGHT = [(0, 0, 0, 1)]
TWO_ROWS = paths([[0, 1]] * 2, [[0], [1]])
LANDS = {"empty_tweezers_may_land": True}


@pytest.mark.parametrize(
    ("rule", "words", "atoms", "moves", "tones", "options"),
    [
        ("shape", "no atom moves", "#..", [], along([1], [2]), {}),
        ("grid", r"\(0, 7\) is outside", "#..", [(0, 7, 0, 1)], along([7], [1]), {"eject_slots": 9}),
        ("grid", "tone 0 goes more than 1 site", "#..", [(0, 0, 0, -2)], along([0], [-2]), {}),
        ("source", r"no atom on \(0, 1\)", "#..", [(0, 1, 0, 2)], along([1], [2]), {}),
        ("goal", "ends on an atom that stays", "#.#", [(0, 0, 0, 2)], along([0], [2]), {}),
        ("tones", "no column tone starts at", "#..", [(0, 0, 0, 2)], along([0.5], [2]), {}),
        ("tones", "column tone is elsewhere at knot 1", "#..", [(0, 0, 0, 1)], along([0], [2]), {}),
        ("tones", "2 row tones; the limit is 1", "#. ..", RIGHT, TWO_ROWS, {"max_row_tones": 1}),
        ("order", "tone 1 comes closer than 0.489 sites", "##.", RIGHT, along([0, 1], [1, 1.25]), {}),
        # the tone between two others goes off first
        ("order", "column tone 2", "###", [(0, 0, 0, 0)],
         paths([[0]] * 3, [[0, 1, 2], [0, 1, 2], [0, 0, 0.25]], (), [2, 1, 2]), {}),
        ("parallelism", "make 2 tweezers; the limit is 1", "#. ..", RIGHT, TWO_ROWS, {"max_tweezers": 1}),
        ("crossing", r"at the atom on \(0, 1\)", "##..", [(0, 0, 0, 2)], along([0, 1], [2, 3]), {}),
        ("crossing", r"at the atom on \(0, 2\)", "#.#.", [(0, 0, 0, 1)], along([0, 1.75], [1, 3]), {}),
        ("path", r"closer than 1.9 um to .* on \(0, 1\)", "##.", [(0, 0, 0, 2)], along([0], [2]), {}),
        ("path", r"tweezer ends on the atom on \(0, 3\)", "#..#", [(0, 0, 0, 1)], along([0, 2], [1, 3]), {}),
        ("path", r"atom on \(0, 2\)", "#.#.", [(0, 0, 0, 1)], along([0, 1], [1, 3]), LANDS),
        # the atom of row 0 is dropped off, and in the leg that follows the tweezer of row 3 passes over it
        ("path", r"atom on \(0, 0\)", "# . . #", [(0, 0, 0, 0), (3, 0, -1, 0)],
         paths([[0, 3], [0, 3], [0, -1]], [[0], [0], [0]], [1, 2]), {}),
    ],
)  # fmt: skip
def test_each_rule(rule: str, words: str, atoms: str, moves: Any, tones: TonePaths, options: Any) -> None:
    with pytest.raises(InvalidPlanError, match=words) as error:
        check(atoms, batch(moves, tones), **options)
    assert error.value.rule == rule


@pytest.mark.parametrize("grid", [SiteGrid(3, 3), SiteGrid(3, 3, shear=-1), SiteGrid(3, 3, lattice="square")])
def test_short_legs_towards_an_atom_and_back(grid: SiteGrid) -> None:
    """From any side, and just as near as is allowed, or a thousandth nearer."""
    to_lines = np.linalg.inv(grid.axes) * grid.spacing_m  # of x, y in spacings: column, row
    corner = np.array([-1.0, -1.0]) @ grid.axes / grid.spacing_m
    clearance = MotionSpec().clearance_m / grid.spacing_m
    first = float(np.arctan2(corner[1], corner[0]))
    for part in range(48):
        around = np.linspace(first, first + 2 * np.pi * part / 48, 60)
        for nearest in (1.001, 0.999):
            radius = np.concatenate([np.full(60, 0.7), np.linspace(0.7, nearest * clearance, 5)])
            angle = np.concatenate([around, np.full(5, around[-1])])
            there = 1.0 + (radius * np.array([np.cos(angle), np.sin(angle)])).T @ to_lines
            column, row = np.concatenate([[[0, 0]], there, there[::-1], [[0, 0]]]).T[:, :, None]
            visit = batch([(0, 0, 0, 0)], TonePaths(row, column))
            if nearest > 1.0:
                assert check("#.. .#. ...", visit, grid=grid).predicted.sum() == 2
                continue
            with pytest.raises(InvalidPlanError, match=r"atom on \(1, 1\)"):
                check("#.. .#. ...", visit, grid=grid)


def test_an_empty_tweezer_may_land_where_the_machine_allows_it() -> None:
    landing = batch([(0, 0, 0, 1)], along([0, 2], [1, 3]))
    assert check("#..#", landing, empty_tweezers_may_land=True).predicted.tolist() == grid_of(".#.#").tolist()


def test_what_arrays_may_say_of_paths_is_tested() -> None:
    """Numbers that `TonePaths` would refuse, and batches that are linked."""
    good = [0.0, 0.0, 0.0, 1.0]
    for words, shapes, positions, off, linked in (
        ("fewer than two knots", [[4, 1, 0]], good, [3], [False]),
        ("is not finite", [[2, 1, 1]], [np.nan] * 4, [1, 1], [False]),
        ("go off at knots from 1 to the last", [[2, 1, 1]], good, [2, 1], [False]),
        ("paths of tones; only line", [[2, 1, 1], [0, 0, 0]], good, [1, 1], [False, True]),
        ("or the batch before has", [[0, 0, 0], [2, 1, 1]], good, [1, 1], [False, True]),
    ):
        moves = np.array([[0, 0, 0, 1], [0, 1, 0, 2]][: len(shapes)])
        offsets, shapes = np.arange(len(shapes) + 1, dtype=np.int32), np.array(shapes)
        plan = Plan(moves, offsets, np.array(linked), shapes, np.array(positions), np.array(off))
        with pytest.raises(InvalidPlanError, match=words):
            check_plan(plan, grid_of("#.."), TargetPattern.none((1, 3)), 20)


class RandomPaths:
    """Draws batches of a grid planner through lanes, many of them legal, and damages some."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        shape = rng.integers(2, 8, 2).tolist()
        grids = SiteGrid(*shape), SiteGrid(*shape, shear=-1), SiteGrid(*shape, lattice="square")
        self.grid = grids[int(rng.integers(3))]
        tweezers, rows, cols, slots = rng.integers((6, 2, 3, 0), (21, 7, 7, 9)).tolist()
        clearance_m = self.grid.spacing_m * rng.choice([0.3, 0.4231, 0.49])
        self.motion = MotionSpec(
            max_tweezers=tweezers, max_row_tones=rows, max_column_tones=cols,
            eject_slots=(slots + 2) // 3,
            clearance_m=clearance_m, empty_tweezers_may_land=bool(rng.random() < 0.5),
        )  # fmt: skip
        self.atoms: Occupancy = rng.random(shape) < rng.choice([0.2, 0.4, 0.6])

    def plan(self) -> Plan:
        atoms = self.atoms.copy()
        return Plan.from_batches([self.batch(atoms, n == 0) for n in range(self.rng.integers(1, 3))])

    def batch(self, atoms: Occupancy, first: bool) -> Batch:
        """A batch; ``atoms`` are those after it if it is legal."""
        n_rows, n_cols = atoms.shape
        tones, tries = self.tones(), 0
        while tries < 10 and not self.has_atoms(tones, atoms):
            tones, tries = self.tones(), tries + 1
        crossings = [(i, j) for i in range(tones.shape[1]) for j in range(tones.shape[2])]
        ways = [np.rint(tones.path_of(i, j)).astype(int) for i, j in crossings]
        goals = [(r, c) for r, c in (tuple(way[-1]) for way in ways) if 0 <= r < n_rows and 0 <= c < n_cols]
        sources = {tuple(way[0]) for way in ways}
        if (taken := [goal for goal in goals if goal not in sources]) and first and self.rng.random() < 0.8:
            atoms[tuple(np.array(taken).T)] = False  # most goals of the first batch are free
            self.atoms = atoms.copy()
        moves = [
            (*way[0], *way[-1])
            for way, (i, j) in zip(ways, crossings, strict=True)
            if tones.row[0, i] in range(n_rows)
            and tones.column[0, j] in range(n_cols)
            and atoms[tuple(way[0])]
        ]
        if moves and self.rng.random() < 0.1:
            del moves[int(self.rng.integers(len(moves)))]
        if moves and self.rng.random() < 0.05:
            moves[0] = (*moves[0][:3], moves[0][3] + 1)
        for r, c, _, _ in moves:
            atoms[r, c] = False
        for _, _, r, c in moves:
            if 0 <= r < n_rows and 0 <= c < n_cols:
                atoms[r, c] = True
        return batch(moves, tones)

    def has_atoms(self, tones: TonePaths, atoms: Occupancy) -> bool:
        """Whether there is an atom where two tones start, give or take."""
        starts = [
            np.clip(np.rint(one[0]), 0, n - 1)
            for one, n in zip((tones.row, tones.column), atoms.shape, strict=False)
        ]
        return bool(atoms[np.ix_(*(one.astype(int) for one in starts))].any())

    def tones(self) -> TonePaths:
        rng = self.rng
        rows, cols = (self.ends(n, int(rng.integers(1, 4))) for n in self.grid.shape)
        lanes = rng.choice([-0.5, 0.5, 0.25, 0.0], 4, p=[0.45, 0.45, 0.05, 0.05])
        row = [
            rows[0],
            rows[0] + lanes[0],
            rows[0] + lanes[0],
            rows[1] + lanes[1],
            rows[1] + lanes[1],
            rows[1],
        ]
        column = [cols[0], cols[0], cols[1] + lanes[2], cols[1] + lanes[2], cols[1], cols[1]]
        keep = rng.random(6) < (0.9 if rng.random() < 0.7 else 0.5)
        keep[[0, 5]] = True
        last = int(keep.sum()) - 1
        row, column = np.array(row)[keep], np.array(column)[keep]
        off = [np.full(len(one), last) for one in (rows[0], cols[0])]
        if rng.random() < 0.3:  # rows go off one after the other
            aside = rng.choice([-0.5, 0.0, 0.5], (2, len(cols[0])))
            row = np.concatenate([row, row[-1:] + rng.choice([0, 0, 0.5]), row[-1:]])
            column = np.concatenate([column, column[-1:] + aside[:1], column[-1:]])
            off[0], off[1] = (rng.integers(last, last + 3, len(one)) for one in off)
            off[0][0] = off[1][-1] = last + 2
        if rng.random() < 0.3:
            path = (row, column)[int(rng.integers(2))]
            path[tuple(rng.integers(path.shape))] += rng.choice([-1, -0.5, 0.25, 0.5, 1])
        return TonePaths(row, column, *off)

    def ends(self, n_sites: int, n: int) -> Any:
        """Where tones start and end, in order; now and then beyond the grid."""
        slots = self.motion.eject_slots if self.rng.random() < 0.15 else 0
        n = min(n, n_sites)
        start = np.sort(self.rng.choice(n_sites, n, replace=False)).astype(float)
        end = np.sort(self.rng.choice(np.arange(-slots, n_sites + slots), n, replace=False)).astype(float)
        return start, end


def compare(seed: int) -> str:
    """ "accepted" or the rule that both checkers find broken; fails where they differ."""
    draw = RandomPaths(seed)
    plan = draw.plan()
    expected = naive(plan, draw.atoms, 20, draw.motion, draw.grid)
    try:
        report = check_plan(plan, draw.atoms, TargetPattern.none(draw.grid.shape), 20, draw.grid, draw.motion)
    except InvalidPlanError as error:
        assert expected is None, f"{seed}: legal, but: {error}"
        return error.rule
    assert expected is not None, f"{seed}: illegal, but accepted"
    atoms, ends, n_tweezers = expected
    assert {(int(r), int(c)) for r, c in np.argwhere(report.predicted)} == atoms
    assert report.batch_end_s == pytest.approx(ends)
    assert report.n_tweezers.tolist() == n_tweezers
    return "accepted"


def test_random_paths() -> None:
    verdicts = Counter(map(compare, range(300)))
    assert verdicts["accepted"] > 50, verdicts
    assert len(verdicts) >= 8, verdicts
