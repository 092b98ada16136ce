"""Limits of what drivers of tweezers send to their outputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from labseq.errors import LimitError
from labseq.model import Plan, ToneProgram
from labseq.motion import tone_program
from labseq.plugin.tweezers import check_amplitudes, check_ramp, check_tone_program

BANDS = (82e6, 118e6), (80e6, 120e6)
PROGRAM = tone_program(Plan.from_batches([([(0, 0), (0, 2)], [(0, 3), (0, 5)]), ([(2, 1)], [(4, 1)])]))


def changed(axis: str, name: str, value: Any, tone: int = 5) -> ToneProgram:
    """The program with another value of one of its tones."""
    tones = getattr(PROGRAM, axis)
    values = getattr(tones, name).copy()
    values[tone] = value
    return replace(PROGRAM, **{axis: replace(tones, **{name: values})})


def test_a_program_at_its_limits_is_taken() -> None:
    check_tone_program("awg", PROGRAM, *BANDS)
    check_tone_program("awg", changed("row", "end_hz", 118e6), *BANDS)
    loudest = float(PROGRAM.row.start_amplitude.max())
    check_tone_program("awg", changed("row", "start_amplitude", loudest), *BANDS, most=2 * loudest)


@pytest.mark.parametrize(
    ("axis", "name", "value", "text"),
    [
        ("row", "start_hz", 81e6, r"frequency of row tone \d in segment \d \(batch \d\) is 81 MHz; .* 82 to"),
        ("column", "end_hz", 120.1e6, r"frequency of column tone .* is 120\.1 MHz; .* 80 to 120 MHz"),
        ("row", "start_hz", np.nan, "frequency of row tone .* is nan"),
        ("row", "start_amplitude", 1.5, r"amplitude of row tone .* is 1\.5 of full scale; .* 0 to 1"),
        ("column", "end_amplitude", -0.1, r"amplitude of column tone .* is -0\.1"),
        ("row", "phase_rad", np.inf, "phase of row tone .* is inf"),
    ],
)
def test_a_tone_beyond_its_limits_is_named(axis: str, name: str, value: float, text: str) -> None:
    with pytest.raises(LimitError, match=f"awg: {text}"):
        check_tone_program("awg", changed(axis, name, value), *BANDS)


def test_a_tone_is_named_that_is_beyond_the_band_by_rounding() -> None:
    end_hz = 128.3e6  # the next number is the same in MHz
    beyond = changed("row", "start_hz", np.nextafter(end_hz, np.inf))
    with pytest.raises(LimitError, match="frequency of row tone"):
        check_tone_program("awg", beyond, (82e6, end_hz), BANDS[1])


@pytest.mark.parametrize("name", ["start_amplitude", "end_amplitude"])
def test_tones_that_clip_only_together_are_refused(name: str) -> None:
    n_tones = np.diff(PROGRAM.column.offsets)
    segment = int(n_tones.argmax())
    loud = np.zeros_like(PROGRAM.column.start_amplitude)
    loud[PROGRAM.column.offsets[segment] : PROGRAM.column.offsets[segment + 1]] = 1.01 / n_tones[segment]
    clipping = replace(PROGRAM, column=replace(PROGRAM.column, **{name: loud}))
    where = rf"sum of the column amplitudes in segment {segment} \(batch 0\)"
    with pytest.raises(LimitError, match=rf"{where} is 1\.01 of full scale; .* the output clips"):
        check_tone_program("awg", clipping, *BANDS)


@pytest.mark.parametrize(
    ("factor", "text"), [(0.0, "length"), (np.inf, "duration"), (np.nan, "duration"), (-1.0, "duration")]
)
def test_a_program_of_no_length_is_refused(factor: float, text: str) -> None:
    with pytest.raises(LimitError, match=text):
        check_tone_program("awg", replace(PROGRAM, duration_s=PROGRAM.duration_s * factor), *BANDS)


@pytest.mark.parametrize(
    ("rows", "cols", "what"),
    [
        ([0.1, 0.1], [0.1, 0.1], "shape of the column amplitudes"),
        ([0.1, np.nan], [0.1] * 3, "a row amplitude"),
        ([0.1, -0.1], [0.1] * 3, "a row amplitude"),
    ],
)
def test_impossible_amplitudes_are_refused(rows: list[float], cols: list[float], what: str) -> None:
    with pytest.raises(LimitError, match=what):
        check_amplitudes("array", (np.array(rows), np.array(cols)), (2, 3))


@pytest.mark.parametrize(("depth", "duration_s"), [(2.0, 0.0), (1.0, -1.0), (np.nan, 0.0), (1.0, np.inf)])
def test_an_impossible_ramp_is_refused(depth: float, duration_s: float) -> None:
    with pytest.raises(LimitError, match="array"):
        check_ramp("array", depth, duration_s, 1.5)
