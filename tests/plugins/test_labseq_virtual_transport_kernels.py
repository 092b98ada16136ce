"""The kernels of the transport against a naive version in numpy, integrals and brute force."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, event, given, settings, strategies as st
from labseq_virtual import tweezer_kernels as kernels
from labseq_virtual.atoms import Atoms
from labseq_virtual.handover import merging_distance, pair_survival
from labseq_virtual.response_kernels import at_once, carry, hand_over, land_on, pass_by
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.transport import Transport
from labseq_virtual.transport_kernels import AT_REST, MIXING, TOLERANCE, max_drop_offs, one_left
from labseq_virtual.tweezer_kernels import EMPTY, HELD, Constants, constants
from numpy.typing import NDArray
from scipy.special import ndtr

from labseq import MotionSpec, SiteGrid, ToneProgram
from tests.docs.scripts import load_script

from .naive_moves import NaiveMoves
from .rf import ON, ToneProgramBuilder

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
GRID = SiteGrid(5, 6)


def count(mask: Mask) -> int:
    return int(np.count_nonzero(mask))


def crossings(row: Any, col: Any, column: str) -> Any:
    """A product of row tones and column tones, (n_row_tones, n_column_tones)."""
    return 1.0 * row[column][:, None] * col[column]


def _followed(away: Floats, tolerance: float) -> Mask:
    """Which tones go on from the segment before: of several with the same nearest one, only the nearest."""
    nearest, least = away.argmin(axis=1), away.min(axis=1)
    best = [int(np.argmin(np.where(nearest == other, least, np.inf))) for other in nearest]
    return (least <= tolerance) & (np.array(best, np.int64) == np.arange(len(nearest)))


@dataclass
class Before:
    """The crossings at the end of the segment before."""

    row: Any
    col: Any
    lit: Mask
    loaded: Mask
    fresh: Mask
    course: Any


class NaiveTransport:
    """The rules of ``transport.py``, without any short cut and without a kernel."""

    def __init__(self, transport: Transport, settings: SimulationSettings, draws: Floats) -> None:
        self.transport, self.settings, self.draws = transport, settings, draws
        self.moves = NaiveMoves(settings, GRID.spacing_m)
        self.thermal = np.stack([np.full(GRID.shape, settings.temperature), np.zeros(GRID.shape)])
        self.hazards = np.zeros(GRID.shape)
        self.now_s, self.n_drawn = 0.0, 0
        self.lost: Counter[str] = Counter()

    def carry(
        self, occupied: Mask, program: ToneProgram, n_segments: int, depth: Floats, factor: float
    ) -> Counter[str]:
        self.occupied, self.depth, self.factor = occupied, depth * self.settings.static_depth, factor
        before: Before | None = None
        rows, cols = ([*self._segments(program, axis)][:n_segments] for axis in (0, 1))
        for k, (row, col) in enumerate(zip(rows, cols, strict=True)):
            before = self._segment(before, row, col, float(program.duration_s[k]), int(program.course[k]))
            self.now_s += float(program.duration_s[k])
        self.lost["program"] += 0 if before is None else count(before.loaded)
        if self.hazards.any():
            offsets = program.row.offsets, program.column.offsets
            tones = self.transport._tones(program, 0), self.transport._tones(program, 1)
            first = 3 * max_drop_offs(tones[0], offsets[0], tones[1], offsets[1], n_segments)
            draws = self.draws.ravel()[first : first + occupied.size].reshape(occupied.shape)
            taken = occupied & (draws < 1 - np.exp(-self.hazards))
            self.lost["collision"] += count(taken)
            occupied &= ~taken
        return +self.lost

    def _segments(self, program: ToneProgram, axis: int) -> list[Any]:
        tones = self.transport._tones(program, axis)
        offsets = (program.row, program.column)[axis].offsets
        return [tones[first:last] for first, last in pairwise(offsets)]

    def _segment(
        self, before: Before | None, row: Any, col: Any, duration_s: float, kind: int
    ) -> Before | None:
        lit_start, lit_end = crossings(row, col, "on_start") > 0, crossings(row, col, "on_end") > 0
        lit = lit_start | lit_end
        self.lost["program"] += 0 if before is None else count(before.loaded)
        if not lit.any():
            return None
        further = sum(count(tones["on_start"] | tones["on_end"]) for tones in (row, col)) - 2
        on, loaded, fresh, course = self._continued(before, row, col)
        goes_on = on & lit_start
        loaded, fresh = loaded & lit_start, (fresh & goes_on) | (lit & ~goes_on)
        course[~goes_on] = np.zeros(1, kernels.TWEEZER)[0]
        self.lost["program"] -= count(loaded)
        start, end = crossings(row, col, "power_start"), crossings(row, col, "power_end")
        power = np.maximum(start, end)
        depth = self.moves.mobile_depth(power, further)
        taken = self._picked_up(fresh, depth, course, row, col)
        fresh &= ~taken & (start < 0.7 * end)
        loaded |= taken
        mixed = self._mixed(row)[:, None] | self._mixed(col)
        self.lost["collision"] += count(loaded & mixed)
        loaded &= ~mixed
        down, right = (row["end"] - row["start"])[:, None], (col["end"] - col["start"])[None, :]
        if (np.abs(down) > AT_REST).any() or (np.abs(right) > AT_REST).any():
            self._sweep(lit & (depth > self.settings.static_depth), loaded, course, row, col)
        self._pass(lit, loaded, course, depth, row, col, duration_s)
        course["state"], course["depth"] = np.where(loaded, HELD, EMPTY), depth
        for i, j in np.argwhere(lit):
            way = float(down[i, 0]), float(right[0, j])
            self.moves.advance(course[i, j], (start[i, j], end[i, j]), way, duration_s, kind, further)
        self._land(lit & ~loaded & ~lit_end, course, row, col, duration_s)
        self._set_down(loaded & ~lit_end, course, row, col, further, duration_s)
        return Before(row, col, lit_end, loaded & lit_end, fresh, course)

    def _continued(self, before: Before | None, row: Any, col: Any) -> tuple[Mask, Mask, Mask, Any]:
        if before is None:
            dark = np.zeros((len(row), len(col)), np.bool_)
            return dark, dark.copy(), dark.copy(), np.zeros(dark.shape, kernels.TWEEZER)
        pairs = (row, before.row), (col, before.col)
        away: list[Any] = [np.abs(now["start"][:, None] - then["end"]) for now, then in pairs]
        source: Any = np.ix_(*(each.argmin(axis=1) for each in away))
        close: Any = np.logical_and.outer(*(_followed(each, TOLERANCE) for each in away))
        old: Any = before.lit, before.loaded, before.fresh
        lit, loaded, fresh = (mask[source] & close for mask in old)
        return lit, loaded, fresh, before.course[source]

    def _nearest(self, row: Any, col: Any) -> Any:
        r, c = np.rint(row), np.rint(col)
        down, right = row - r, col - c
        a1, a2 = GRID.axes
        square = (down**2 + right**2) * GRID.spacing_m**2 + down * right * 2 * float(a1 @ a2)
        inside = (r >= 0) & (r < GRID.n_rows) & (c >= 0) & (c < GRID.n_cols)
        r, c = np.clip(r, 0, GRID.n_rows - 1), np.clip(c, 0, GRID.n_cols - 1)
        return r.astype(int), c.astype(int), np.sqrt(square), inside

    def _picked_up(self, new: Mask, depth: Any, course: Any, row: Any, col: Any) -> Mask:
        r, c, away_m, inside = self._nearest(
            *np.broadcast_arrays(row["start"][:, None], col["start"][None, :])
        )
        taken = new & inside & self.occupied[r, c]
        for i, j in np.argwhere(taken):
            site = r[i, j], c[i, j]
            static = float(self.depth[site])
            taken[i, j] = self.occupied[site] and self.moves.takes(depth[i, j], static, away_m[i, j])
            self.occupied[site] &= not taken[i, j]
            if taken[i, j]:
                waited_s = self.now_s - self.thermal[1][site]
                heat = self.moves.relaxed(self.thermal[0][site], waited_s)
                tweezer = course[i, j]
                tweezer.site_depth, tweezer.away, tweezer.heat = static, away_m[i, j], heat
                course[i, j].is_picked = False
                course[i, j].lost = 1 - np.exp(-self.hazards[site])
                self.hazards[site] = 0.0
        return taken

    def _pass(
        self, lit: Mask, loaded: Mask, course: Any, depth: Any, row: Any, col: Any, duration_s: float
    ) -> None:
        """Tweezers pass atoms where they are nearest to them: on the way, or where they stop or turn away."""
        a1, a2 = GRID.axes
        for i, j in np.argwhere(lit):
            start, end = (row[i][at] * a2 + col[j][at] * a1 for at in ("start", "end"))
            was = course[i, j].down_hz * a2 + course[i, j].right_hz * a1
            way = end - start
            for r, c in np.argwhere(self.occupied):
                to = r * a2 + c * a1 - start
                part = float(to @ way / (way @ way)) if way.any() else 0.0
                if part >= 1 or (part <= 0 and not (to @ was > 0 or (way.any() and not was.any()))):
                    continue
                away_m = float(np.linalg.norm(to - max(part, 0.0) * way))
                if not TOLERANCE * GRID.spacing_m < away_m < 3.1 * WAIST_M:
                    continue
                waited_s = self.now_s - self.thermal[1, r, c]
                heat = self.moves.relaxed(self.thermal[0, r, c], waited_s)
                speed = float(np.linalg.norm(way)) / duration_s
                static = float(self.depth[r, c])
                loss, warmer = self.moves.pass_by(static, depth[i, j], speed, away_m, heat)
                self.thermal[:, r, c] = heat * warmer, self.now_s
                self.hazards[r, c] -= np.log1p(-min(loss, 1 - 1e-9))
                if loaded[i, j]:
                    course[i, j].lost = 1 - (1 - course[i, j].lost) * (1 - loss)

    def _mixed(self, tones: Any) -> Any:
        on = tones["on_start"] | tones["on_end"]
        before, after = (tones[at][:, None] - tones[at] for at in ("start", "end"))
        near = (np.abs(before) < MIXING) | (np.abs(after) < MIXING) | (before * after < 0)
        near &= on[:, None] & on & ~np.eye(len(tones), dtype=np.bool_)
        return near.any(axis=1)

    def _sweep(self, strong: Mask, loaded: Mask, course: Any, row: Any, col: Any) -> None:
        row_step, col_step = row["end"] - row["start"], col["end"] - col["start"]
        i, j = np.nonzero(strong & ((np.abs(row_step) > AT_REST)[:, None] | (np.abs(col_step) > AT_REST)))
        r, c = np.nonzero(self.occupied)
        if len(i) == 0 or len(r) == 0:
            return
        down, right = row_step[i, None], col_step[j, None]  # (n_crossings, 1), against (n_atoms,)
        to_r, to_c = r - row[i]["start"][:, None], c - col[j]["start"][:, None]
        when = np.clip((to_r * down + to_c * right) / (down**2 + right**2), 0.0, 1.0)
        miss = (to_r - when * down) ** 2 + (to_c - when * right) ** 2
        assume(not (abs(miss - TOLERANCE**2) < 1e-9).any())  # both are right: rounding decides
        hit: Any = miss <= TOLERANCE**2
        hit &= (to_r - down) ** 2 + (to_c - right) ** 2 > TOLERANCE**2
        struck = hit.any(axis=0)
        first = np.unique(np.where(hit, when, np.inf).argmin(axis=0)[struck])
        self.lost["collision"] += count(struck)
        pairs = pair_survival(self.settings)
        if pairs == 0:
            self.lost["collision"] += count(loaded[i[first], j[first]])
            loaded[i[first], j[first]] = False
        for k in np.argmin(np.where(hit, when, np.inf), axis=0)[struck]:
            if loaded[i[k], j[k]]:
                course[i[k], j[k]].lost = 1 - (1 - course[i[k], j[k]].lost) * pairs
        self.occupied[r[struck], c[struck]] = False

    def _land(self, empty: Mask, course: Any, row: Any, col: Any, duration_s: float) -> None:
        now_s = self.now_s + duration_s
        for i, j in np.argwhere(empty):
            r, c, away_m, inside = (each[()] for each in self._nearest(row[i]["end"], col[j]["end"]))
            if not (inside and self.occupied[r, c] and course[i, j].speed > 0):
                continue
            if away_m > TOLERANCE * GRID.spacing_m:
                continue
            peak, speed, fall_s = course[i, j].peak, course[i, j].speed, course[i, j].fall_s
            heat = self.moves.relaxed(self.thermal[0, r, c], now_s - self.thermal[1, r, c])
            static = float(self.depth[r, c])
            loss, warmer = self.moves.land_on(static, peak, speed, fall_s, heat)
            self.thermal[:, r, c] = heat * warmer, now_s
            self.hazards[r, c] -= np.log1p(-min(loss, 1 - 1e-9))

    def _set_down(
        self,
        dropping: Mask,
        course: Any,
        row: Any,
        col: Any,
        further: int,
        duration_s: float,
    ) -> None:
        i, j = np.nonzero(dropping)
        r, c, away_m, inside = self._nearest(row[i]["end"], col[j]["end"])
        args = zip(self.depth[r, c], course[i, j], away_m, strict=True)
        found = [self.moves.risks(*one, further, self.factor) for one in args]
        risks, heat = np.array(found).reshape(-1, 4)[:, :3], np.array(found).reshape(-1, 4)[:, 3]
        draws = self.draws[self.n_drawn : self.n_drawn + len(i)]
        self.n_drawn += len(i)
        unlucky = draws < risks
        fallen = unlucky[:, 0] | unlucky[:, 1]
        dropped = unlucky[:, 2] & ~fallen
        stays = inside & ~fallen & ~dropped
        self.thermal[0, r[stays], c[stays]] = heat[stays]
        self.thermal[1, r[stays], c[stays]] = self.now_s + duration_s
        self.hazards[r[stays], c[stays]] = 0.0
        n_atoms, luck = self.occupied.astype(int), np.zeros(GRID.shape)
        np.add.at(n_atoms, (r[stays], c[stays]), 1)
        for k in np.flatnonzero(stays)[::-1]:  # that of the first atom that arrives counts
            luck[r[k], c[k]] = (draws[k, 2] - risks[k, 2]) / (1 - risks[k, 2])
        kept = (n_atoms > 0) & (luck < np.vectorize(self._one_left)(n_atoms))
        self.lost.update(
            ejected=count(~inside),
            hand_over=count(inside & fallen),
            transport=count(inside & dropped),
            collision=int(n_atoms.sum()) - count(kept),
        )
        self.occupied[...] = kept

    def _one_left(self, n: int) -> float:
        """A collision takes one of two atoms, with ``pair_survival``, or both, until at most one is left."""
        if n < 2:
            return float(n)
        p = pair_survival(self.settings)
        return p * self._one_left(n - 1) + (1 - p) * self._one_left(n - 2)


PLACES = st.one_of(st.integers(-4, 24).map(lambda n: n / 4), st.floats(-1.5, 6.5))
SITES = st.sampled_from([*range(6)] * 5 + [0.1, 1.3, 1.7, 2.34, 2.64, 3.36])
STEPS = st.sampled_from([0, 0, 1, 1, -1, 2, -2, 0.9, 0.5])
LEVELS = st.sampled_from([ON, 1.3 * ON, 0.6 * ON, 0.4 * ON, 5e-4, 0.0])
JUMPS = st.sampled_from([0.0, 0.1, 0.2, 0.25, -0.3])
CHAOS = st.lists(st.tuples(PLACES, PLACES, LEVELS, LEVELS), min_size=1, max_size=3)
SELDOM = st.sampled_from([False] * 7 + [True])
Tones = list[tuple[float, float, float, float]]


@st.composite
def legs(draw: st.DrawFn, places: list[float]) -> Tones:
    """Tones of an axis that go on from some places: mostly as they should."""
    goals = [place + draw(STEPS) for place in places]
    if draw(SELDOM):
        goals = [draw(PLACES) for _ in places]
    tones = [(place, goal, ON, ON) for place, goal in zip(places, goals, strict=True)]
    if draw(SELDOM):
        tones = [(a + draw(JUMPS), b, draw(LEVELS), draw(LEVELS)) for a, b, _, _ in tones]
    if draw(SELDOM):
        tones = draw(st.permutations(tones))[: draw(st.integers(1, 3))]
    return tones


@st.composite
def strokes(draw: st.DrawFn) -> list[tuple[Tones, Tones]]:
    """Pick-up, one or two ways, drop-off."""
    axes = [sorted(draw(st.lists(SITES, min_size=1, max_size=most, unique=True))) for most in (2, 3)]
    rows, cols = axes
    segments: list[tuple[Tones, Tones]] = [([(x, x, ON, ON) for x in rows], [(x, x, 0.0, ON) for x in cols])]
    for _ in range(draw(st.integers(1, 2))):
        segments.append((draw(legs(rows)), draw(legs(cols))))
        rows, cols = ([goal for _, goal, _, _ in tones] for tones in segments[-1])
    return [*segments, ([(x, x, ON, ON) for x in rows], [(x, x, ON, 0.0) for x in cols])]


PARTS = st.one_of(strokes(), strokes(), strokes(), st.tuples(CHAOS, CHAOS).map(lambda pair: [pair]))
PROGRAMS = st.lists(PARTS, min_size=1, max_size=4)
PHYSICS = st.fixed_dictionaries(
    {
        "transport_loss": st.sampled_from([0.0, 0.3]),
        "transport_loss_per_tone": st.sampled_from([0.0, 0.05]),
        "temperature": st.sampled_from([1e-6, 60e-6]),
        "pair_survival": st.sampled_from([None, 0.0, 0.4]),
        "mobile_light": st.fixed_dictionaries(
            {
                "adiabatic_depth": st.sampled_from([0.0, 1e-3, 3e-3]),
                "shallow_loss": st.just(0.7),
                "intermodulation": st.sampled_from([0.0, 0.05]),
                "depth_drop_per_tone": st.sampled_from([0.0, 0.05]),
                "offset": st.sampled_from([(0.0, 0.0), (0.5e-6, -0.3e-6)]),
            }
        ),
    }
)


@given(PROGRAMS, PHYSICS, st.sampled_from([0.1, 0.4, 1.0]), st.sampled_from([1e-5, 1e-4, 1e-3]), st.data())
@settings(max_examples=60)
def test_the_kernels_agree_with_the_naive_transport(
    parts: list[Any], simulation: dict[str, Any], filling: float, segment_s: float, data: st.DataObject
) -> None:
    program = ToneProgramBuilder(GRID, [segment for part in parts for segment in part]).program(segment_s)
    n_segments = program.n_segments
    if data.draw(SELDOM, "cut short"):
        n_segments = data.draw(st.integers(0, n_segments), "segments")
    seed = data.draw(st.integers(0, 2**32 - 1), "seed")
    rng = np.random.default_rng(seed)
    occupied = rng.random(GRID.shape) < filling
    depth = rng.uniform(0.5, 1.5, GRID.shape)
    physics = SimulationSettings.model_validate(simulation)
    transport = Transport(GRID, MotionSpec(), physics)
    naive = NaiveTransport(transport, physics, np.random.default_rng(seed).random((2000, 3)))
    expected, result = occupied.copy(), occupied.copy()
    lost_naively = naive.carry(expected, program, n_segments, depth, 1.3)
    lost = transport.carry(
        Atoms(result, physics.temperature), program, n_segments, depth, np.random.default_rng(seed), 1.3
    )
    for cause in lost:
        event(cause)
    event(f"atoms set down: {min(naive.n_drawn, 3)}")
    np.testing.assert_array_equal(result, expected)
    assert lost == lost_naively
    tones = transport._tones(program, 0), transport._tones(program, 1)
    offsets = program.row.offsets, program.column.offsets
    assert naive.n_drawn <= max_drop_offs(tones[0], offsets[0], tones[1], offsets[1], n_segments)


WAIST_M = 0.98e-6
REACH = np.stack(merging_distance(WAIST_M, WAIST_M))


def constants_of(light: dict[str, Any] | None = None, **simulation: Any) -> Constants:
    return constants(
        SiteGrid(), SimulationSettings.model_validate({**simulation, "mobile_light": light or {}})
    )


@pytest.mark.parametrize("ratio", [0.5, 3.0, 25.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_wells_merge_where_the_middle_minimum_vanishes(ratio: float, side: int) -> None:
    log_ratio, merged_m = merging_distance(WAIST_M, WAIST_M)
    distance_m = float(np.interp(math.log(ratio), log_ratio, merged_m)) * (1 + 0.04 * side)
    x = np.linspace(-1e-6, 4.5e-6, 40_001)
    depth = np.exp(-2 * x**2 / WAIST_M**2) + ratio * np.exp(-2 * (x - distance_m) ** 2 / WAIST_M**2)
    n_minima = np.count_nonzero((depth[1:-1] > depth[:-2]) & (depth[1:-1] > depth[2:]))
    assert n_minima == (1 if side < 0 else 2)


def test_a_mobile_tweezer_takes_only_from_a_shallower_one() -> None:
    taken = [kernels.takes(mobile, 0.3e-3, 0.0, REACH) for mobile in (0.29e-3, 0.3e-3, 0.31e-3)]
    assert taken == [False, False, True]


def course_of(**values: float) -> Any:
    """A tweezer that picked an atom up on a site of nominal depth, by default the paper's."""
    paper = {"peak": 2.1e-3, "rise_s": 60e-6, "fall_s": 60e-6, "site_depth": 300e-6, "heat": 15e-6}
    course = np.zeros(1, kernels.TWEEZER)
    for name, value in (paper | {"state": HELD, "depth": 2.1e-3} | values).items():
        course[name] = value
    return course[0]


