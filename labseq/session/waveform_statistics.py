"""What the samples of a waveform put on each AOD, in numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.model import AxisTones, MotionSpec, RfSpec, SegmentKind, SiteGrid, ToneProgram
from labseq.model.motion import LOAD_OHM
from labseq.motion import Renderer, RenderPath, drive
from labseq.motion.axes import AXES, AxisIndex
from labseq.motion.rendering import FULL_SCALE

CHUNK: Final = 1 << 18
"""Samples that are looked at together: 2 MB in float64."""

BOTH: Final[tuple[AxisIndex, AxisIndex]] = (0, 1)
PATHS: Final = (RenderPath.COMB, RenderPath.BLENDED, RenderPath.DIRECT)


@dataclass(frozen=True, slots=True)
class AxisStatistics:
    """What one axis plays.

    Attributes:
        name: "row" or "column".
        max_tones: Most tones at once.
        lowest_hz: Lowest frequency of a tone.
        highest_hz: Highest frequency of a tone.
        band_hz: Lowest and highest frequency of the AOD.
        amplitude_sum: Highest sum of amplitudes, as a fraction of full scale.
        snapped_m: How far, at most, a tone was moved to be on a comb, in the atom plane.
        peak_v: Highest voltage of a sample, across 50 Ohm, as full scale is given.
        peak_batch: Index of the batch that has it.
        crest_factor: Highest peak over r.m.s. of the samples of a segment of transport, where
            nothing is ramped; None if all are 0.
        crest_batch: Index of the batch that has it.
        mean_power_w: Mean power into 50 Ohm while tones are on.
        highest_power_w: Mean power when it is highest, from the tones' amplitudes.
        gain_db: Power gain of the amplifier between output and AOD.
        path_share: Name of each render path -> the part of the samples with tones on that it makes.
    """

    name: str
    max_tones: int
    lowest_hz: float
    highest_hz: float
    band_hz: tuple[float, float]
    amplitude_sum: float
    snapped_m: float
    peak_v: float
    peak_batch: int
    crest_factor: float | None
    crest_batch: int
    mean_power_w: float
    highest_power_w: float
    gain_db: float
    path_share: Mapping[str, float]

    @property
    def gain(self) -> float:
        """Power gain as a factor."""
        return 10 ** (self.gain_db / 10)

    @property
    def aod_peak_v(self) -> float:
        """Highest voltage behind the amplifier, across 50 Ohm."""
        return self.peak_v * math.sqrt(self.gain)

    @property
    def aod_mean_power_w(self) -> float:
        """Mean power at the AOD while tones are on."""
        return self.mean_power_w * self.gain

    @property
    def aod_highest_power_w(self) -> float:
        """Mean power at the AOD when it is highest."""
        return self.highest_power_w * self.gain

    def as_dict(self) -> dict[str, Any]:
        """Everything, SI, JSON-ready."""
        return {
            "max_tones": self.max_tones,
            "frequency_hz": [self.lowest_hz, self.highest_hz],
            "band_hz": list(self.band_hz),
            "amplitude_sum": self.amplitude_sum,
            "snapped_m": self.snapped_m,
            "peak_v": self.peak_v,
            "peak_batch": self.peak_batch,
            "aod_peak_v": self.aod_peak_v,
            "crest_factor": self.crest_factor,
            "crest_batch": self.crest_batch,
            "mean_power_w": self.mean_power_w,
            "highest_power_w": self.highest_power_w,
            "aod_mean_power_w": self.aod_mean_power_w,
            "aod_highest_power_w": self.aod_highest_power_w,
            "path_share": dict(self.path_share),
        }


def measure(
    program: ToneProgram, renderer: Renderer, segments: range, grid: SiteGrid, motion: MotionSpec
) -> tuple[AxisStatistics, AxisStatistics]:
    """Look at the samples of some segments, chunk by chunk, one thread per axis.

    Args:
        program: The tone program.
        renderer: Renders it.
        segments: Which of its segments; at least one has tones.
        grid: The grid of sites that it was made for.
        motion: How the tweezers move.

    Returns:
        The row axis and the column axis.
    """

    def of_axis(axis: AxisIndex) -> AxisStatistics:
        return _measure_axis(axis, program, renderer, segments, grid, motion)

    with ThreadPoolExecutor(len(BOTH)) as threads:
        row, column = threads.map(of_axis, BOTH)
    return row, column


def _measure_axis(
    axis: AxisIndex,
    program: ToneProgram,
    renderer: Renderer,
    segments: range,
    grid: SiteGrid,
    motion: MotionSpec,
) -> AxisStatistics:
    tones, rf = (program.row, program.column)[axis], motion.rf
    part = slice(tones.offsets[segments.start], tones.offsets[segments.stop])
    hz = np.concatenate([tones.start_hz[part], tones.end_hz[part]])
    amplitude_sum, squares = _greatest(tones, segments)
    on = [i for i in segments if program.kind[i] != SegmentKind.IDLE]
    n_samples = np.diff(renderer.first_sample)[on]
    peaks, energies = _scan(axis, renderer, on)
    volts = rf.full_scale_v / FULL_SCALE
    rms_v = volts * math.sqrt(energies.sum() / n_samples.sum())
    carries = (program.kind[on] == SegmentKind.TRANSPORT) & (energies > 0.0)
    crests = np.sqrt(np.where(carries, peaks**2 * n_samples / np.where(carries, energies, 1.0), 0.0))
    loudest, sharpest = int(peaks.argmax()), int(crests.argmax())
    shares = {p.name.lower(): n_samples[renderer.path[axis, on] == p].sum() for p in PATHS}
    return AxisStatistics(
        name=AXES[axis],
        max_tones=int(np.diff(tones.offsets)[on].max()),
        lowest_hz=float(hz.min()),
        highest_hz=float(hz.max()),
        band_hz=(rf.row_band_hz, rf.column_band_hz)[axis],
        amplitude_sum=amplitude_sum,
        snapped_m=float(np.abs(drive(grid, motion, axis).comb_error_m).max(initial=0.0)),
        peak_v=float(volts * peaks[loudest]),
        peak_batch=int(program.batch[on[loudest]]),
        crest_factor=float(crests[sharpest]) if carries.any() else None,
        crest_batch=int(program.batch[on[sharpest]]),
        mean_power_w=rms_v**2 / LOAD_OHM,
        highest_power_w=squares * _full_scale_power_w(rf),
        gain_db=rf.amplifier_gain_db,
        path_share={name: float(n / n_samples.sum()) for name, n in shares.items()},
    )


def _scan(
    axis: AxisIndex, renderer: Renderer, segments: list[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Largest absolute sample of each segment, and the sum of their squares."""
    samples, values = np.empty(CHUNK, np.int16), np.empty(CHUNK, np.float64)
    peaks, energies = np.zeros(len(segments)), np.zeros(len(segments))
    for k, i in enumerate(segments):
        first, stop = (int(n) for n in renderer.first_sample[i : i + 2])
        for start in range(first, stop, CHUNK):
            n = min(CHUNK, stop - start)
            renderer.write(axis, start, samples[:n])
            values[:n] = samples[:n]
            peaks[k] = max(peaks[k], values[:n].max(), -values[:n].min())
            energies[k] += values[:n] @ values[:n]
    return peaks, energies


def _greatest(tones: AxisTones, segments: range) -> tuple[float, float]:
    """Highest sum of amplitudes in some segments, and of their squares, which is linear in time."""
    from labseq.kernels.tone_limits import greatest_sum

    values = np.stack(
        [tones.start_hz, tones.end_hz, tones.start_amplitude, tones.end_amplitude, tones.phase_rad]
    )
    squares = np.cumsum(np.square([tones.start_amplitude, tones.end_amplitude]), axis=1)
    sums = np.diff(np.concatenate([np.zeros((2, 1)), squares], axis=1)[:, tones.offsets], axis=1)
    bounds = [tones.offsets[i : i + 2].tolist() for i in segments]
    amplitude = max(greatest_sum(values, first, last, 0.0) for first, last in bounds)
    return float(amplitude), float(sums[:, segments.start : segments.stop].max())


def _full_scale_power_w(rf: RfSpec) -> float:
    """Mean power of one tone at full scale at the output, into 50 Ohm."""
    return rf.full_scale_v**2 / (2 * LOAD_OHM)
