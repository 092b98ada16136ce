"""The closed loop, on scripted occupancies."""

import threading
from typing import Any

import numpy as np
import pytest

from labseq.builtin.rearrange import RearrangeStep
from labseq.errors import DeviceError, InvalidPlanError, PlanError
from labseq.model import Plan
from labseq.model.policies import Timeouts
from labseq.testing.fakes import ScriptedPlanner
from tests.sequencer.rig import IMAGE, LOAD, SAFE_ORDER, Rig, given

HALF = np.array([[1, 0, 1], [0, 0, 0]], bool)
FILL = np.array([[1, 1, 0], [0, 0, 0]], bool)
DONE = np.array([[1, 1, 0], [0, 0, 0]], bool)


def rearranging(occupancies_seen, planner=None, after=(IMAGE,), **settings):
    defaults = {"cycles": 3, "exposure": 0.02, "stop_when": "defect_free", "window_mode": "early"}
    window_s = settings.pop("window", 0.06)
    settings_given = given(**{**defaults, **settings}, window_of=lambda cycle: window_s)
    parts: dict[str, Any] = {} if planner is None else {"planner": planner, "planner_name": "scripted"}
    return Rig(
        occupancies=occupancies_seen,
        fill=FILL,
        steps=(LOAD, IMAGE, ("sort", RearrangeStep(settings_given)), *after),
        **parts,
    )


def test_it_stops_when_the_target_is_met():
    rig = rearranging([HALF, HALF, DONE, DONE])
    rig.run()
    record = rig.record()
    assert [cycle.cycle for cycle in record.cycles] == [0, 1]
    assert record.seen_defect_free_cycle == 1
    assert record.success
    assert [image.cycle for image in record.images] == [-1, 0, 1, -1]
    assert rig.lab.calls.names("mobile_tweezers").count("mobile_tweezers.play") == 2


def test_seen_defect_free_is_no_success():
    rig = rearranging([HALF, DONE, HALF])
    rig.run()
    assert rig.record().seen_defect_free_cycle == 0
    assert not rig.record().success


def test_an_image_before_the_last_rearrangement_judges_nothing():
    rig = rearranging([DONE, HALF, DONE, DONE], after=(), stop_when="never", cycles=3)
    rig.run()
    record = rig.record()
    assert (record.status, record.success, record.seen_defect_free_cycle) == ("complete", False, 1)
    assert np.isnan(record.filling_fraction)


def test_nothing_moves_on_a_target_that_is_met():
    rig = rearranging([DONE])
    rig.run()
    assert rig.record().cycles == []
    assert not rig.lab.calls.of("mobile_tweezers.prepare")


def test_never_makes_every_cycle_and_plays_nothing_for_an_empty_plan():
    rig = rearranging([DONE], stop_when="never")
    rig.run()
    assert [c.n_batches_played for c in rig.record().cycles] == [0, 0, 0]
    assert [i.cycle for i in rig.record().images] == [-1, 0, 1, 2, -1]
    assert not rig.lab.calls.of("mobile_tweezers.play")


@pytest.mark.parametrize("mode", ["early", "fixed"])
def test_the_window_is_waited_out_only_when_fixed(mode):
    rig = rearranging([HALF, DONE], window_mode=mode, cycles=1)
    rig.run()
    (move,) = [t for t in rig.record().timing if t.stage == "move"]
    (cycle,) = rig.record().cycles
    assert move.duration_s == pytest.approx(0.06 if mode == "fixed" else cycle.moves_s)
    assert cycle.moves_s == pytest.approx(cycle.report.duration_s)
    assert 0.013 < cycle.moves_s < 0.016


def test_a_batch_that_does_not_fit_is_not_started():
    rig = rearranging([HALF], window=0.0131, cycles=1)
    rig.run()
    (cycle,) = rig.record().cycles
    assert (cycle.plan.n_batches, cycle.n_batches_played, cycle.moves_s) == (1, 0, 0.0)
    assert not rig.lab.calls.of("mobile_tweezers.play")
    (reported,) = rig.observer.of("window_too_short")
    assert (reported["n_batches"], reported["n_batches_played"]) == (1, 0)


class LatePlanner(ScriptedPlanner):
    """Takes longer than the overhead that the window allows for."""

    clock: Any = None

    def plan(self, occupancy, target):
        self.clock.sleep(0.013 + 0.005)
        return super().plan(occupancy, target)


@pytest.mark.parametrize(("window", "n_played"), [(0.0160, 0), (0.0200, 1)])
def test_the_time_that_planning_takes_beyond_the_overhead_shortens_the_window(window, n_played):
    planner = LatePlanner([Plan.from_batches([([(0, 2)], [(0, 1)])])])
    rig = rearranging([HALF], planner=planner, window=window, cycles=1)
    planner.clock = rig.lab.clock
    rig.run()
    (cycle,) = rig.record().cycles
    assert (cycle.plan.n_batches, cycle.n_batches_played) == (1, n_played)


