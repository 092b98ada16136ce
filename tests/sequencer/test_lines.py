"""What the lines do around a step, against a rule written down line by line."""

from typing import Any

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from labseq.builtin.rearrange import RearrangeStep
from labseq.builtin.steps import WaitStep
from labseq.errors import DeviceError
from labseq.model import CameraFacts, LineProgram, LineSpec, TimelineEntry
from labseq.sequencer.line_spans import spans_on
from labseq.sequencer.lines import idle_program, line_program, margin_s, off_program
from labseq.testing.fakes import RecordingCamera, RecordingLines
from tests.sequencer.rig import IMAGE, LOAD, Rig, given

KINDS = ("load", "image", "rearrange", "idle")
times = st.sampled_from([0.0, 0.5e-3, 1e-3, 7e-3])


@st.composite
def specs(draw: st.DrawFn) -> tuple[LineSpec, ...]:
    lines: list[LineSpec] = []
    for channel in range(draw(st.integers(0, 5))):
        on = tuple(draw(st.lists(st.sampled_from(KINDS), unique=True)))
        pulse_s = draw(st.sampled_from([0.0, 0.0, 0.2e-3, 30e-3])) if "idle" not in on else 0.0
        lag_s = 0.0 if pulse_s else draw(times)
        lines.append(LineSpec(f"line{channel}", channel, on, draw(times), lag_s, pulse_s))
    return tuple(lines)


def is_on(spec: LineSpec, kind: str, t_s: float, begin_s: float, end_s: float, over_s: float) -> bool:
    """The rule: a line is on from its lead to its lag, or for its pulse, or always where it is idle's too."""
    if t_s >= over_s:
        return "idle" in spec.on
    if kind not in spec.on:
        return False
    if "idle" in spec.on:
        return True
    off_s = begin_s - spec.lead_s + spec.pulse_s if spec.pulse_s else end_s + spec.lag_s
    return begin_s - spec.lead_s <= t_s < off_s


@hypothesis.settings(max_examples=40)
@hypothesis.given(specs(), st.sampled_from(KINDS[:3]), st.sampled_from([0.0, 5e-3, 0.5]))
def test_each_line_is_on_by_the_rule(lines, kind, duration_s) -> None:
    program = line_program(lines, kind, duration_s)
    end_s = program.begin_s + duration_s
    for t_s in np.concatenate([program.t_s + 1e-6, np.linspace(0, program.duration_s * 1.1, 23) + 1e-6]):
        state = program.on[np.searchsorted(program.t_s, t_s, side="right") - 1]
        wanted = [is_on(spec, kind, t_s, program.begin_s, end_s, program.duration_s) for spec in lines]
        assert state.tolist() == wanted, t_s


@hypothesis.settings(max_examples=40)
@hypothesis.given(specs(), st.sampled_from(KINDS[:3]), st.sampled_from([0.0, 5e-3, 0.5]))
def test_a_program_leaves_the_lines_idle_and_changes_something_at_each_edge(lines, kind, duration_s) -> None:
    program = line_program(lines, kind, duration_s)
    assert program.on[-1].tolist() == idle_program(lines).on[-1].tolist()
    assert all((a != b).any() for a, b in zip(program.on[1:], program.on[:-1], strict=True))
    assert program.t_s[0] == 0.0
    assert program.t_s[-1] <= program.duration_s + 1e-9
    longer = line_program(lines, kind, 0.1)
    assert longer.duration_s == pytest.approx(0.1 + margin_s(lines, kind), abs=1e-9)
    assert not off_program(lines).on.any()


def test_the_spans_of_a_line_are_joined() -> None:
    program = LineProgram(
        "x", ("a",), np.array([0.0, 1.0, 2.0, 3.0]), np.array([[1], [1], [0], [1]], bool), 0, 4.0
    )
    assert program.spans("a") == [(0.0, 2.0), (3.0, 4.0)]
    assert program.rising("a") == [0.0, 3.0]


@pytest.mark.parametrize("t_s", [[1.0], [0.0, 0.0]])
def test_edges_that_do_not_rise_from_zero_are_refused(t_s: list[float]) -> None:
    with pytest.raises(ValueError, match="begin at 0 and rise"):
        LineProgram("x", ("a",), np.array(t_s), np.zeros((len(t_s), 1), bool), 0.0, 1.0)


def test_the_spans_of_a_shot_are_those_of_its_steps() -> None:
    lines = (
        LineSpec("cooling", 0, ("load", "idle")),
        LineSpec("imaging", 1, ("image",), lead_s=0.01),
    )
    bars = [
        TimelineEntry("load", 0.5, 0.5, kind="load"),
        TimelineEntry("image", 0.06, 0.06, 1, 0.045, "image"),  # with 5 ms of read-out
        TimelineEntry("device", 0.1, 0.1),
    ]
    spans = spans_on(lines, bars)
    assert list(spans["cooling"]) == [(0.0, 0.5), (pytest.approx(0.555), pytest.approx(0.66))]
    assert spans["imaging"] == [(pytest.approx(0.5), pytest.approx(0.555))]


IMAGING = LineSpec("imaging", 4, ("image",), lead_s=2e-3, lag_s=1e-3)
MOT = LineSpec("mot", 3, ("load",), lag_s=5e-3)
COOLING = LineSpec("cooling", 2, ("load", "rearrange", "idle"), lead_s=0.5e-3)
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
    assert made.lab.calls.names("lines") == [
        "lines.open",
        "lines.idle",
        *firing * 3,
        "lines.safe_state",
        "lines.close",
    ]


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

    @property
    def facts(self) -> CameraFacts:
        return CameraFacts(triggers=("software", "external"))

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
    wire = LineSpec("camera_trigger", 5, ("image",), pulse_s=1e-3, triggers="camera")
    camera = EdgeCamera()
    made = with_camera(Rig((IMAGE,), line_specs=[wire]), camera)
    made.run()
    assert camera.armed_for == "external"
    names = [name for name in made.lab.calls.names("camera", "lines") if name != "camera.trigger"]
    assert names[3:8] == ["camera.arm", "lines.compile", "lines.arm", "lines.fire", "camera.read"]


def test_a_blinding_line_refuses_an_exposure_with_em_gain() -> None:
    blinding = LineSpec("mot", 3, ("image",), blinding=True)

    class Multiplying(RecordingCamera):
        @property
        def facts(self) -> CameraFacts:
            return CameraFacts(em_gain=300.0)

    camera = Multiplying()
    made = with_camera(Rig((LOAD, IMAGE), line_specs=[blinding]), camera)
    with pytest.raises(DeviceError, match=r"while 'mot' is on, .* remove `image` from the `on`"):
        made.run()
    assert "camera.arm" not in made.lab.calls.names()


def test_lines_are_off_after_the_devices_and_before_the_static_tweezers() -> None:
    made = Rig(line_specs=[COOLING])
    made.run()
    assert made.made_safe() == ["mobile_tweezers", "shutter", "lines", "camera", "static_tweezers"]


@pytest.mark.parametrize("method", ["compile", "wait"])
def test_a_box_that_fails_ends_the_run_safely(method: str) -> None:
    made = Rig(line_specs=[COOLING], fail_on={f"lines.{method}": OSError("cable")})
    with pytest.raises(DeviceError, match="OSError: cable") as caught:
        made.run()
    assert caught.value.device == "lines"
    assert "static_tweezers" in made.made_safe()


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
