"""Tone programs, and what an ideal card plays of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

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
    """An ``RfSource`` that has played everything already; it returns each span once."""

    def __init__(self, spans: tuple[list[RfSamples], list[RfSamples]]) -> None:
        self._spans = spans

    def played(self, until_s: float) -> tuple[list[RfSamples], list[RfSamples]]:
        """All spans, at the first call."""
        spans_played, self._spans = self._spans, ([], [])
        assert all(span.end_s <= until_s + 1e-9 for spans in spans_played for span in spans)
        return spans_played


def with_phase_jump(program: ToneProgram, segment: int, size_rad: float) -> ToneProgram:
    """The program, with all column tones shifted in phase from a segment on."""
    column = program.column
    phase_rad = column.phase_rad.copy()
    phase_rad[column.offsets[segment] :] += size_rad
    return replace(program, column=replace(column, phase_rad=phase_rad))


PROGRAM_GRID = SiteGrid(5, 6)
ON = 1 / MotionSpec().max_row_tones
"""Amplitude of a tone at full depth."""

Tone = tuple[float, float, float, float]
"""Place at start and end (sites), amplitude at start and end."""


@dataclass
class ToneProgramBuilder:
    """A tone program in the making, in sites instead of hertz."""

    grid: SiteGrid = PROGRAM_GRID
    segments: list[tuple[Sequence[Tone], Sequence[Tone]]] = field(default_factory=list[Any])

    def add(self, rows: Sequence[Tone], cols: Sequence[Tone]) -> ToneProgramBuilder:
        """Add a segment: tones of the rows and of the columns."""
        self.segments.append((rows, cols))
        return self

    def move(
        self, rows: Sequence[tuple[float, float]], cols: Sequence[tuple[float, float]]
    ) -> ToneProgramBuilder:
        """Pick up with a ramp of the column tones, transport, drop off."""
        moving_rows = [(a, b, ON, ON) for a, b in rows]
        self.add([(a, a, ON, ON) for a, _ in rows], [(a, a, 0.0, ON) for a, _ in cols])
        self.add(moving_rows, [(a, b, ON, ON) for a, b in cols])
        return self.add([(b, b, ON, ON) for _, b in rows], [(b, b, ON, 0.0) for _, b in cols])

    def program(self, segment_s: float = 1e-3) -> ToneProgram:
        """The program, each segment of the same duration."""
        n = len(self.segments)
        return ToneProgram(
            self._axis(0, self.grid.row_frequency_hz),
            self._axis(1, self.grid.column_frequency_hz),
            np.full(n, segment_s),
            np.zeros(n, np.int8),
            np.zeros(n, np.int32),
        )

    def _axis(self, axis: int, hz: NDArray[np.float64]) -> AxisTones:
        tones = [np.array(segment[axis], float).reshape(-1, 4) for segment in self.segments]
        start, end, on, off = np.concatenate(tones or [np.empty((0, 4))]).T
        offsets = np.cumsum([0, *map(len, tones)]).astype(np.int32)
        step = hz[1] - hz[0] if len(hz) > 1 else 1.6e6
        return AxisTones(offsets, hz[0] + start * step, hz[0] + end * step, on, off, np.zeros(len(on)))
