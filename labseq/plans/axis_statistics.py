"""Tones, voltages and powers of the samples of each axis."""

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
from labseq.motion import drive
from labseq.motion.axes import AXES, AxisIndex
from labseq.motion.rendering import FULL_SCALE, Renderer, RenderPath

CHUNK: Final = 1 << 18
"""Samples per chunk of the analysis (2 MB in float64)."""

BOTH: Final[tuple[AxisIndex, AxisIndex]] = (0, 1)
PATHS: Final = (RenderPath.COMB, RenderPath.BLENDED, RenderPath.DIRECT)


@dataclass(frozen=True, slots=True)
class AxisStatistics:
    """Tones, voltages and powers of one axis.

    Attributes:
        name: "row" or "column".
        max_tones: Maximum number of tones at once.
        frequency_hz: Lowest and highest frequency of a tone.
        band_hz: Lowest and highest frequency of the AOD.
        amplitude_sum: Highest sum of amplitudes, as a fraction of full scale.
        snapped_m: Maximum distance by which a tone was moved onto a comb, in the atom plane.
        peak_v: Highest voltage of a sample, across 50 Ohm, as full scale is given.
        peak_batch: Index of the batch with this sample.
        crest_factor: Highest ratio of peak to r.m.s. of the samples of a transport segment, where nothing is
            ramped. None if all are 0.
        crest_batch: Index of the batch with this crest factor.
        mean_power_w: Mean power into 50 Ohm while tones are on.
        highest_power_w: Highest short-term mean power, from the tones' amplitudes.
        aod_peak_v: Highest voltage after the amplifier, across 50 Ohm.
        aod_mean_power_w: Mean power at the AOD while tones are on.
        aod_highest_power_w: Highest short-term mean power at the AOD.
        path_share: Share of each render path in the samples with tones on, by name.
    """

    name: str
    max_tones: int
    frequency_hz: tuple[float, float]
    band_hz: tuple[float, float]
    amplitude_sum: float
    snapped_m: float
    peak_v: float
    peak_batch: int
    crest_factor: float | None
    crest_batch: int
    mean_power_w: float
    highest_power_w: float
    aod_peak_v: float
    aod_mean_power_w: float
    aod_highest_power_w: float
    path_share: Mapping[str, float]


def measure_axes(
    program: ToneProgram, renderer: Renderer, segments: range, grid: SiteGrid, motion: MotionSpec
) -> tuple[AxisStatistics, AxisStatistics]:
    """Compute the statistics of the samples of some segments, chunk by chunk, one thread per axis.

    Args:
        segments: Indices of its segments. At least one has tones.
        grid: The grid of sites of the program.
        motion: How the tweezers move.

    Returns:
        The row axis and the column axis.
    """
    on = [i for i in segments if program.kind[i] != SegmentKind.IDLE]

    def measure(axis: AxisIndex) -> AxisStatistics:
        rf, tones = motion.rf, (program.row, program.column)[axis]
        n_samples, volts = np.diff(renderer.first_sample)[on], rf.full_scale_v / FULL_SCALE
        peaks, energies = _scan(axis, renderer, on)
        carries = (program.kind[on] == SegmentKind.TRANSPORT) & (energies > 0.0)
        crests = np.sqrt(np.where(carries, peaks**2 * n_samples / np.where(carries, energies, 1.0), 0.0))
        loudest, sharpest = int(peaks.argmax()), int(crests.argmax())
        peak_v = float(volts * peaks[loudest])
        mean_power_w = float(volts**2 * energies.sum() / n_samples.sum() / LOAD_OHM)
        highest_power_w = _highest_power_w(tones, segments, rf)
        gain = 10 ** (rf.amplifier_gain_db / 10)  # of power, and its square root is the gain of voltage
        paths = {path.name.lower(): n_samples[renderer.path[axis, on] == path].sum() for path in PATHS}
        return AxisStatistics(
            name=AXES[axis],
            **_tone_statistics(tones, segments),
            max_tones=int(np.diff(tones.offsets)[on].max()),
            band_hz=(rf.row_band_hz, rf.column_band_hz)[axis],
            snapped_m=float(np.abs(drive(grid, motion, axis).comb_error_m).max(initial=0.0)),
            peak_v=peak_v,
            peak_batch=int(program.batch[on[loudest]]),
            crest_factor=float(crests[sharpest]) if carries.any() else None,
            crest_batch=int(program.batch[on[sharpest]]),
            mean_power_w=mean_power_w,
            highest_power_w=highest_power_w,
            aod_peak_v=peak_v * math.sqrt(gain),
            aod_mean_power_w=mean_power_w * gain,
            aod_highest_power_w=highest_power_w * gain,
            path_share={name: float(n / n_samples.sum()) for name, n in paths.items()},
        )

    with ThreadPoolExecutor(len(BOTH)) as threads:
        row, column = threads.map(measure, BOTH)
    return row, column


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


def _highest_power_w(tones: AxisTones, segments: range, rf: RfSpec) -> float:
    """The highest total power of the tones, which changes linearly in a segment."""
    squares = np.cumsum(np.square([tones.start_amplitude, tones.end_amplitude]), axis=1)
    sums = np.diff(np.concatenate([np.zeros((2, 1)), squares], axis=1)[:, tones.offsets], axis=1)
    return rf.full_scale_v**2 / (2 * LOAD_OHM) * float(sums[:, segments.start : segments.stop].max())


def _tone_statistics(tones: AxisTones, segments: range) -> dict[str, Any]:
    """Frequencies and highest sum of amplitudes."""
    from labseq.motion.tone_kernels import greatest_sum

    part = slice(tones.offsets[segments.start], tones.offsets[segments.stop])
    hz = np.concatenate([tones.start_hz[part], tones.end_hz[part]])
    values = np.stack(
        [tones.start_hz, tones.end_hz, tones.start_amplitude, tones.end_amplitude, tones.phase_rad]
    )
    bounds = [tones.offsets[i : i + 2].tolist() for i in segments]
    return {
        "frequency_hz": (float(hz.min()), float(hz.max())),
        "amplitude_sum": float(max(greatest_sum(values, first, last, 0.0) for first, last in bounds)),
    }
