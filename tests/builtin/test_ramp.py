"""Ramps and releases of the static tweezers in a shot, and their depth at the start of the next."""

from typing import Any

import pytest

from labseq.builtin.steps import RampStep, ReleaseStep
from labseq.errors import DeviceError, DeviceTimeoutError, TransientError
from labseq.model import LineSpec
from labseq.model.policies import Timeouts
from labseq.testing.fakes import RecordingLines
from tests.sequencer.rig import IMAGE, LOAD, SAFE_ORDER, Rig, given


@pytest.fixture(autouse=True)
def busy_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that begins late must not let the next device go first."""
    monkeypatch.setattr("labseq.sequencer.lab.NEXT_S", 60.0)


LOWER = ("ramp", RampStep(given(depth=0.5, duration=5e-3)))
RAISE = ("ramp", RampStep(given(depth=1.0, duration=2e-3)))


def ramps(rig: Rig) -> list[tuple[float, float]]:
    return [call.args for call in rig.lab.calls.of("static_tweezers.ramp")]


def test_the_static_tweezers_are_ramped_and_the_shot_waits_for_it() -> None:
    rig = Rig((LOAD, LOWER, IMAGE, RAISE, IMAGE))
    rig.run()
    assert ramps(rig) == [(0.5, 5e-3), (1.0, 2e-3)]
    assert [stage.duration_s for stage in rig.record().timing if "ramp" in stage.stage] == pytest.approx(
        [5e-3, 2e-3]
    )
    assert rig.observer.of("ramped")[0] == {
        "shot": 0,
        "device": "static_tweezers",
        "depth": 0.5,
        "duration_s": 5e-3,
    }


def test_each_shot_begins_at_full_depth() -> None:
    depths: list[float] = []

    class Seen(RampStep):
        def run(self, shot) -> None:
            tweezers: Any = shot.static_tweezers
            depths.append(tweezers.depth)
            super().run(shot)

    rig = Rig((LOAD, ("ramp", Seen(given(depth=0.5, duration=5e-3)))))
    rig.run(3)
    assert depths == [1.0, 1.0, 1.0]


def test_a_repeated_shot_begins_at_full_depth() -> None:
    depths: list[float] = []

    class LosesAFrame:
        needs_image = takes_image = False

        def plan_timeline(self, _context):
            return []

        def run(self, shot) -> None:
            tweezers: Any = shot.static_tweezers
            depths.append(tweezers.depth)
            if len(depths) == 1:
                raise TransientError("a frame was lost")

    rig = Rig((LOAD, ("look", LosesAFrame()), LOWER, ("look", LosesAFrame())))
    rig.run()
    assert depths == [1.0, 1.0, 0.5]
    depths.clear()
    rig = Rig((LOAD, LOWER, ("look", LosesAFrame())))
    rig.run()
    assert [call.method for call in rig.lab.calls if call.device == "static_tweezers"] == [
        *("open", "load", "start"),
        *("start", "ramp", "start", "ramp"),
        *("safe_state", "close"),
    ]


def test_atoms_load_at_the_present_depth() -> None:
    rig = Rig((LOWER, LOAD))
    rig.run()
    names = rig.lab.calls.names("static_tweezers")
    assert names == [
        f"static_tweezers.{call}"
        for call in ["open", "load", "start", "start", "ramp", "safe_state", "close"]
    ]


def test_lines_are_played_with_a_ramp() -> None:
    cooling = LineSpec("cooling", 2, ("ramp",), lead_s=1e-3, lag_s=2e-3)
    rig = Rig((LOWER,), line_specs=[cooling])
    (bar,) = LOWER[1].plan_timeline(rig.lab.step_context)
    assert (bar.label, bar.kind, bar.duration_s) == ("ramp to 0.5", "ramp", pytest.approx(8e-3))
    rig.run()
    lines = rig.lab.lines
    assert isinstance(lines, RecordingLines)
    assert [(program.kind, program.duration_s) for program in lines.programs] == [
        ("ramp", pytest.approx(8e-3))
    ]
    (fire,), (ramp,) = (rig.lab.calls.of(name) for name in ("lines.fire", "static_tweezers.ramp"))
    assert ramp.t_s == pytest.approx(fire.t_s + 1e-3)


RELEASE = ("release", ReleaseStep(given(duration=10e-6)))
TRAPS_OFF = LineSpec("traps_off", 7, ("release",), turns_off="static_tweezers")


def test_a_release_by_a_line_is_one_program_that_ends_with_the_light_on() -> None:
    rig = Rig((LOAD, RELEASE, IMAGE), line_specs=[TRAPS_OFF])
    rig.run()
    lines = rig.lab.lines
    assert isinstance(lines, RecordingLines)
    (program,) = (one for one in lines.programs if one.kind == "release")
    assert (program.t_s.tolist(), program.on[:, 0].tolist()) == ([0.0, 10e-6], [True, False])
    assert not rig.lab.calls.of("static_tweezers.release")
    (step,) = (step for step in rig.record().steps if step.name == "release")
    assert (step.timed_by, step.planned_s, step.achieved_s) == ("lines", 10e-6, 10e-6)


@pytest.mark.parametrize("fails", ["lines.fire", "lines.wait", "static_tweezers.release"])
def test_a_release_that_fails_leaves_no_line_on_and_ends_in_the_safe_state(fails: str) -> None:
    device = fails.partition(".")[0]
    specs = [TRAPS_OFF] if device == "lines" else []
    failure: list[BaseException | None] = [DeviceError(device, "broken")]
    if fails == "lines.wait":
        failure = [None, *failure]  # the first is that of `load`
    rig = Rig((LOAD, RELEASE, IMAGE), line_specs=specs, fail_on={fails: failure})
    with pytest.raises(DeviceError, match="broken"):
        rig.run()
    assert [name for name in rig.made_safe() if name != "lines"] == SAFE_ORDER
    lines = rig.lab.lines
    assert lines is None or "lines" in rig.made_safe()


def test_tweezers_that_hang_in_a_ramp_end_the_run() -> None:
    timeouts = Timeouts(call_s=0.05, safe_state_s=10.0, plan_s=10.0)
    rig = Rig((LOAD, LOWER), hang_on={"static_tweezers.ramp"}, timeouts=timeouts)
    with pytest.raises(DeviceTimeoutError, match=r"static_tweezers: ramp\(\) did not answer within"):
        rig.run()
    assert rig.made_safe() == SAFE_ORDER
    rig.lab.hangs["static_tweezers.ramp"].release.set()
