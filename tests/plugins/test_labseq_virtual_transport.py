"""The effect of a tone program on the atoms: where they end, and what they are lost by."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_virtual.atoms import Atoms
from labseq_virtual.flight import Conditions, Flights, RunningProgram
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.tone_positions import FrequencyMap, TonePositions
from numpy.typing import NDArray

from labseq import Batch, LimitError, MotionSpec, Plan, SiteGrid, check_plan, tone_program
from labseq.model import ToneProgram
from labseq.model.motion import SpeedProfile
from labseq.plugin.geometry import pattern
from labseq.testing.fakes import OneByOnePlanner

from .rf import ON, PROGRAM_GRID as GRID, ToneProgramBuilder

PLANE = SiteGrid(5, 6)
Tone2 = tuple[float, float]
"""Place of a tone at the start and at the end, in sites."""
Sites = set[tuple[int, int]]


@pytest.mark.parametrize("sign", [1, -1])
def test_frequencies_may_rise_or_fall_and_go_on_beyond_the_grid(sign: int) -> None:
    hz = 100e6 + sign * np.array([0.0, 1.0, 2.1]) * 1e6
    places = FrequencyMap(hz, 1e6, "row").sites(100e6 + sign * np.array([-1.0, 0.5, 1.0, 2.1, 3.2]) * 1e6)
    np.testing.assert_allclose(places, [-1.0, 0.5, 1.0, 2.0, 3.0])


def test_frequencies_out_of_order_are_refused() -> None:
    with pytest.raises(LimitError, match="column frequencies"):
        FrequencyMap(np.array([1.0, 3.0, 2.0]), 1.0, "column")


def test_a_grid_of_one_site_takes_the_usual_step() -> None:
    lone = FrequencyMap(np.array([100e6]), 1.6e6, "row")
    np.testing.assert_allclose(lone.sites(np.array([98.4e6, 101.6e6])), [-1.0, 1.0])


def test_errors_of_the_tweezers_places_are_what_the_settings_say() -> None:
    light = SimulationSettings.model_validate(
        {"mobile_light": {"offset": [0.3e-6, -0.2e-6], "magnification_error": 0.01}}
    ).mobile_light
    places = TonePositions(PLANE, light)
    for axis, (offset_m, hz) in enumerate(
        [(-0.2e-6, PLANE.row_frequency_hz), (0.3e-6, PLANE.column_frequency_hz)]
    ):
        n = len(hz)
        expected = np.arange(n) + offset_m / PLANE.spacing_m + 0.01 * (np.arange(n) - (n - 1) / 2)
        np.testing.assert_allclose(places.actual(axis, hz), expected)
        np.testing.assert_allclose(places.intended(axis, hz), np.arange(n))


def test_tones_have_errors_of_their_own_that_belong_to_the_machine() -> None:
    light = SimulationSettings.model_validate({"mobile_light": {"tone_error": 0.1e-6}}).mobile_light
    grid = SiteGrid(60, 80, row_frequency_hz=np.arange(1.0, 61.0), column_frequency_hz=np.arange(1.0, 81.0))
    places = TonePositions(grid, light)
    errors: list[NDArray[np.float64]] = []
    for _ in range(2):
        places.draw(np.random.default_rng(5))
        errors.append(places.actual(1, grid.column_frequency_hz) - np.arange(80))
    np.testing.assert_array_equal(errors[0], errors[1])
    assert errors[0].std() * grid.spacing_m == pytest.approx(0.1e-6, rel=0.3)


QUIET = {"transport_loss": 0.0, "temperature": 1e-6, "pair_survival": 0.0}


def atoms(*sites: tuple[int, int], grid: SiteGrid = GRID) -> NDArray[np.bool_]:
    occupied = np.zeros(grid.shape, np.bool_)
    for site in sites:
        occupied[site] = True
    return occupied


def carry(
    held: Atoms,
    program: ToneProgram,
    settings: SimulationSettings,
    until_s: float = math.inf,
    seed: int = 0,
    grid: SiteGrid = GRID,
    conditions: Conditions = Conditions(),  # noqa: B008
) -> Counter[str]:
    """Move atoms by a program, to its end or a time; the losses."""
    flights, rng = Flights(grid, MotionSpec(), settings), np.random.default_rng(seed)
    running = RunningProgram(program, 0.0)
    return flights.carry_program(held, running, np.ones(grid.shape), rng, conditions, until_s)


def after(
    tape: ToneProgramBuilder, *sites: tuple[int, int], until_s: float = math.inf, **physics: Any
) -> set[tuple[int, int]]:
    """Where the atoms are after a program."""
    occupied = atoms(*sites, grid=tape.grid)
    settings = SimulationSettings.model_validate(QUIET | physics)
    carry(Atoms(occupied, settings.temperature), tape.program(), settings, until_s, grid=tape.grid)
    return {(int(r), int(c)) for r, c in np.argwhere(occupied)}


def start(rows: list[float], cols: list[float]) -> ToneProgramBuilder:
    """Row tones on, column tones rising from 0 to full amplitude."""
    return ToneProgramBuilder().add([(r, r, ON, ON) for r in rows], [(c, c, 0.0, ON) for c in cols])


def move(rows: Sequence[Tone2], cols: Sequence[Tone2]) -> ToneProgramBuilder:
    return ToneProgramBuilder().move(rows, cols)


R0, C0 = [(0, 0, ON, ON)], [(0, 0, 0.0, ON)]
CREEP = start([0], [0])  # small jumps, never a sweep
for place in (0.2, 0.4, 0.6, 0.8):
    CREEP.add(R0, [(place, place, ON, ON)])
CREEP.add(R0, [(1, 1, ON, 0.0)])
CORNER = start([0], [0]).add(R0, [(0, 3, ON, ON)]).add([(0, 4, ON, ON)], [(3, 3, ON, ON)])
CORNER.add([(4, 4, ON, 0.0)], [(3, 3, ON, ON)])
REORDERED = start([0], [0, 3]).add([(0, 0, ON, 0.0)], [(3, 3, ON, ON), (0, 0, ON, ON)])
DARK = start([0], [0]).add(R0, [(0, 2, ON, ON), (0.0, 5.0, 0.0, 0.0)]).add(R0, [(2, 2, ON, 0.0)])
SPLIT = start([0], [2]).add(R0, [(1.75, 1.2, ON, ON), (2.25, 2.8, ON, ON)])
SPLIT.add(R0, [(1.2, 1.2, ON, 0.0), (2.8, 2.8, ON, 0.0)])
FROM_0 = [(0, 0)]

RULES: list[tuple[str, ToneProgramBuilder, Sites, Sites]] = [
    ("a line shifts by one", move([(2, 2)], [(0, 1), (1, 2), (2, 3)]),
        {(2, 0), (2, 1), (2, 2)}, {(2, 1), (2, 2), (2, 3)}),
    ("rows and columns make a block of tweezers", move([(0, 0), (1, 1)], [(0, 2), (1, 3)]),
        {(0, 0), (0, 1), (1, 0), (1, 1)}, {(0, 2), (0, 3), (1, 2), (1, 3)}),
    ("a tweezer without an atom moves nothing", move(FROM_0, [(0, 3), (1, 4)]),
        {(0, 1), (3, 3)}, {(0, 4), (3, 3)}),
    ("set down between sites", move(FROM_0, [(0, 2.45)]), {(0, 0)}, set()),
    ("set down near a site", move(FROM_0, [(0, 2.2)]), {(0, 0)}, {(0, 2)}),
    ("ejected to the left", move([(2, 2)], [(0, -1)]), {(2, 0), (4, 5)}, {(4, 5)}),
    ("ejected to the right", move([(2, 2)], [(0, 6)]), {(2, 0), (4, 5)}, {(4, 5)}),
    ("ejected upwards", move([(2, -1)], FROM_0), {(2, 0), (4, 5)}, {(4, 5)}),
    ("ejected downwards", move([(2, 5)], FROM_0), {(2, 0), (4, 5)}, {(4, 5)}),
    ("only the outermost atom is ejected", move([(2, 2)], [(0, -1), (1, 0)]),
        {(2, 0), (2, 1), (2, 2)}, {(2, 0), (2, 2)}),
    ("two atoms on one site", move(FROM_0, [(0, 3)]), {(0, 0), (0, 3), (1, 3)}, {(1, 3)}),
    ("small jumps keep the atom", CREEP, {(0, 0)}, {(0, 1)}),
    ("two atoms on one site without a sweep", CREEP, {(0, 0), (0, 1)}, set()),
    ("an atom in the way costs the first tweezer's atom", move(FROM_0, [(0, 4), (1, 5)]),
        {(0, 0), (0, 1), (0, 3)}, {(0, 4)}),
    ("an empty tweezer throws out the atom in its way", move(FROM_0, [(0, 4)]), {(0, 2), (1, 2)}, {(1, 2)}),
    ("the first loaded tweezer is lost wherever it hits", move(FROM_0, [(1, 4), (2, 5)]),
        {(0, 1), (0, 2), (0, 3), (0, 4)}, {(0, 4)}),
    ("an unintended crossing takes its atom along", move([(0, 0), (3, 3)], [(0, 1), (4, 5)]),
        {(0, 0), (3, 4), (3, 0)}, {(0, 1), (3, 5), (3, 1)}),
    ("a diagonal move passes atoms beside its line", move([(0, 2)], [(0, 2)]),
        {(0, 0), (1, 0), (0, 1)}, {(2, 2), (1, 0), (0, 1)}),
    ("a diagonal move hits atoms on its line", move([(0, 2)], [(0, 2)]), {(0, 0), (1, 1)}, set()),
    ("tweezers that stay on turn a corner", CORNER, {(0, 0), (2, 2)}, {(4, 3), (2, 2)}),
    ("a tone that goes out between sites",
        start([0], [0]).add(R0, [(0, 1.5, ON, ON)]).add(R0, [(1.5, 3, 0.0, ON)]), {(0, 0)}, set()),
    ("tones may change their order in the list", REORDERED, {(0, 0), (1, 1)}, {(0, 0), (1, 1)}),
    ("a pause needs no tones", move(FROM_0, [(0, 2)]).add([], []).move(FROM_0, [(2, 3)]), {(0, 0)}, {(0, 3)}),
    ("tones that pass", move(FROM_0, [(0, 3), (3, 0), (5, 5)]), {(0, 0), (0, 3), (0, 5)}, {(0, 5)}),
    ("tones that come close", move(FROM_0, [(0, 1.9), (3, 2.3), (5, 5)]), {(0, 0), (0, 3), (0, 5)}, {(0, 5)}),
    ("a tone without light disturbs nothing", DARK, {(0, 0), (0, 4)}, {(0, 2), (0, 4)}),
    ("a tweezer that splits keeps one atom", SPLIT, {(0, 2)}, {(0, 1)}),
    ("a weak tweezer neither takes nor throws out an atom",
        ToneProgramBuilder().add([(0, 0, 0.3 * ON, 0.3 * ON)], C0).add(
            [(0, 0, 0.3 * ON, 0.3 * ON)], [(0, 3, ON, ON)]
        ), {(0, 0), (0, 2)}, {(0, 0), (0, 2)}),
    ("a grid of two sites", ToneProgramBuilder(SiteGrid(1, 2)).move(FROM_0, [(0, 1)]), {(0, 0)}, {(0, 1)}),
]  # fmt: skip


@pytest.mark.parametrize(
    ("tape", "before", "expected"), [rule[1:] for rule in RULES], ids=[r[0] for r in RULES]
)
def test_rules(tape: ToneProgramBuilder, before: Sites, expected: Sites) -> None:
    assert after(tape, *before) == expected


@pytest.mark.parametrize(("off_by", "taken"), [(0.34, True), (-0.34, True), (0.36, False)])
@pytest.mark.parametrize("axis", ["row", "column"])
def test_a_pick_up_takes_only_wells_that_merge_with_its_own(off_by: float, taken: bool, axis: str) -> None:
    row, col = (2 + off_by, 2.0) if axis == "row" else (2.0, 2 + off_by)
    assert after(start([row], [col]), (2, 2)) == (set() if taken else {(2, 2)})


@pytest.mark.parametrize(("jump", "kept"), [(0.05, True), (0.6, False), (3.0, False)])
def test_a_tone_that_jumps_between_sites_loses_its_atom(jump: float, kept: bool) -> None:
    tape = start([0], [0]).add(R0, [(0, 1.5, ON, ON)]).add(R0, [(1.5 + jump, 2, ON, ON)])
    assert after(tape.add(R0, [(2, 2, ON, 0.0)]), (0, 0)) == ({(0, 2)} if kept else set())


@pytest.mark.parametrize(("way", "kept"), [(2.0, {(0, 2), (4, 4)}), (2.5, {(4, 4)})])
def test_atoms_that_are_held_at_the_end_are_lost_unless_a_site_is_there(way: float, kept: Sites) -> None:
    tape = move(FROM_0, [(0, way)])
    assert after(tape, (0, 0), (4, 4), until_s=2e-3) == kept
    assert after(tape, (0, 0), (4, 4), until_s=0.0) == {(0, 0), (4, 4)}


@pytest.mark.parametrize("profile", ["constant", "minimum_jerk"])
def test_a_program_that_is_cut_short_loses_the_atoms_on_their_way(profile: SpeedProfile) -> None:
    plan = Plan.from_batches([Batch(np.array([(0, 0)]), np.array([(0, 5)]))])
    program = tone_program(plan, grid=PLANE, motion=MotionSpec(speed_profile=profile))
    for until, kept in ((30e-6, 1), (0.5 * program.total_duration_s, 0)):
        held = Atoms(atoms((0, 0), grid=PLANE), 1e-6)
        carry(held, program, SimulationSettings(transport_loss=0.0), until, grid=PLANE)
        assert held.occupied.sum() == kept


@given(st.data())
@settings(max_examples=40)
def test_a_legal_shift_of_a_whole_line_does_exactly_what_it_says(data: st.DataObject) -> None:
    n_cols = GRID.n_cols
    columns = st.lists(st.integers(0, n_cols - 1), min_size=1, max_size=n_cols, unique=True).map(sorted)
    sources = data.draw(columns)
    n = len(sources)
    goals = sorted(data.draw(st.lists(st.integers(-1, n_cols), min_size=n, max_size=n, unique=True)))
    others = data.draw(st.sets(st.tuples(st.sampled_from([0, 1, 3, 4]), st.integers(0, n_cols - 1))))
    tape = ToneProgramBuilder().move([(2, 2)], list(zip(sources, goals, strict=True)))
    expected = others | {(2, c) for c in goals if 0 <= c < n_cols}
    assert after(tape, *others, *((2, c) for c in sources)) == expected


TONES = st.lists(
    st.tuples(st.floats(-2, 7), st.floats(-2, 7), st.sampled_from([0.0, ON]), st.sampled_from([0.0, ON])),
    max_size=3,
)


@given(
    st.lists(st.tuples(TONES, TONES), max_size=5), st.sets(st.tuples(st.integers(0, 4), st.integers(0, 5)))
)
@settings(max_examples=60)
def test_no_program_makes_atoms(segments: list[Any], sites: set[tuple[int, int]]) -> None:
    assert len(after(ToneProgramBuilder(segments=segments), *sites)) <= len(sites)


def test_the_noise_of_the_intensity_heats_in_a_mobile_tweezer_by_its_trap_frequency() -> None:
    """At pi^2 nu^2 S along two of three axes: the deeper the tweezer, the faster."""
    noise_per_hz, heat = 2e-9, dict[int, float]()
    settings = SimulationSettings(transport_loss=0.0, intensity_noise=noise_per_hz)
    for n_ms in (1, 3):
        tape = start([2], [3])
        for _ in range(n_ms):
            tape.add([(2, 2, ON, ON)], [(3, 3, ON, ON)])
        tape.add([(2, 2, ON, ON)], [(3, 3, ON, 0.0)])
        held = Atoms(atoms((2, 3)), 15e-6)
        carry(held, tape.program(), settings, conditions=Conditions(cooled=0.0))
        heat[n_ms] = held.heat[2, 3]
    depth, mass, waist = 2.1e-3 * 1.380649e-23, 86.909 * 1.66054e-27, 0.98e-6
    trap_hz = np.sqrt(4 * depth / mass) / waist / (2 * np.pi)
    rate_hz = 2 / 3 * np.pi**2 * trap_hz**2 * noise_per_hz
    assert np.log(heat[3] / heat[1]) / 2e-3 == pytest.approx(rate_hz, rel=0.15)


@pytest.mark.parametrize(
    ("tape", "before", "physics", "expected"),
    [
        (move(FROM_0, [(0, 2)]), {(0, 0)}, {"transport_loss": 1.0}, {"hand_over": 1}),
        (move(FROM_0, [(0, 2)]), {(4, 4), (0, 5)}, {"transport_loss": 1.0}, {}),
        (move(FROM_0, [(0, 2)]), {(0, 0)}, {}, {}),
        (move(FROM_0, [(0, -1)]), {(0, 0)}, {}, {"ejected": 1}),
        (move(FROM_0, [(0, 3)]), {(0, 0), (0, 3)}, {}, {"collision": 2}),
        (move(FROM_0, [(0, 3)]), {(0, 0), (0, 1)}, {}, {"collision": 2}),
        (move(FROM_0, [(0, 3), (3, 0)]), {(0, 0), (0, 3)}, {}, {"collision": 2}),
        (start([0], [0]).add(R0, [(0, 1.5, ON, ON)]), {(0, 0)}, {}, {"program": 1}),
        (start([0], [0]).add(R0, [(0, 1.5, ON, ON)]).add([], []), {(0, 0)}, {}, {"program": 1}),
    ],
)
def test_every_loss_has_its_cause(
    tape: ToneProgramBuilder, before: Sites, physics: dict[str, Any], expected: dict[str, int]
) -> None:
    settings = SimulationSettings.model_validate(QUIET | physics)
    occupied = atoms(*before)
    lost = carry(Atoms(occupied, settings.temperature), tape.program(), settings)
    assert lost == expected
    assert occupied.sum() == len(before) - sum(lost.values())


PROFILES = pytest.mark.parametrize("profile", ["constant", "minimum_jerk", "constant_jerk"])


def carried(plan: Plan, occupied: NDArray[np.bool_], profile: SpeedProfile = "constant") -> NDArray[np.bool_]:
    program = tone_program(plan, grid=PLANE, motion=MotionSpec(speed_profile=profile))
    result = occupied.copy()
    carry(Atoms(result, 15e-6), program, SimulationSettings(transport_loss=0.0), grid=PLANE)
    return result


@PROFILES
@pytest.mark.parametrize("seed", range(3))
def test_a_checked_plan_does_what_the_check_predicts(seed: int, profile: SpeedProfile) -> None:
    occupied = np.random.default_rng(seed).random(PLANE.shape) < 0.6
    target = pattern(np.array([[1, 0, 1], [0, 1, 0], [1, 0, 1]], np.bool_), PLANE)
    plan = OneByOnePlanner().plan(occupied, target)
    predicted = check_plan(plan, occupied, target, 1, grid=PLANE).predicted
    assert plan.n_batches > 0
    np.testing.assert_array_equal(carried(plan, occupied, profile), predicted)


@PROFILES
def test_ejection_parallel_moves_and_linked_batches_do_what_the_check_predicts(profile: SpeedProfile) -> None:
    occupied = np.zeros(PLANE.shape, np.bool_)
    for site in ((1, 0), (1, 1), (1, 2), (4, 4), (4, 5), (0, 3)):
        occupied[site] = True
    plan = Plan.from_batches(
        [
            Batch(np.array([(1, 0), (1, 1)], np.int16), np.array([(1, -1), (1, 0)], np.int16)),
            Batch(np.array([(4, 4)], np.int16), np.array([(4, 1)], np.int16)),
            Batch(np.array([(4, 1)], np.int16), np.array([(2, 1)], np.int16), linked=True),
        ]
    )
    target = pattern(np.ones((1, 1), np.bool_), PLANE)
    predicted = check_plan(plan, occupied, target, 2, grid=PLANE).predicted
    after_plan = carried(plan, occupied, profile)
    np.testing.assert_array_equal(after_plan, predicted)
    assert after_plan[2, 1]
    assert after_plan.sum() == 5