def risks(course: Any, static: float = 300e-6, away_m: float = 0.0, **simulation: Any) -> Any:
    physics = constants_of(None, **{"transport_loss": 0.0} | simulation)
    return kernels.risks(static, course, away_m, 5, 1.5, physics)


def test_a_static_tweezer_that_is_off_holds_nothing_back() -> None:
    assert risks(course_of(), static=0.0)[0] == 1.0


SCRIPT = load_script("make_response_tables")
PICK_UP, DROP_OFF, TRANSPORT, LANDING, PASSING, STARTING, STOPPING = range(7)
"""Stages of a move, in the order of the script."""
BETWEEN = [
    (PICK_UP, (30e-6, 0.7, 6.0, 17e-6)),
    (PICK_UP, (6e-6, 1.1, 9.0, 23e-6)),
    (DROP_OFF, (25e-6, 0.5, 6.0, 17e-6)),
    (DROP_OFF, (3e-6, 0.9, 7.0, 15e-6)),
    (DROP_OFF, (60e-6, 1.1, 7.0, 31e-6)),
    (TRANSPORT, (0, 0.13, 7.0, 17e-6)),
    (TRANSPORT, (0, 0.33, 6.0, 17e-6)),
    (TRANSPORT, (0, 0.39, 7.0, 17e-6)),
    (TRANSPORT, (1, 0.12, 6.0, 23e-6)),
    (LANDING, (0.2, 40e-6, 3.0, 23e-6)),
    (PASSING, (0.13, 1.65, 6.5, 33e-6)),
    (PASSING, (0.2, 1.5, 3.5, 28e-6)),
    (STARTING, (2e-6, 0.25, 4.0, 17e-6)),
    (STOPPING, (4e-6, 0.27, 4.5, 20e-6)),
]
"""Arguments of the simulated stages, between the points of the tables."""