BACK_AND_FORTH = Plan.from_batches([([(0, 2)], [(0, 1)]), ([(0, 1)], [(0, 2)])] * 60)


def uploading(part: float, window: float, cycles: int = 2) -> Any:
    """A rig whose mobile tweezers take a part of the playing time to prepare, and 2 ms on top."""
    rig = rearranging([HALF], ScriptedPlanner([BACK_AND_FORTH]), window=window, cycles=cycles)
    prepare = rig.lab.mobile_tweezers.prepare

    def slow(program: Any) -> float:
        rig.lab.clock.sleep(2e-3 + part * program.total_duration_s)
        return prepare(program)

    vars(rig.lab.mobile_tweezers)["prepare"] = slow
    return rig


def test_batches_are_chosen_by_how_long_their_preparation_takes():
    rig = uploading(part=1.2, window=0.040)
    rig.run()
    moves = [t for t in rig.record().timing if t.stage == "move"]
    first, second = rig.record().cycles
    assert first.plan.n_batches == 120
    assert 0 < first.n_batches_played < 120
    assert 0 < second.n_batches_played < 120
    assert all(move.duration_s <= 0.041 for move in moves)
    assert [cycle.late_s for cycle in (first, second)] == [0.0, 0.0]
    n_prepared = [sum(t.stage == "prepare" and t.cycle == k for t in rig.record().timing) for k in (0, 1)]
    assert n_prepared == [3, 1], "from two programs it knows fixed time and part, and so does the next cycle"
    reported, _ = rig.observer.of("window_too_short")
    assert reported["before_moves_s"] > 0.025
    assert not rig.observer.of("window_exceeded")


def test_moves_that_end_after_the_window_are_recorded():
    rig = uploading(part=0.0, window=0.030, cycles=1)
    wait = rig.lab.mobile_tweezers.wait
    vars(rig.lab.mobile_tweezers)["wait"] = lambda limit_s: (wait(limit_s), rig.lab.clock.sleep(0.020))
    rig.run()
    (cycle,), (reported,) = rig.record().cycles, rig.observer.of("window_exceeded")
    (move,) = [t for t in rig.record().timing if t.stage == "move"]
    assert cycle.late_s == reported["late_s"] == pytest.approx(move.duration_s - 0.030)
    assert cycle.late_s > 0.005


def test_an_image_is_needed():
    settings_given = given(
        cycles=1, exposure=0.02, stop_when="never", window_mode="early", window_of=lambda c: 0.06
    )
    rig = Rig(steps=(("sort", RearrangeStep(settings_given)),))
    with pytest.raises(PlanError, match="needs an image"):
        rig.run()


def test_a_plan_that_is_wrong_never_plays():
    over_the_atom = Plan.from_batches([([(0, 2)], [(0, 0)])])
    rig = rearranging([HALF], planner=ScriptedPlanner([over_the_atom]))
    with pytest.raises(InvalidPlanError) as caught:
        rig.run()
    assert caught.value.planner == "scripted"
    assert not rig.lab.calls.of("mobile_tweezers.prepare")
    assert rig.made_safe() == SAFE_ORDER


@pytest.mark.parametrize("answer", [None, "a plan"])
def test_an_answer_that_is_no_plan_is_named(answer):
    rig = rearranging([HALF], planner=ScriptedPlanner([answer]))
    with pytest.raises(PlanError, match="expected a Plan"):
        rig.run()


@pytest.mark.parametrize("answer", [None, float("nan"), -1.0])
def test_a_playing_time_that_is_none_is_named(answer):
    rig = rearranging([HALF])
    vars(rig.lab.mobile_tweezers)["prepare"] = lambda program: answer
    with pytest.raises(DeviceError, match=r"mobile_tweezers: prepare\(\) returned"):
        rig.run()
    assert not rig.lab.calls.of("mobile_tweezers.play")
    assert rig.made_safe() == SAFE_ORDER


def test_a_planner_cannot_change_what_was_seen():
    class Vandal:
        def plan(self, occupancy, target):
            occupancy[:] = True
            return Plan.from_batches([])

    rig = rearranging([HALF], planner=Vandal(), cycles=1)
    rig.run()
    assert (rig.record().images[0].occupancy == HALF).all()


def test_a_planner_that_hangs_is_given_up():
    release = threading.Event()

    class Slow:
        def plan(self, occupancy, target):
            release.wait(30.0)

    rig = rearranging([HALF], planner=Slow())
    rig.sequencer.lab = rig.lab = type(rig.lab)(
        **{f: getattr(rig.lab, f) for f in rig.lab.__dataclass_fields__ if f != "timeouts"},
        timeouts=Timeouts(10.0, 10.0, 0.05),
    )
    with pytest.raises(PlanError, match="did not answer within"):
        rig.run()
    release.set()
    assert rig.made_safe() == SAFE_ORDER
