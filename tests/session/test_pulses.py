"""Pulses after assembly: what `check` refuses, what the files hold, and what a fit finds of the atoms."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import labseq
from labseq.session.check import check

from .whole_runs import ROOT, SMALL_FRAMES, run

SHOT = """labseq: 1
name: pulses
shots: 1
shot:
  - load: {duration: 100 ms}
  - name: before
    image: {exposure: 45 ms}
  - name: echo
    pulse:
      PULSE
  - name: after
    image: {exposure: 45 ms}
"""
TRAPS_OFF = "profile.lines.channels.traps_off={channel: 7, on: [release], turns_off: static_tweezers}"
EXCLUSIVE = "profile.lines.mutually_exclusive=[[microwave, push_out]]"
CAMERA = "profile.lines.channels.trigger={channel: 9, on: [image], triggers: camera}"
BOX = "profile.lines={use: ttl, channels: {microwave: {channel: 7}}}"


def written(folder: Path, pulse: str) -> Path:
    path = folder / "s.yaml"
    path.write_text(SHOT.replace("PULSE", pulse), "utf-8")
    return path


@pytest.mark.parametrize(
    ("pulse", "overrides", "place", "message"),
    [
        ("parts: {a: {lines: [micro], duration: 9 us}}", [], (10, 27), "did you mean 'microwave'?"),
        (
            "parts: {a: {parts: {b: {lines: [push_out, trigger], duration: 9 us}}}}",
            [CAMERA],
            (10, 49),
            "'trigger' triggers the camera",
        ),
        ("{lines: [microwave], duration: 12.3 us}", [BOX], (10, 38), "at least 5 us, in steps of 500 ns"),
        ("{lines: [microwave], duration: 4.5 us}", [BOX], (10, 38), "at least 5 us, in steps of 500 ns"),
        ("{lines: [microwave, push_out], duration: 9 us}", [EXCLUSIVE], (10, 48), "mutually exclusive"),
        (
            "{lines: [microwave], duration: 9 us}",
            ["profile=paper"],
            (10, 7),
            "no device of this profile can time",
        ),
        (
            "{repeat: 12, parts: {a: {lines: [microwave], duration: 9 us}, b: {duration: 9 us}}}",
            [BOX],
            (10, 7),
            "number of edges is 24; the limit is at most 23",
        ),
        ("{lines: [microwave]}", [], (10, 7), "a pulse has no duration; expected 'duration', or 'parts'"),
        ("{lines: [], parts: {a: {duration: 9 us}}}", [], (10, 8), "'lines' is set with 'parts'"),
        ("{repeat: 9999, parts: {a: {duration: 0}, b: {duration: 0}}}", [], (10, 16), "19998 pulses"),
        ("parts: {a.b: {duration: 9 us}}", [], (10, 15), "the name 'a.b' has a dot"),
    ],
)
def test_what_cannot_be_played_is_refused_at_its_place(
    pulse: str, overrides: list[str], place: tuple[int, int], message: str, tmp_path: Path
) -> None:
    with pytest.raises(labseq.ConfigError) as caught:
        check(labseq.Session.open(written(tmp_path, pulse), overrides=overrides))
    (problem,) = caught.value.problems
    assert (problem.line, problem.column) == place
    assert message in str(problem)


def test_the_file_of_a_shot_holds_the_edges_of_its_steps(tmp_path: Path) -> None:
    """Also of light that goes off between pulses: the atoms fly meanwhile, and keep their state."""
    flight = "{lines: [traps_off, quadrature], duration: 5 us}"
    pulse = "parts: {flip: {lines: [microwave], duration: 25 us}, none: {lines: [push_out], duration: 0}, "
    pulse += f"block: {{repeat: 2, parts: {{fly: {flight}, wait: {{duration: 7.5 us}}}}}}, "
    pulse += "push: {lines: [push_out], duration: 50 us}}"
    taken = run(tmp_path, written(tmp_path, pulse), seed=1, overrides=[TRAPS_OFF, *SMALL_FRAMES])
    (shot,) = taken.shots
    edges = [(edge.line, edge.on, round(edge.t_s * 1e6, 6)) for edge in shot.edges]
    assert sorted(edges) == sorted(
        [("microwave", True, 0.0), ("microwave", False, 25.0), ("push_out", True, 50.0)]
        + [("push_out", False, 100.0)]
        + [(line, True, t) for line in ("traps_off", "quadrature") for t in (25.0, 37.5)]
        + [(line, False, t) for line in ("traps_off", "quadrature") for t in (30.0, 42.5)]
    )
    assert {(edge.step, edge.t_start_s) for edge in shot.edges} == {(2, shot.steps[2].t_start_s)}
    assert shot.steps[2].timed_by == "lines"
    assert shot.steps[2].achieved_s == pytest.approx(100e-6)
    n_before, n_after = (np.count_nonzero(occupancy) for occupancy in shot.occupancies)
    assert shot.readings["simulation.lost.push_out"] > 0.95 * n_before > 200
    assert n_after < 0.05 * n_before


@pytest.mark.parametrize(
    ("name", "times", "frequency_hz", "decay_s"),
    [
        ("rabi", "[0 us, 150 us, 7.5 us]", 20e3, 2 / (1 / 2e-3 + 1 / 0.2e-3)),
        ("ramsey", "[0 us, 400 us, 20 us]", 8e3, 0.2e-3),
    ],
)
def test_a_fit_finds_what_the_virtual_lab_was_given(
    name: str, times: str, frequency_hz: float, decay_s: float, tmp_path: Path
) -> None:
    sequence = tmp_path / "s.yaml"
    text = (
        (ROOT / "sequences" / f"{name}.yaml").read_text("utf-8").replace("detuning: 3 kHz", "detuning: 8 kHz")
    )
    sequence.write_text(re.sub(r"range: \[.*?\]", f"range: {times}", text), "utf-8")
    physics = "profile.simulation.qubit={relaxation_time: 2 ms, coherence_time: 0.2 ms}"
    taken = run(tmp_path, sequence, seed=1, overrides=[physics, *SMALL_FRAMES])
    found = taken.fit("survival:before,after", "damped_cosine").parameters
    for parameter, given, error in (("frequency", frequency_hz, 0.02), ("decay", decay_s, 0.3)):
        assert abs(found[parameter].value - given) < 3 * found[parameter].error, parameter
        assert found[parameter].error < error * given


def test_an_echo_finds_the_coherence_time_of_atoms_whose_detunings_differ(tmp_path: Path) -> None:
    text = (ROOT / "sequences" / "spin_echo.yaml").read_text("utf-8")
    (tmp_path / "s.yaml").write_text(
        re.sub(r"range: \[.*?\]", "range: [40 us, 800 us, 40 us]", text), "utf-8"
    )
    physics = "{relaxation_time: 2 ms, coherence_time: 0.2 ms, detuning_spread: 2 kHz}"
    overrides = [f"profile.simulation.qubit={physics}", *SMALL_FRAMES]
    taken = run(tmp_path, tmp_path / "s.yaml", seed=1, overrides=overrides)
    decay = taken.fit("survival:before,after", "exponential", free=["offset"]).parameters["decay"]
    assert abs(decay.value - 0.2e-3) < 2 * decay.error < 0.1e-3