@pytest.mark.parametrize(("stage", "args"), BETWEEN)
def test_between_the_points_of_the_tables_atoms_fare_as_newtons_equations_say(stage: int, args: Any) -> None:
    lost, warmer = [*SCRIPT.STAGES.values()][stage](*args, SCRIPT.REFERENCE)
    first, other, ratio, heat = args
    physics, depth_k = constants_of(static_waist=WAIST_M), 300e-6
    mobile_k = ratio * depth_k
    if stage == TRANSPORT:
        found = carry(first, other, 4 * 4.49e-6, mobile_k, heat, physics)
    elif stage == LANDING:
        found = land_on(depth_k, mobile_k, first, other, heat, physics)
    elif stage == PASSING:
        found = pass_by(depth_k, mobile_k, first, other * WAIST_M, heat, physics)
        assert 0.01 < found[0] < 2 * lost < 4 * found[0]
    elif stage in (STARTING, STOPPING):
        found = at_once(stage, mobile_k, other, first, heat, physics)
        assert lost > 0.15
    else:
        found = hand_over(stage, depth_k, mobile_k, other * WAIST_M, first, heat, physics)
        assert found[1] == pytest.approx(warmer, rel=0.25)
    assert found[0] == pytest.approx(lost, abs=0.2 if stage in (TRANSPORT, STARTING, STOPPING) else 0.08)


