"""Tone programs, and what an ideal card plays of them: for tests of simulations that listen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

from labseq.model import AxisTones, MotionSpec, Plan, RfSamples, RfSpec, SiteGrid, ToneProgram
from labseq.motion import tone_program
from labseq.motion.rendering import render

FULL_SCALE_V = 0.2
RATE_HZ = 624e6
START_S = 3.0
"""When the programs start, on the session's clock."""
GRID = SiteGrid()

SitePairs = tuple[list[tuple[int, int]], list[tuple[int, int]]]
"""The sources and the goals of a batch."""


def spec(**changes: float | str) -> MotionSpec:
    """The paper's motion, at the volts of a real card."""
    rf = RfSpec(full_scale_v=FULL_SCALE_V, max_peak_v=FULL_SCALE_V)
    return replace(MotionSpec(rf=rf), **cast("dict[str, Any]", changes))


def program_of(*batches: SitePairs, **changes: float | str) -> ToneProgram:
    """The tone program of some batches, each (sources, goals)."""
    return tone_program(Plan.from_batches(list(batches)), GRID, spec(**changes))


def played(program: ToneProgram, start_s: float = START_S) -> tuple[list[RfSamples], list[RfSamples]]:
    """What a card puts out for a program: one span for each axis."""
    samples = render(program, RATE_HZ).samples
    row, column = (RfSamples(start_s, RATE_HZ, samples[i], FULL_SCALE_V / 32767) for i in (0, 1))
    return [row], [column]


class PlayedRfSource:
    """An ``RfSource`` that has played everything already; each span is told once."""

    def __init__(self, spans: tuple[list[RfSamples], list[RfSamples]]) -> None:
        self._spans = spans

    def played(self, until_s: float) -> tuple[list[RfSamples], list[RfSamples]]:
        """All spans, at the first call."""
        told, self._spans = self._spans, ([], [])
        assert all(span.end_s <= until_s + 1e-9 for spans in told for span in spans)
        return told


def with_phase_jump(program: ToneProgram, segment: int, size_rad: float) -> ToneProgram:
    """The program, with all column tones shifted in phase from a segment on."""
    column = program.column
    phase_rad = column.phase_rad.copy()
    phase_rad[column.offsets[segment] :] += size_rad
    return replace(
        program,
        column=AxisTones(
            column.offsets,
            column.start_hz,
            column.end_hz,
            column.start_amplitude,
            column.end_amplitude,
            phase_rad,
        ),
    )
