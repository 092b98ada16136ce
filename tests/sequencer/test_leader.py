"""Another control system leads: the outcome of each of its signals is reported to it once."""

from typing import Any

import numpy as np
import pytest

from labseq.builtin.follow import FollowStep
from labseq.builtin.steps import WaitStep, wait_step
from labseq.errors import (
    ConfigError,
    DeviceError,
    DeviceTimeoutError,
    RecordingError,
    ShotAbortedError,
    StopRequested,
    TransientError,
)
from labseq.model import LineSpec, ShotRecord
from labseq.roles import Context, StepContext
from labseq.sequencer.leader import find_leader
from labseq.sequencer.shot import ShotSettings
from labseq.testing import StepContract
from labseq.testing.contracts.step import Factory
from labseq.testing.fakes import FakeLab, ListSink, RecordingDevice, RecordingLeader
from tests.sequencer.rig import IMAGE, Rig, given

FOLLOW = ("wait", FollowStep("go", 10.0))


class TestFollow(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return lambda: FollowStep("go", 10.0)

    def lab(self) -> FakeLab:
        lab = super().lab()
        leader = RecordingLeader(Context("leader", clock=lab.clock), lab.calls)
        object.__setattr__(lab, "devices", {"leader": leader})
        return lab


class SpeakingLeader(RecordingLeader):
    """A leader that sends values, and an image each."""

    asks_for_light = True

    def __init__(self, context: Context, calls: Any) -> None:
        super().__init__(context, calls)
        self.sent: list[dict[str, str]] = []
        self.told: list[Any] = []

    def expect_values(self, check: Any) -> None:
        self.check = check

    def take_values(self) -> dict[str, str]:
        return self.sent.pop(0) if self.sent else {}

    def take_turn(self, step: str, timeout_s: float, shot: int) -> str:
        raise DeviceTimeoutError(self.name, f"'{step}' of shot {shot} is not done", timeout_s)

    def light_on(self, exposure_s: float, shot: int) -> None:
        self.told.append((shot, exposure_s))

    def light_off(self, shot: int) -> None:
        self.told.append((shot, 0.0))

    def report_image(self, about: Any) -> None:
        self.told.append((about["shot"], about["image"].name))


def test_an_edge_at_one_device_takes_the_values_that_another_one_has_sent() -> None:
    made = rig(("wait", FollowStep("go", 10.0, "leader")), IMAGE)
    speaking = SpeakingLeader(Context("artiq", clock=made.lab.clock), made.lab.calls)
    object.__setattr__(made.lab, "devices", {**made.lab.devices, "artiq": speaking})
    speaking.sent = [{"x": "1"}, {"x": "many"}, {"x": "2"}]
    sequencer = made.sequencer
    base = ShotSettings(made.lab, sequencer._steps, sequencer._timelines, {"x": 0})

    def settings_for(values: Any) -> ShotSettings:
        if values.get("x") == "many":
            raise ConfigError("x is 'many'")
        return base._replace(parameters={"x": int(values.get("x", 0))})

    sequencer._settings_for = settings_for
    made.run(3)
    assert [shot.parameters for shot in made.sink.shots] == [{"x": 1}, {"x": 2}, {"x": 0}]
    assert states(made) == ["ready", "failed", "ready", "ready"], "a wrong value is no failure of the shot"
    assert leader_of(made).answers[1][1] == {"shot": 1, "refused": True, "reason": "x is 'many'"}
    image = "image"
    assert speaking.told[:4] == [(0, 0.045), (0, 0.0), (0, image), (1, 0.045)], "light, dark, image"


def rig(*steps: tuple[str, Any], goes_after_s: float = 0.5, attempts: int = 3, **lab: Any) -> Rig:
    made = Rig(steps or (FOLLOW, IMAGE), attempts=attempts, **lab)
    leader = RecordingLeader(Context("leader", clock=made.lab.clock), made.lab.calls)
    leader.goes_after_s = goes_after_s
    object.__setattr__(made.lab, "devices", {**made.lab.devices, "leader": leader})
    return made


def leader_of(made: Rig) -> RecordingLeader:
    leader = made.lab.devices["leader"]
    assert isinstance(leader, RecordingLeader)
    return leader


def states(made: Rig) -> list[str]:
    return [state for state, _ in leader_of(made).answers]


def reason(made: Rig) -> str:
    ((state, about),) = leader_of(made).answers
    assert state == "failed"
    return about["reason"]


def test_a_wait_is_for_a_time_or_for_a_signal() -> None:
    settings = {"duration": None, "signal": None, "timeout": None, "device": None}
    pause = wait_step(given(**settings | {"duration": 0.1}))
    assert isinstance(pause, WaitStep)
    assert pause.duration_s == 0.1
    follow = wait_step(given(**settings | {"signal": "go", "timeout": 2.0, "device": "artiq"}))
    assert isinstance(follow, FollowStep)
    assert (follow.signal, follow.timeout_s, follow.device) == ("go", 2.0, "artiq")


def test_it_lasts_as_long_as_the_leader_needs_and_at_most_its_timeout() -> None:
    made = rig()
    lab = made.lab
    (bar,) = FOLLOW[1].plan_timeline(StepContext(lab.grid, lab.motion, lab.target))
    assert (bar.label, bar.duration_s, bar.min_duration_s, bar.kind) == ("wait for go", 10.0, 0.0, "")
    made.run()
    assert made.lab.clock.now() >= 0.5
    assert made.lab.calls.names("leader")[:4] == [
        "leader.open",
        "leader.report",
        "leader.wait_for",
        "leader.report",
    ]


def test_the_outcome_of_each_shot_is_reported() -> None:
    made = rig(occupancies=[np.ones((2, 2), bool), np.eye(2, dtype=bool)])
    made.run(2)
    assert leader_of(made).answers == [
        ("ready", {"shot": 0, "success": True, "filling": 1.0}),
        ("ready", {"shot": 1, "success": False, "filling": 0.5}),
    ]
    without_image = rig(FOLLOW)
    without_image.run()
    assert leader_of(without_image).answers == [("ready", {"shot": 0})]
    assert [shot.readings["leader.go"] for shot in made.sink.shots] == [["1"], ["2"]]
    assert [shot.readings["leader.answer"] for shot in made.sink.shots] == [["ready"], ["ready"]]


def test_it_is_ready_before_the_shot_is_written() -> None:
    class FullDisk(ListSink):
        def write_shot(self, shot: ShotRecord) -> None:
            raise RecordingError("shots", "the disk is full")

    made = rig(sink=FullDisk())
    with pytest.raises(RecordingError):
        made.run()
    assert states(made) == ["ready"], "once, although the shot failed later"


def test_a_second_wait_in_the_shot_reports_first_that_the_first_part_is_ready() -> None:
    made = rig(FOLLOW, IMAGE, FOLLOW, IMAGE)
    made.run()
    assert states(made) == ["ready", "ready"]
    assert made.record().readings["leader.go"] == ["1", "2"]
    assert made.record().readings["leader.answer"] == ["ready", "ready"]
    names = made.lab.calls.names("leader", "camera")
    after_the_image = names[names.index("camera.read") + 1 :]
    assert after_the_image[:3] == ["leader.report", "leader.wait_for", "camera.trigger"]


def test_each_attempt_waits_for_atoms_of_its_own() -> None:
    made = rig(fail_on={"camera.read": [TransientError("a frame was lost", "camera"), None]})
    made.run()
    assert states(made) == ["failed", "ready"]
    assert "a frame was lost" in leader_of(made).answers[0][1]["reason"]
    assert [shot.readings["leader.answer"] for shot in made.sink.shots] == [["failed"], ["ready"]]


def test_a_leader_may_abort_more_often_than_a_shot_has_attempts() -> None:
    class Aborting(RecordingLeader):
        n_aborts = 0

        def check_interlocks(self) -> None:
            if self._answer_due and self.n_aborts < 4:
                self.n_aborts += 1
                raise ShotAbortedError("the leader aborted the shot", "leader")

    class PickUp(WaitStep):
        def run(self, shot: Any) -> None:
            shot.check_interlocks()

    made = rig(FOLLOW, IMAGE, ("pick_up", PickUp(given(duration=1.0))), attempts=2)
    leader = Aborting(Context("leader", clock=made.lab.clock), made.lab.calls)
    object.__setattr__(made.lab, "devices", {**made.lab.devices, "leader": leader})
    made.run()
    assert states(made) == ["failed"] * 4 + ["ready"]
    assert leader.answers[0][1]["reason"].endswith("the leader aborted the shot")
    assert [shot.status for shot in made.sink.shots] == ["failed"] * 4 + ["complete"]


def test_a_transient_failure_is_reported_after_the_devices_are_safe() -> None:
    made = rig(fail_on={"camera.read": [TransientError("a frame was lost", "camera"), None]})
    made.run()
    names = made.lab.calls.names("leader", "camera", "mobile_tweezers")
    reported = [n for n, name in enumerate(names) if name == "leader.report"][1]
    assert names[reported - 2 : reported] == ["mobile_tweezers.safe_state", "camera.safe_state"]


def test_a_failure_is_reported_after_all_devices_are_safe_and_before_they_are_closed() -> None:
    made = rig(fail_on={"camera.read": OSError("cable")})
    with pytest.raises(DeviceError):
        made.run()
    assert "cable" in reason(made)
    names = made.lab.calls.names()
    reported = len(names) - 1 - names[::-1].index("leader.report")
    assert names.index("static_tweezers.safe_state") < reported < names.index("leader.close")
    assert made.record().readings["leader.answer"] == ["failed"]


@pytest.mark.parametrize("last", [False, True])
def test_a_stop_after_go_is_reported_as_a_failure(last: bool) -> None:
    class Stopping(WaitStep):
        def run(self, shot: Any) -> None:
            made.lab.stop.request()

    stop = ("stop", Stopping(given(duration=1.0)))
    made = rig(FOLLOW, *((IMAGE, stop) if last else (stop, IMAGE)))
    leader, report = leader_of(made), leader_of(made).report

    def waits(state: Any, about: Any) -> str:
        made.lab.clock.check()  # as every driver does that waits for its device
        return report(state, about)

    vars(leader)["report"] = waits
    with pytest.raises(StopRequested):
        made.run()
    ((state, about),) = leader.answers
    assert (state, about["reason"]) == ("failed", "stopped by Ctrl-C")
    assert made.record().status == "interrupted"


def test_a_stop_while_it_waits_is_no_failure() -> None:
    made = rig()
    leader = leader_of(made)

    def never(signal: str, timeout_s: float) -> str:
        made.lab.stop.request()
        made.lab.clock.check()
        return ""

    vars(leader)["wait_for"] = never
    with pytest.raises(StopRequested):
        made.run()
    assert leader.answers == []


def test_a_go_that_never_comes_ends_the_run_safely() -> None:
    made = rig(goes_after_s=3600.0)
    with pytest.raises(DeviceTimeoutError, match="no 'go' within"):
        made.run()
    assert set(made.made_safe()) == {"mobile_tweezers", "shutter", "leader", "camera", "static_tweezers"}
    assert states(made) == []
    assert made.unsafe == {}


def test_a_leader_that_cannot_be_reached_is_a_warning_and_hides_no_error() -> None:
    made = rig(fail_on={"camera.read": OSError("cable")})
    leader, tell = leader_of(made), leader_of(made).report

    def unplugged(state: Any, about: Any) -> str:
        if state == "failed":
            raise OSError("unplugged")
        return tell(state, about)

    vars(leader)["report"] = unplugged
    with pytest.raises(DeviceError, match="cable"):
        made.run()
    (warning,) = made.observer.of("warning")
    assert "could not be reported" in warning["text"]
    assert "unplugged" in warning["text"]
    assert made.sink.shots, "it was written all the same"


def test_signals_and_answers_are_in_the_log() -> None:
    made = rig()
    leader_of(made).noted = ["127.0.0.1:40001 leads"]
    made.run()
    assert made.observer.of("leader_event") == [
        {"shot": 0, "device": "leader", "text": "127.0.0.1:40001 leads"}
    ]
    assert made.observer.of("leader_awaited") == [
        {"shot": 0, "device": "leader", "signal": "go", "timeout_s": 10.0}
    ]
    assert [said["text"] for said in made.observer.of("leader_signal")] == ["go 1"]
    assert [reported["text"] for reported in made.observer.of("leader_answered")] == ["ready"]


def test_lines_stay_idle_while_it_waits() -> None:
    made = rig(line_specs=[LineSpec("mot", 3, ("wait", "image"))])
    made.run()
    programs: Any = made.lab.lines
    assert [program.kind for program in programs.programs] == ["image"]


def test_a_missing_or_wrong_leader_is_refused() -> None:
    devices = {"shutter": RecordingDevice(), "a": RecordingLeader(), "b": RecordingLeader()}
    assert find_leader(devices, "b") == ("b", devices["b"])
    with pytest.raises(ConfigError, match="no device"):
        find_leader({"shutter": devices["shutter"]})
    with pytest.raises(ConfigError, match="'shutter'"):
        find_leader(devices, "shutter")
    with pytest.raises(ConfigError, match=r"`device` .*'a', 'b'"):
        find_leader(devices)
