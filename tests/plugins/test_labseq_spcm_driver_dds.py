"""The Spectrum driver in mode ``dds``: the card makes the tones itself."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.simulator import Span, Tone, ToneSpan

from labseq import ConfigError, Context, LimitError, MotionSpec, Plan, TransientError
from labseq.motion import tone_program

MOTION = MotionSpec(max_row_tones=16, max_column_tones=5)


def _start_s(lab: Any) -> float:
    """When the program began: its first tones come after the pause of the first batch."""
    return lab.card.played(0)[0].start_s - lab.motion.overhead_per_batch_s


def _tones_at(spans: list[Span], at_s: float) -> list[Tone]:
    now = [span for span in spans if span.start_s <= at_s < span.end_s]
    return [tone.after(at_s - s.start_s) for s in now if isinstance(s, ToneSpan) for tone in s.tones]


def _apart(sine_rad: float, cosine_rad: float) -> float:
    """The distance of the card's phase, of a sine, from the program's, of a cosine."""
    return abs(math.remainder(sine_rad - np.pi / 2 - cosine_rad, 2 * np.pi))


class TestTones:
    def test_are_those_of_the_program(self, driver: Any) -> None:
        with driver("dds") as lab:
            program = lab.program(4)
            lab.play(program)
            start_s = _start_s(lab)
            spans = [lab.card.played(channel) for channel in (0, 1)]
            for at_s in np.linspace(0, program.total_duration_s, 997)[1:-1]:
                if np.abs(program.joint_s - at_s).min() < 1e-6:
                    continue
                now = program.tones_at(at_s)
                axes = (program.row, now.row), (program.column, now.column)
                for channel, (axis, wanted) in enumerate(axes):
                    most = axis.start_amplitude.max()
                    tones = _tones_at(spans[channel], start_s + at_s)
                    for hz, amplitude, phase_rad in zip(
                        wanted.frequency_hz, wanted.amplitude, wanted.phase_rad, strict=True
                    ):
                        tone = min(tones, key=lambda tone: abs(tone.frequency_hz - hz))
                        assert abs(tone.frequency_hz - hz) < 5
                        assert abs(tone.amplitude**2 - amplitude**2) < 0.006 * most**2
                        assert _apart(tone.phase_rad, phase_rad) < 0.01

    @pytest.mark.parametrize("course", ["minimum_jerk", "constant_jerk"])
    def test_follow_other_courses_of_speed(self, driver: Any, course: Any) -> None:
        with driver("dds", motion=replace(MOTION, speed_profile=course)) as lab:
            program = lab.program(1)
            lab.play(program)
            start_s = _start_s(lab)
            transport = int(np.flatnonzero(program.kind == 2)[0])
            spans = lab.card.played(1)
            first_s, last_s = program.joint_s[transport], program.joint_s[transport + 1]
            for at_s in np.linspace(first_s, last_s, 101)[1:-1]:
                wanted = np.sort(program.tones_at(at_s).column.frequency_hz)
                tones = np.sort([tone.frequency_hz for tone in _tones_at(spans, start_s + at_s)])
                assert np.abs(tones - wanted).max() < 0.05 * 1.6e6

    def test_are_silent_at_the_end(self, driver: Any) -> None:
        with driver("dds") as lab:
            program = lab.program()
            lab.play(program)
            ends = [span.end_s for channel in (0, 1) for span in lab.card.played(channel)]
            assert max(ends) <= _start_s(lab) + program.total_duration_s + 1e-7
            assert not lab.card.running

    def test_of_a_program_larger_than_the_queue_are_sent_while_it_plays(self, driver: Any) -> None:
        with driver("dds") as lab:
            program = lab.program(100)
            lab.tweezers.prepare(program)
            assert lab.card.read(608006)[1] <= 4096
            lab.tweezers.play()
            lab.tweezers.wait(1.0)
            last = lab.card.played(0)[-1]
            assert last.end_s == pytest.approx(_start_s(lab) + program.total_duration_s, abs=1e-7)

    def test_that_come_too_late_are_an_error(self, driver: Any) -> None:
        with driver("dds") as lab:
            lab.tweezers.prepare(lab.program(100))
            lab.tweezers.play()
            lab.clock.sleep(0.5)
            with pytest.raises(TransientError, match="no commands in time"):
                lab.tweezers.wait(1.0)
            assert lab.card.outputs_on == (False, False)

    def test_jump_in_phase_where_the_program_does(self, driver: Any) -> None:
        with driver("dds") as lab:
            program = lab.program(1)
            phase_rad = program.row.phase_rad.copy()
            phase_rad[int(program.row.offsets[2]) :] += 1.0
            jumping = replace(program, row=replace(program.row, phase_rad=phase_rad))
            lab.play(jumping)
            at_s = program.joint_s[2] + 5e-6
            (tone,) = _tones_at(lab.card.played(0), _start_s(lab) + at_s)
            wanted = jumping.tones_at(at_s).row.phase_rad[0]
            assert _apart(tone.phase_rad, wanted) < 0.05

    def test_step_in_a_ramp_of_no_length(self, driver: Any) -> None:
        with driver("dds", motion=replace(MOTION, pick_up_s=0.0)) as lab:
            lab.play(lab.program(1))
            assert lab.card.played(0)

    def test_for_less_time_than_the_timer_can_do_are_refused(self, driver: Any) -> None:
        with (
            driver("dds", motion=replace(MOTION, pick_up_s=20e-9)) as lab,
            pytest.raises(LimitError, match=r"83\.2 ns"),
        ):
            lab.tweezers.prepare(lab.program(1))


class TestNumberOfTones:
    @pytest.mark.parametrize(("rows", "columns"), [(20, 20), (17, 2), (1, 6), (21, 1)])
    def test_profiles_with_more_tones_than_it_has_are_refused(
        self, driver: Any, rows: int, columns: int
    ) -> None:
        settings = SpcmSettings(card="simulated", mode="dds")
        motion = MotionSpec(max_row_tones=rows, max_column_tones=columns)
        with pytest.raises(ConfigError, match=r"20 \+ 1 or 16 \+ 5"):
            SpcmMobileTweezers(settings, Context(motion=motion))

    @pytest.mark.parametrize(
        ("rows", "columns", "row_channel"), [(20, 1, 0), (16, 5, 0), (5, 16, 1), (1, 20, 1)]
    )
    def test_profiles_within_its_tones_are_taken(
        self, driver: Any, rows: int, columns: int, row_channel: int
    ) -> None:
        motion = MotionSpec(max_row_tones=rows, max_column_tones=columns)
        with driver("dds", motion=motion, row_channel=row_channel, column_channel=1 - row_channel) as lab:
            plan = Plan.from_batches([([(0, 0)], [(0, 3)])])
            lab.play(tone_program(plan, motion=motion))
            assert lab.card.played(0)
            assert lab.card.played(1)

    def test_of_programs_are_refused_beyond_those_it_has(self, driver: Any) -> None:
        with driver("dds") as lab:
            wide = [([(0, col) for col in range(6)], [(0, col + 1) for col in range(6)])]
            program = tone_program(Plan.from_batches(wide))
            with pytest.raises(LimitError, match="16 and 5"):
                lab.tweezers.prepare(program)
