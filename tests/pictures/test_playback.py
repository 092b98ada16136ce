"""Where tweezers and atoms are in time, against the tones that are played and the rules of plans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.strategies import DataObject

import labseq
from labseq.assembly.occupancies import read_source
from labseq.assembly.planning import PlanRequest, plan_moves
from labseq.data.shot import Shot
from labseq.errors import RecordingError
from labseq.model import Batch, LossSpec, MotionSpec, Occupancy, Plan, PlanReport, SiteGrid, TargetPattern
from labseq.motion import check_plan, tone_program
from labseq.pictures.playback import Playback, play_back, play_back_cycle
from labseq.testing import strategies
from tests.motion.test_survival import ATOMS, GRID, LANDING, TARGET

assert numba  # loaded already, so that no command turns compiling off for the tests after it

ROOT = Path(__file__).parents[2]
MOTION = MotionSpec()


def played(
    plan: Plan, occupancy: Occupancy, grid: SiteGrid, motion: MotionSpec = MOTION
) -> tuple[Playback, PlanReport]:
    nothing = np.zeros_like(occupancy)
    target = TargetPattern(nothing, nothing)
    report = check_plan(plan, occupancy, target, 400, grid, motion)
    return play_back(plan, occupancy, target, grid, motion, report.duration_s), report


def check_ends(playback: Playback, report: PlanReport) -> None:
    """The end of every atom and batch, and the tweezers of every batch, against the check of the plan."""
    assert playback.batch_s[:, 1] == pytest.approx(report.batch_end_s, abs=1e-9)
    after = playback.at(playback.end_s)
    occupied = np.zeros_like(report.predicted)
    places = after.atoms[after.is_there]
    assert np.array_equal(places, places.round())
    occupied[tuple(places.astype(int).T)] = True
    assert np.array_equal(occupied, report.predicted)
    assert len(after.tweezers) == 0
    for (start_s, _), n_tweezers in zip(playback.batch_s, report.n_tweezers, strict=True):
        assert len(playback.at(start_s + 1e-6).tweezers) == n_tweezers


@settings(max_examples=40)
@given(st.data())
def test_atoms_arrive_where_and_when_the_check_says(data: DataObject) -> None:
    before = data.draw(strategies.occupancies())
    plan = data.draw(strategies.plans(before))
    pause_s = data.draw(st.sampled_from([0.0, 1e-4]))
    motion = replace(MOTION, overhead_per_batch_s=pause_s, drop_off_s=data.draw(st.sampled_from([0.0, 6e-5])))
    check_ends(*played(plan, before, SiteGrid(*before.shape), motion))


@pytest.mark.parametrize(("course", "within"), [("constant", 1e-6), ("minimum_jerk", 0.05)])
@pytest.mark.parametrize(("planner", "dop"), [("psca", 7), ("grid", 15)])
def test_tweezers_are_where_the_tones_put_them(planner: str, dop: int, course: Any, within: float) -> None:
    """Against the tones of an AOD whose frequencies fall along the rows."""
    target = "{pattern: compact, rows: 8, cols: 8}"
    moves = plan_moves(PlanRequest("random:12x12@0.7", target, planner, dop, seed=2))
    sites = np.arange(12)
    hz = 91e6 + 1.5e6 * sites, 109e6 - 1.6e6 * sites
    grid = replace(moves.grid, row_frequency_hz=hz[0], column_frequency_hz=hz[1])
    motion = replace(moves.motion, speed_profile=course, path_depth=0.8)
    playback, report = played(moves.plan, moves.occupancy, grid, motion)
    check_ends(playback, report)
    program = tone_program(moves.plan, grid, motion)
    assert program.total_duration_s == pytest.approx(playback.end_s - playback.start_s)
    for t_s in np.random.default_rng(3).uniform(0.0, program.total_duration_s, 200):
        frame, tones = playback.at(playback.start_s + t_s), program.tones_at(t_s)
        for shown, now, site_hz, most in (
            (frame.rows, tones.row, hz[0], motion.max_row_tones),
            (frame.columns, tones.column, hz[1], motion.max_column_tones),
        ):
            place = (now.frequency_hz - site_hz[0]) / (site_hz[1] - site_hz[0])
            depth = (now.amplitude * most) ** 2
            order, expected = np.argsort(shown[:, 0]), np.argsort(place)
            assert shown[order, 0] == pytest.approx(place[expected], abs=within)
            assert shown[order, 1] == pytest.approx(depth[expected], abs=1e-6)


def test_atoms_turn_with_linked_batches_and_leave_the_grid() -> None:
    """A turn without a drop-off: no tone goes off between the two batches."""
    before = np.zeros((4, 5), np.bool_)
    before[0, 1] = before[3, 0] = True
    starts, goals = np.array([[(0, 1)], [(0, 3)], [(3, 0)]], np.int16), [(0, 3), (2, 3), (3, -1)]
    batches = [
        Batch(start, np.array([goal], np.int16), linked=i == 1)
        for i, (start, goal) in enumerate(zip(starts, goals, strict=True))
    ]
    playback, report = played(Plan.from_batches(batches), before, SiteGrid(4, 5))
    check_ends(playback, report)
    corner_s = playback.batch_s[0, 1]
    frame = playback.at(corner_s)
    assert frame.batch == 1
    assert frame.tweezers.tolist() == [[0.0, 3.0, 1.0, 1.0]]
    assert [len(axis) for axis in (playback.rows, playback.columns)] == [2, 2]
    halfway_s = corner_s + GRID.spacing_m / MOTION.speed_m_s
    assert playback.at(halfway_s).atoms[0] == pytest.approx([1.0, 3.0])
    assert playback.trails(halfway_s)[0] == pytest.approx(np.array([[0.0, 3.0], [1.0, 3.0]]))
    assert [(atom.fate, atom.end_s) for atom in playback.atoms] == [
        ("kept", np.inf),
        ("ejected", playback.end_s),
    ]


@pytest.mark.parametrize(("landing", "n_lost"), [(0.99, 1), (0.1, 0)])
def test_an_atom_that_a_tweezer_lands_on_is_lost(landing: float, n_lost: int) -> None:
    motion = MotionSpec(losses=LossSpec(landing=landing), empty_tweezers_may_land=True)
    playback = play_back(LANDING, ATOMS, TARGET, GRID, motion, end_s=1e-3)
    lost = [atom for atom in playback.atoms if atom.is_lost]
    assert [(atom.place(2e-3).tolist(), atom.end_s) for atom in lost] == [([2.0, 3.0], 1e-3)][:n_lost]
    n_empty = np.count_nonzero(playback.at(playback.batch_s[0, 0] + 1e-5).tweezers[:, 3] == 0)
    assert n_empty == 2


def test_a_plan_without_batches_stands_still() -> None:
    playback, _ = played(Plan.from_batches([]), ATOMS, GRID)
    assert playback.start_s == playback.end_s
    assert playback.at(playback.end_s).atoms.tolist() == np.argwhere(ATOMS).tolist()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    """Two speeds, a shot each, of atoms that are often lost."""
    changes = (
        "scan={profile.mobile_tweezers.speed: [60 um/ms, 130 um/ms]}",
        "profile.simulation.record_truth=true",
        "profile.simulation.transport_loss=0.2",
        "repeats=1",
    )
    options: dict[str, Any] = {"seed": 1, "output": tmp_path_factory.mktemp("data"), "overrides": changes}
    options["profile"] = str(ROOT / "hardware_profiles" / "virtual.yaml")
    with labseq.Session.open(ROOT / "sequences" / "scan_dop.yaml", **options) as session:
        return session.run()


def test_each_shot_is_played_at_its_own_speed(run: labseq.Run) -> None:
    for shot in run.shots:
        for index, cycle in enumerate(shot.cycles):
            playback = play_back_cycle(shot, index)
            played_s = cycle.report.batch_end_s[: cycle.n_batches_played]
            assert playback.batch_s[:, 1] == pytest.approx(played_s)
        speed = shot.parameters["profile.mobile_tweezers.speed"]
        planned_again = read_source(str(shot.file)).machine
        assert planned_again is not None
        assert planned_again["mobile_tweezers"]["speed"] == speed
    assert len({shot.parameters["profile.mobile_tweezers.speed"] for shot in run.shots}) == 2
    with pytest.raises(RecordingError, match="has no cycle 99; it has"):
        play_back_cycle(run.shots[0], 99)


def test_lost_atoms_are_those_that_were_not_there_at_the_next_exposure(run: labseq.Run) -> None:
    for shot in run.shots:
        playback, truth = play_back_cycle(shot, 0), shot.atom_events["atoms"]
        here = truth[truth["exposure"] == 1]
        there = {(int(row), int(col)) for row, col in zip(here["row"], here["col"], strict=True)}
        fates = {tuple(atom.place(playback.end_s).round().astype(int)): atom.fate for atom in playback.atoms}
        assert {site for site, fate in fates.items() if fate == "kept"} <= there
        missing = {site for site, fate in fates.items() if fate == "missing"}
        assert missing
        assert not missing & there


def test_without_a_record_of_the_truth_the_next_image_tells_what_is_missing(
    run: labseq.Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Shot, "atom_events", {})
    shot = run.shots[0]
    playback, seen = play_back_cycle(shot, 0), shot.images[1].occupancy
    for atom in playback.atoms:
        if atom.fate != "ejected":
            assert (atom.fate == "missing") != seen[tuple(atom.place(playback.end_s).round().astype(int))]


def test_a_recorded_flight_tells_when_and_where_an_atom_was_lost(
    run: labseq.Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two flights that ended, one was that of another atom, which is there on the next image."""
    shot = run.shots[0]
    before = play_back_cycle(shot, 0)
    moved = [i for i, atom in enumerate(before.atoms) if len(atom.knots) > 1]
    lost = next(i for i in moved if before.atoms[i].fate == "missing")
    kept = next(i for i in moved if before.atoms[i].fate == "kept")
    kind = [("fate", "S9"), ("lost_s", float), ("lost_row", float), ("lost_col", float)]
    rows = list[Any]()
    for i in (lost, kept):
        t_s = before.atoms[i].knots[:2, 0].mean()
        rows.append((b"transport", shot.cycles[0].t_start_s + t_s, *before.atoms[i].place(t_s)))
    events = {**shot.atom_events, "flights": np.array(rows, kind)}
    monkeypatch.setattr(Shot, "atom_events", events)
    after = play_back_cycle(shot, 0)
    assert after.atoms[lost].fate == "lost"
    assert after.atoms[lost].end_s == pytest.approx(rows[0][1] - shot.cycles[0].t_start_s)
    assert after.atoms[lost].place(after.end_s) == pytest.approx(rows[0][2:])
    assert after.atoms[kept].fate == "kept"
    assert sum(atom.is_lost for atom in after.atoms) == sum(atom.is_lost for atom in before.atoms)
