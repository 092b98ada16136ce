"""Tone programs written by hand, for tests of what they do to atoms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.model import AxisTones, MotionSpec, SiteGrid, ToneProgram

GRID = SiteGrid(5, 6)
ON = 1 / MotionSpec().max_row_tones
"""Amplitude of a tone at full depth."""

Tone = tuple[float, float, float, float]
"""Place at start and end (sites), amplitude at start and end."""


@dataclass
class ToneProgramBuilder:
    """A tone program in the making, in sites instead of hertz."""

    grid: SiteGrid = GRID
    segments: list[tuple[Sequence[Tone], Sequence[Tone]]] = field(default_factory=list[Any])

    def add(self, rows: Sequence[Tone], cols: Sequence[Tone]) -> ToneProgramBuilder:
        """Add a segment: tones of the rows and of the columns."""
        self.segments.append((rows, cols))
        return self

    def move(self, rows: Sequence[tuple[float, float]], cols: Sequence[tuple[float, float]]) -> ToneProgramBuilder:
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