@pytest.mark.parametrize(
    ("static", "mobile", "lost"), [(300e-6, 2.1e-3, 0.03), (300e-6, 4.2e-3, 0.06), (150e-6, 2.1e-3, 0.06)]
)
def test_the_hand_over_loss_goes_as_the_ratio_of_the_depths(
    static: float, mobile: float, lost: float
) -> None:
    _, hand_over, transport, _ = risks(course_of(peak=mobile), static, transport_loss=0.02)
    assert hand_over == pytest.approx(lost)
    assert transport == 0.0


FIVE_SITES = {"to_col": 5.0, "power_start": 1.0, "power_end": 1.0}


def test_the_move_of_the_paper_loses_nothing_to_heat_and_faster_ones_do() -> None:
    losses: list[float] = []
    for speed_um_ms in (130.0, 160.0, 330.0, 3000.0):
        course, segment_s = course_of(**FIVE_SITES), 5 * 4.49e-3 / speed_um_ms
        kernels.advance(course, segment_s, 0, 5, constants_of())
        course.fall_s = 60e-6
        losses.append(risks(course)[0])
    assert losses[0] == 0.0
    assert losses[1] < 0.02
    assert 0.02 < losses[2] < 0.95
    assert losses[3] == pytest.approx(1.0)


def lost_on_the_way(kind: int = 0, fall_s: float = 60e-6, **before: float) -> float:
    """Fraction of atoms lost in a move at 250 um/ms, with what was before it and a ramp after it."""
    course = course_of(**FIVE_SITES, **before)
    kernels.advance(course, 5 * 4.49e-3 / 250.0, kind, 5, constants_of())
    course.fall_s = fall_s
    return risks(course)[0]


