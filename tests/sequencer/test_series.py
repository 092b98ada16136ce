"""The camera is armed once for the images of a shot that are alike."""

from typing import Any

import pytest

from labseq.builtin.rearrange import RearrangeStep
from labseq.builtin.steps import DeviceStep, ImageStep, WaitStep
from labseq.errors import DeviceError, TransientError
from labseq.model import CameraFacts, LineSpec
from labseq.model.policies import RunPolicy, StepPolicy
from labseq.testing.fakes import RecordingCamera
from tests.sequencer.rig import IMAGE, LOAD, Rig, given

WAIT = ("wait", WaitStep(given(duration=0.01)))
SHORT_IMAGE = ("image", ImageStep(given(exposure=0.02)))
CYCLES: dict[str, Any] = {"stop_when": "never", "window_mode": "early", "window_of": lambda _: 1.0}
REARRANGE = ("rearrange", RearrangeStep(given(cycles=3, exposure=0.045, **CYCLES)))
COMMAND = ("device", DeviceStep(given(name="shutter", do="on", arguments={}, timeout=1.0)))
TRIGGERED = LineSpec("camera_trigger", 5, ("image",), pulse_s=1e-3, triggers="camera")


class EmCamera(RecordingCamera):
    @property
    def facts(self) -> CameraFacts:
        return CameraFacts(em_gain=300.0, arm_s=5e-3)


class EdgeCamera(RecordingCamera):
    """While armed, an edge at its input starts an exposure; ``n_extra`` more come with the first."""

    @property
    def facts(self) -> CameraFacts:
        return CameraFacts(triggers=("software", "external"))

    n_extra = 0

    def arm(self, n_frames: int, exposure_s: float, trigger: Any) -> None:
        assert trigger == self.facts.line_trigger
        super().arm(n_frames, exposure_s, "software")

    def read(self, timeout_s: float) -> Any:
        for _ in range(min(1 + self.n_extra, self._n_left)):
            super().trigger()
        self.n_extra = 0
        return super().read(timeout_s)


def rig(camera: RecordingCamera, *steps: tuple[str, Any], **more: Any) -> Rig:
    made = Rig(steps, **more)
    camera.clock, camera.calls = made.lab.clock, made.lab.calls
    object.__setattr__(made.lab, "camera", camera)
    return made


def armed(made: Rig) -> list[Any]:
    """Frames that it was armed for and took, of each series; "off" where it was disarmed."""
    found: list[Any] = []
    for call in made.lab.calls:
        if str(call).startswith("camera.arm"):
            found.append([call.args[0], 0])
        elif str(call).startswith("camera.trigger"):
            found[-1][1] += 1
        elif str(call).startswith("camera.disarm"):
            found.append("off")
    return found


@pytest.mark.parametrize(
    ("steps", "series"),
    [
        ((LOAD, IMAGE, REARRANGE, IMAGE), [[5, 5], "off"]),
        ((LOAD, IMAGE, WAIT, IMAGE, SHORT_IMAGE, SHORT_IMAGE, IMAGE), [[2, 2], [2, 2], [1, 1], "off"]),
        ((LOAD,), []),
    ],
)
def test_once_for_all_that_have_the_same_exposure(steps: Any, series: Any) -> None:
    made = rig(RecordingCamera(), *steps)
    made.run(2)
    assert armed(made) == 2 * series


@pytest.mark.parametrize(
    ("steps", "lines", "series"),
    [
        ((LOAD, IMAGE, IMAGE, WAIT, IMAGE, LOAD, IMAGE), {"load"}, [[3, 3], "off", [1, 1], "off"]),
        ((IMAGE, COMMAND, IMAGE), {"load"}, [[1, 1], "off", [1, 1], "off"]),
        ((LOAD, IMAGE, IMAGE), {"load", "idle"}, [[1, 1], "off", [1, 1], "off"]),
    ],
)
def test_with_em_gain_not_while_light_may_be_on_that_harms_it(steps: Any, lines: Any, series: Any) -> None:
    made = rig(EmCamera(), *steps, line_specs=[LineSpec("mot", 3, tuple(lines), blinding=True)])
    made.run()
    assert armed(made) == series


def test_arming_is_a_stage_of_its_own_in_the_first_image() -> None:
    made = rig(EmCamera(), LOAD, IMAGE, IMAGE)
    made.run()
    stages = [(timing.stage, timing.step, timing.budget_s) for timing in made.record().timing]
    assert [stage for stage in stages if stage[0] == "arm"] == [("arm", 1, 5e-3)]
    budgets = {stage: budget_s for stage, _, budget_s in stages}
    assert budgets["step_1_image"] - budgets["step_2_image"] == pytest.approx(5e-3)


@pytest.mark.parametrize("policy", [StepPolicy(retries=1), StepPolicy()])
def test_after_a_failure_it_is_armed_again(policy: StepPolicy) -> None:
    lost = [None, TransientError("a frame was lost", "camera")]
    policies = RunPolicy(steps=[StepPolicy(), policy])
    made = rig(RecordingCamera(fail_on={"read": lost}), IMAGE, IMAGE, policy=policies)
    made.run()
    left = 1 if policy.retries else 2
    assert armed(made) == [[2, 2], [left, left], "off"]
    assert len(made.record().images) == 2


def test_a_frame_of_an_extra_trigger_is_not_taken_for_the_next_image() -> None:
    camera = EdgeCamera()
    camera.n_extra = 1
    made = rig(camera, IMAGE, IMAGE, line_specs=[TRIGGERED])
    with pytest.raises(DeviceError, match=r"45 ms before .*second edge"):
        made.run()
    assert "camera" in made.made_safe()


def test_a_step_that_comes_after_the_exposure_that_the_camera_began_by_itself_fails() -> None:
    class StartedCamera(EdgeCamera):
        @property
        def facts(self) -> CameraFacts:
            return CameraFacts(triggers=("external_start",), line_trigger="external_start", cycle_s=0.05)

    camera = StartedCamera()
    made = rig(camera, IMAGE, WAIT, IMAGE, line_specs=[TRIGGERED])
    late = r"5 ms too late .*`cycle_time`"
    with pytest.raises(TransientError, match=late):
        made.run()
