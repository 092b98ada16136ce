from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.model import AxisTones, FrequencyCourse, ToneProgram
from labseq.testing.strategies import tone_programs

LINEAR, MINIMUM_JERK, CONSTANT_JERK = FrequencyCourse
COURSES = pytest.mark.parametrize("course", FrequencyCourse)
FINE = np.linspace(0.0, 1.0, 40_001)


def integrated(values: np.ndarray) -> np.ndarray:
    """Integral from 0 to each point of FINE, by the trapezoidal rule."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(FINE)
    return np.concatenate([[0.0], np.cumsum(steps)])


def one_tone(course: FrequencyCourse, start: float = 0.2, end: float = 0.4) -> ToneProgram:
    """A row tone that goes from 90 to 94 MHz in two segments, and none on the other axis."""
    offsets, none = np.array([0, 1, 2], np.int32), np.empty(0)
    hz, amplitude, phase = np.array([90e6, 92e6, 94e6]), np.array([0.0, start, end]), np.array([1.0, 2.0])
    row = AxisTones(offsets, hz[:-1], hz[1:], amplitude[:-1], amplitude[1:], phase)
    column = AxisTones(np.zeros(3, np.int32), none, none, none, none, none)
    kind, batch = np.array([1, 2], np.int8), np.zeros(2, np.int32)
    return ToneProgram(row, column, np.array([1e-4, 3e-4]), kind, batch, np.full(2, course, np.int8))


@COURSES
def test_a_course_goes_from_0_to_1_and_is_symmetric(course: FrequencyCourse) -> None:
    assert (course.fraction(0.0), course.fraction(1.0)) == (0.0, 1.0)
    assert course.integral(0.0) == 0.0
    assert course.integral(1.0) == pytest.approx(0.5)
    for u in FINE[::2000]:
        assert course.fraction(1 - u) == pytest.approx(1 - course.fraction(u))


@COURSES
def test_the_integral_of_a_course(course: FrequencyCourse) -> None:
    expected = integrated(np.array([course.fraction(u) for u in FINE]))
    assert [course.integral(u) for u in FINE[::1000]] == pytest.approx(expected[::1000], abs=1e-8)


def test_constant_jerk_is_what_it_says() -> None:
    acceleration = 6.0 + integrated(np.full(len(FINE), -12.0))
    way = integrated(integrated(acceleration))
    assert [CONSTANT_JERK.fraction(u) for u in FINE[::1000]] == pytest.approx(way[::1000], abs=1e-3)
    assert integrated(acceleration)[-1] == pytest.approx(0.0, abs=1e-3)  # at rest in the end


@pytest.mark.parametrize(("course", "fastest"), [(LINEAR, 1.0), (MINIMUM_JERK, 1.875), (CONSTANT_JERK, 1.5)])
def test_the_greatest_speed_of_a_course(course: FrequencyCourse, fastest: float) -> None:
    way = [course.fraction(u) for u in FINE]
    assert (np.diff(way) / np.diff(FINE)).max() == pytest.approx(fastest, rel=1e-6)


@COURSES
def test_tones_at_a_time(course: FrequencyCourse) -> None:
    tones = one_tone(course).tones_at(1e-4 + 0.75 * 3e-4)
    assert tones.row.frequency_hz == pytest.approx([92e6 + 2e6 * course.fraction(0.75)])
    assert tones.row.amplitude == pytest.approx([np.sqrt(0.04 + 0.75 * (0.16 - 0.04))])
    cycles = 92e6 * 0.75 * 3e-4 + 2e6 * 3e-4 * course.integral(0.75)
    assert np.exp(1j * tones.row.phase_rad) == pytest.approx(np.exp(1j * (2.0 + 2 * np.pi * cycles)))
    assert [len(values) for values in (tones.column.frequency_hz, tones.column.amplitude)] == [0, 0]


def test_a_ramp_is_linear_in_depth() -> None:
    program = one_tone(LINEAR)
    depth = [float(program.tones_at(t * 1e-4).row.amplitude[0]) ** 2 for t in (0.0, 0.25, 0.5)]
    assert depth == pytest.approx([0.0, 0.01, 0.02])


@settings(max_examples=25)
@given(tone_programs())
def test_at_a_joint_the_next_segment_has_begun(program: ToneProgram) -> None:
    for i, t_s in enumerate(program.joint_s[:-1].tolist()):
        at = program.tones_at(t_s)
        for now, axis in ((at.row, program.row), (at.column, program.column)):
            part = slice(axis.offsets[i], axis.offsets[i + 1])
            assert now.frequency_hz.tolist() == axis.start_hz[part].tolist()
            assert now.amplitude == pytest.approx(axis.start_amplitude[part])
            assert now.phase_rad == pytest.approx(axis.phase_rad[part] % (2 * np.pi))


@pytest.mark.parametrize("t_s", [-1e-9, 4e-4, 1.0, np.inf, -np.inf])
def test_before_the_program_and_from_its_end_on_there_are_no_tones(t_s: float) -> None:
    program = one_tone(LINEAR)
    assert program.joint_s == pytest.approx([0.0, 1e-4, 4e-4])
    assert len(program.tones_at(t_s).row.frequency_hz) == 0


def test_a_segment_without_length_is_passed_over() -> None:
    program = one_tone(LINEAR)
    short = ToneProgram(program.row, program.column, np.array([0.0, 1e-4]), program.kind, program.batch)
    assert short.course.tolist() == [LINEAR, LINEAR]
    assert short.tones_at(0.0).row.frequency_hz.tolist() == [92e6]


def test_no_number_is_no_time() -> None:
    with pytest.raises(ValueError, match="the time is not a number; expected seconds"):
        one_tone(LINEAR).tones_at(float("nan"))


@given(st.integers(1, 4))
def test_there_is_one_course_per_segment(n: int) -> None:
    program = one_tone(LINEAR)
    if n != 2:
        with pytest.raises(ValueError, match="course has shape"):
            ToneProgram(
                program.row, program.column, program.duration_s, program.kind, program.batch,
                np.zeros(n, np.int8),
            )  # fmt: skip