def test_short_ramps_directly_before_a_start_or_after_a_stop_cost_atoms() -> None:
    assert lost_on_the_way() < 0.05
    assert lost_on_the_way(rise_s=1e-6) > 0.3
    assert lost_on_the_way(rise_s=1e-6, rest_s=20e-6) < 0.05
    assert lost_on_the_way(fall_s=1e-6) > 0.2
    assert lost_on_the_way(kind=1, fall_s=1e-6, rise_s=1e-6) < 0.05


@pytest.mark.parametrize("loading", [0.5, 0.75, 0.9])
def test_collisions_leave_one_of_two_atoms_as_often_as_the_loading_says(loading: float) -> None:
    """The loading brings many atoms into a tweezer; each collision takes one or two of them."""
    pairs, rng = pair_survival(SimulationSettings(loading=loading)), np.random.default_rng(3)
    n_atoms = rng.poisson(30, 40_000)
    while (n_atoms > 1).any():
        n_atoms -= np.where(n_atoms > 1, np.where(rng.random(len(n_atoms)) < pairs, 1, 2), 0)
    assert n_atoms.mean() == pytest.approx(loading, abs=0.01)
    assert one_left(1, pairs) == pytest.approx(1.0)
    assert one_left(2, pairs) == pytest.approx(pairs)
    assert (one_left(40, pairs) + one_left(41, pairs)) / 2 == pytest.approx(loading)


