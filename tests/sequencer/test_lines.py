"""The lines go with the steps, and are off before static tweezers are."""

from typing import Any

import numpy as np
import pytest

from labseq.builtin.rearrange import RearrangeStep
from labseq.builtin.steps import WaitStep
from labseq.errors import DeviceError, DeviceTimeoutError
from labseq.model import CameraFacts, LineSpec
from labseq.testing.fakes import RecordingCamera, RecordingLines
from tests.sequencer.rig import IMAGE, LOAD, Rig, given

IMAGING = LineSpec("imaging", 4, frozenset({"image"}), lead_s=2e-3, lag_s=1e-3)
MOT = LineSpec("mot", 3, frozenset({"load"}), lag_s=5e-3)
COOLING = LineSpec("cooling", 2, frozenset({"load", "rearrange", "idle"}), lead_s=0.5e-3)
WAIT = ("wait", WaitStep(given(duration=0.1)))


def fired(made: Rig) -> list[tuple[str, float]]:
    lines = made.lab.lines
    assert isinstance(lines, RecordingLines)
    return [(program.kind, program.duration_s) for program in lines.programs]


def test_each_step_fires_its_lines() -> None:
    made = Rig((LOAD, WAIT, IMAGE), line_specs=[COOLING, MOT, IMAGING])
    made.run()
    assert fired(made) == [
        ("load", pytest.approx(0.5055)),
        ("wait", pytest.approx(0.1)),
        ("image", pytest.approx(0.048)),
    ]
    firing = ["lines.compile", "lines.arm", "lines.fire", "lines.wait"]
    assert made.lab.calls.names("lines") == ["lines.open", *firing * 3, "lines.safe_state", "lines.close"]


def test_without_a_box_nothing_is_fired() -> None:
    made = Rig((LOAD, IMAGE))
    made.run()
    assert made.lab.lines is None
    assert made.record().status == "complete"


def test_an_exposure_begins_after_the_lead_and_the_next_step_after_the_lag() -> None:
    made = Rig((LOAD, IMAGE, IMAGE), line_specs=[IMAGING])
    made.run()
    fires = [call.t_s for call in made.lab.calls.of("lines.fire")]
    triggers = [call.t_s for call in made.lab.calls.of("camera.trigger")]
    assert triggers == [pytest.approx(t_s + 2e-3) for t_s in fires[1:]]
    assert fires[2] - fires[1] >= 0.048 - 1e-9


def test_moves_are_lit_from_their_start_to_their_end() -> None:
    ways = {"stop_when": "never", "window_mode": "early", "window_of": lambda _: 1.0}
    rearrange = RearrangeStep(given(cycles=1, exposure=0.02, **ways))
    seen: dict[str, Any] = {"occupancies": [[[1, 0]], [[0, 1]]], "fill": [[0, 1]]}
    made = Rig((LOAD, IMAGE, ("rearrange", rearrange)), line_specs=[COOLING], **seen)
    made.run()
    assert [kind for kind, _ in fired(made)] == ["load", "image", "rearrange", "image"]
    fire = made.lab.calls.of("lines.fire")[2].t_s
    (play,) = [call.t_s for call in made.lab.calls.of("mobile_tweezers.play")]
    assert play == pytest.approx(fire + 0.5e-3)


class EdgeCamera(RecordingCamera):
    """It sees the edge when it is read."""

    facts = CameraFacts(triggers=("software", "external"))
    armed_for = ""

    def arm(self, n_frames: int, exposure_s: float, trigger: Any) -> None:
        self.armed_for = trigger
        super().arm(n_frames, exposure_s, "software")

    def read(self, timeout_s: float) -> Any:
        super().trigger()
        return super().read(timeout_s)


def with_camera(made: Rig, camera: RecordingCamera) -> Rig:
    camera.clock = made.lab.clock
    camera.calls = made.lab.calls
    object.__setattr__(made.lab, "camera", camera)
    return made


def test_a_line_that_triggers_the_camera_takes_the_place_of_the_software() -> None:
    wire = LineSpec("camera_trigger", 5, frozenset({"image"}), pulse_s=1e-3, triggers="camera")
    camera = EdgeCamera()
    made = with_camera(Rig((IMAGE,), line_specs=[wire]), camera)
    made.run()
    assert camera.armed_for == "external"
    names = [name for name in made.lab.calls.names("camera", "lines") if name != "camera.trigger"]
    assert names[2:7] == ["camera.arm", "lines.compile", "lines.arm", "lines.fire", "camera.read"]


def test_a_blinding_line_refuses_an_exposure_with_em_gain() -> None:
    blinding = LineSpec("mot", 3, frozenset({"load", "image"}), blinding=True)

    class Multiplying(RecordingCamera):
        facts = CameraFacts(em_gain=300.0)

    camera = Multiplying()
    made = with_camera(Rig((LOAD, IMAGE), line_specs=[blinding]), camera)
    with pytest.raises(DeviceError, match="the line 'mot' is on during `image`"):
        made.run()
    assert "camera.arm" not in made.lab.calls.names()


def test_lines_are_off_after_the_devices_and_before_the_static_tweezers() -> None:
    made = Rig(line_specs=[COOLING])
    made.run()
    assert made.made_safe() == ["mobile_tweezers", "shutter", "lines", "camera", "static_tweezers"]


@pytest.mark.parametrize("method", ["compile", "arm", "fire", "wait"])
def test_a_box_that_fails_ends_the_run_safely(method: str) -> None:
    made = Rig(line_specs=[COOLING], fail_on={f"lines.{method}": OSError("cable")})
    with pytest.raises(DeviceError, match="OSError: cable") as caught:
        made.run()
    assert caught.value.device == "lines"
    assert "static_tweezers" in made.made_safe()


def test_a_box_that_does_not_come_to_its_end_is_told() -> None:
    class Slow(RecordingLines):
        def fire(self) -> None:
            super().fire()
            self._over_s += 3600.0

    made = Rig((LOAD,), line_specs=[COOLING])
    lines = Slow(calls=made.lab.calls)
    lines.clock = made.lab.clock
    object.__setattr__(made.lab, "lines", lines)
    with pytest.raises(DeviceTimeoutError, match="it still runs"):
        made.run()


def test_bars_and_budgets_hold_leads_and_lags() -> None:
    made = Rig((LOAD, IMAGE), line_specs=[MOT, IMAGING])
    context = made.lab.step_context
    (load,), (image,) = (step.plan_timeline(context) for _, step in (LOAD, IMAGE))
    assert load.duration_s == pytest.approx(0.505)
    assert image.duration_s == pytest.approx(0.048)
    made.run()
    budgets = {timing.stage: timing.budget_s for timing in made.record().timing}
    assert budgets["expose"] == pytest.approx(0.048)
    assert not any(timing.over_budget for timing in made.record().timing if np.isfinite(timing.budget_s))
