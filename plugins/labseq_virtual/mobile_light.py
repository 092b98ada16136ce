"""The light of the mobile tweezers, as a camera sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import MotionSpec, RandomStream, SiteGrid, ToneProgram
from labseq.plugin.simulation import RfSpan
from labseq_virtual.formulas import full_amplitudes, full_volts
from labseq_virtual.rf_analysis import bands, track_tones
from labseq_virtual.settings import MobileLightSettings
from labseq_virtual.tone_positions import TonePositions

Floats = NDArray[np.float64]

SLEW_HZ: Final = 0.2e6
"""Largest change of frequency of a tone at rest in a transit time (ours)."""


@dataclass(frozen=True, slots=True, eq=False)
class MobileTones:
    """The tones that are on, with positions in sites and powers relative to the intended powers.

    Attributes:
        row: float64 (n_row_tones,), positions of the row tones.
        row_power: float64 (n_row_tones,).
        column: float64 (n_column_tones,).
        column_power: float64 (n_column_tones,).
    """

    row: Floats
    row_power: Floats
    column: Floats
    column_power: Floats


def with_true_response(
    grid: SiteGrid, motion: MotionSpec, light: MobileLightSettings, seed: int
) -> MotionSpec:
    """The motion with the amplitudes that really give the full depth, as each tone has its own response."""
    if light.tone_response == 0:
        return motion
    random = RandomStream(seed, "simulation.mobile_light").machine()
    true = [
        np.minimum(1.0, full * np.exp(-0.5 * light.tone_response * random.standard_normal(len(full))))
        for full in full_amplitudes(grid, motion)
    ]
    rf = replace(motion.rf, row_amplitudes=tuple(true[0].tolist()), column_amplitudes=tuple(true[1].tolist()))
    return replace(motion, rf=rf)


class MobileLight:
    """Finds the positions and powers of the mobile tweezers from a program, or from the played outputs.

    Args:
        grid: The grid of sites.
        motion: Motion of the tweezers, with the amplitudes that give the full depth.
        light: Settings of the light.
        positions: Positions of the light of each tone.
    """

    def __init__(
        self, grid: SiteGrid, motion: MotionSpec, light: MobileLightSettings, positions: TonePositions
    ) -> None:
        self._grid, self._light, self._positions = grid, light, positions
        self._full = full_amplitudes(grid, motion)
        self._full_v = full_volts(grid, motion)

    def of_program(self, program: ToneProgram, t_s: float) -> MobileTones | None:
        """The tones of a program at a time from its start. None if none is on."""
        now = program.tones_at(t_s)
        return self._tones(
            [(tones.frequency_hz, tones.amplitude) for tones in (now.row, now.column)], self._full
        )

    def of_outputs(
        self, rows: Sequence[RfSpan], columns: Sequence[RfSpan], now_s: float
    ) -> MobileTones | None:
        """The tones that the outputs have played just before a time. None if there are none."""
        tones: list[tuple[Floats, Floats]] = []
        transit_s = self._light.transit_time
        for spans, band, full_v in zip((rows, columns), bands(self._grid), self._full_v, strict=True):
            # six transit times of the sound, without tones weaker than 5 % of the full depth's (ours)
            start_s, min_v = now_s - 6.0 * transit_s, 0.05 * float(full_v.min())
            tracks = track_tones(spans, start_s, now_s, band, transit_s, min_v, SLEW_HZ)
            frame = len(tracks.t_s) // 2
            on = np.isfinite(tracks.frequency_hz[frame])
            tones.append((tracks.frequency_hz[frame, on], tracks.amplitude_v[frame, on]))
        return self._tones(tones, self._full_v)

    def positions_m(self, tones: MobileTones) -> Floats:
        """Tweezer positions, float64 (n_row_tones, n_column_tones, 2), (x, y) from the grid's centre."""
        a1, a2 = self._grid.axes
        row, column = tones.row[:, None, None], tones.column[None, :, None]
        return self._grid.positions_m[0, 0] + row * a2 + column * a1

    def _tones(self, tones: Sequence[tuple[Floats, Floats]], full: Sequence[Floats]) -> MobileTones | None:
        if not all(len(hz) for hz, _ in tones):
            return None
        parts: list[Floats] = []
        for axis, (hz, amplitude) in enumerate(tones):
            intended = self._positions.intended(axis, hz)
            full_amplitude = np.interp(intended, np.arange(len(full[axis])), full[axis])
            parts += [self._positions.actual(axis, hz), (amplitude / full_amplitude) ** 2]
        return MobileTones(*parts)
