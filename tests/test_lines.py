"""What the lines do around a step, against a rule written down line by line."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.model import LineProgram, LineSpec, TimelineEntry
from labseq.sequencer.lines import idle_program, line_program, margin_s, off_program, spans_on, trigger_line

KINDS = ("load", "image", "rearrange", "idle")
times = st.sampled_from([0.0, 0.5e-3, 1e-3, 7e-3])


@st.composite
def specs(draw: st.DrawFn) -> tuple[LineSpec, ...]:
    lines: list[LineSpec] = []
    for channel in range(draw(st.integers(0, 5))):
        on = frozenset(draw(st.sets(st.sampled_from(KINDS))))
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


@given(specs(), st.sampled_from(KINDS[:3]), st.sampled_from([0.0, 5e-3, 0.5]))
def test_each_line_is_on_when_the_rule_says_so(lines, kind, duration_s) -> None:
    program = line_program(lines, kind, duration_s)
    end_s = program.begin_s + duration_s
    for t_s in np.concatenate([program.t_s + 1e-6, np.linspace(0, program.duration_s * 1.1, 23) + 1e-6]):
        state = program.on[np.searchsorted(program.t_s, t_s, side="right") - 1]
        wanted = [is_on(spec, kind, t_s, program.begin_s, end_s, program.duration_s) for spec in lines]
        assert state.tolist() == wanted, t_s


@given(specs(), st.sampled_from(KINDS[:3]), st.sampled_from([0.0, 5e-3, 0.5]))
def test_a_program_leaves_the_lines_idle_and_changes_something_at_each_edge(lines, kind, duration_s) -> None:
    program = line_program(lines, kind, duration_s)
    assert program.on[-1].tolist() == idle_program(lines).on[-1].tolist()
    assert all((a != b).any() for a, b in zip(program.on[1:], program.on[:-1], strict=True))
    assert program.t_s[0] == 0.0
    assert program.t_s[-1] <= program.duration_s + 1e-9


@given(specs(), st.sampled_from(KINDS[:3]))
def test_the_margin_is_what_a_step_takes_longer(lines, kind) -> None:
    program = line_program(lines, kind, 0.1)
    assert program.duration_s == pytest.approx(0.1 + margin_s(lines, kind), abs=1e-9)


def test_off_is_off_whatever_is_idle() -> None:
    lines = (LineSpec("cooling", 0, frozenset({"idle"})),)
    assert not off_program(lines).on.any()


def test_the_spans_of_a_line_are_joined() -> None:
    program = LineProgram(
        "x", ("a",), np.array([0.0, 1.0, 2.0, 3.0]), np.array([[1], [1], [0], [1]], bool), 0, 4.0
    )
    assert program.spans("a") == [(0.0, 2.0), (3.0, 4.0)]
    assert program.rising("a") == [0.0, 3.0]


def test_the_line_of_a_trigger_is_found() -> None:
    lines = (LineSpec("a", 0, frozenset()), LineSpec("b", 1, frozenset({"image"}), triggers="camera"))
    assert trigger_line(lines, "camera") is lines[1]
    assert trigger_line(lines, "mobile_tweezers") is None


@pytest.mark.parametrize("t_s", [[], [1.0], [0.0, 0.0], [0.0, 2.0, 1.0]])
def test_edges_that_do_not_rise_from_zero_are_refused(t_s: list[float]) -> None:
    with pytest.raises(ValueError, match="begin at 0 and rise"):
        LineProgram("x", ("a",), np.array(t_s), np.zeros((len(t_s), 1), bool), 0.0, 1.0)


def test_the_spans_of_a_shot_are_those_of_its_steps() -> None:
    lines = (
        LineSpec("cooling", 0, frozenset({"load", "idle"})),
        LineSpec("imaging", 1, frozenset({"image"}), lead_s=0.01),
    )
    bars = [
        TimelineEntry("load", 0.5, 0.5, kind="load"),
        TimelineEntry("image", 0.06, 0.06, 1, 0.045, "image"),  # with 5 ms of read-out
        TimelineEntry("device", 0.1, 0.1),
    ]
    spans = spans_on(lines, bars)
    assert list(spans["cooling"]) == [
        (0.0, 0.5),
        (pytest.approx(0.555), pytest.approx(0.66)),
    ]
    assert spans["imaging"] == [(pytest.approx(0.5), pytest.approx(0.555))]