def test_more_tones_make_shallower_tweezers() -> None:
    constants_ = constants_of({"depth": 2e-3, "depth_drop_per_tone": 0.1})
    assert kernels.mobile_depth(1.0, 0, constants_) == pytest.approx(2e-3)
    assert kernels.mobile_depth(0.5, 10, constants_) == pytest.approx(0.5e-3)


def test_a_tweezer_below_the_adiabatic_depth_loses_its_atoms_and_the_scatter_softens_the_step() -> None:
    constants_ = constants_of({"adiabatic_depth": 1e-3, "shallow_loss": 0.3, "intermodulation": 0.02})
    depth = np.array([0.9e-3, 0.999e-3, 1e-3, 1.001e-3, 1.1e-3])
    soft = [kernels.shallow(each, 0.13, 19, constants_) for each in depth]
    assert soft == pytest.approx(0.3 * ndtr((1e-3 - depth) / (0.02 * depth)))
    sharp = [kernels.shallow(each, 0.13, 0, constants_) for each in depth]
    assert sharp == pytest.approx([0.3, 0.3, 0.15, 0.0, 0.0])


def test_the_adiabatic_depth_goes_as_the_speed_squared() -> None:
    constants_ = constants_of({"adiabatic_depth": 1e-3, "shallow_loss": 0.3})
    lost = [kernels.shallow(2e-3, speed, 5, constants_) for speed in (0.0, 0.13, 0.19)]
    assert lost == pytest.approx([0.0, 0.0, 0.3], abs=1e-3)
