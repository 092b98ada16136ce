"""Programs without movement, which probe the overlay with atoms and measure the tweezers' light."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.errors import LimitError
from labseq.model import AxisTones, MotionSpec, SegmentKind, SiteGrid, ToneProgram
from labseq.motion.axes import AXES, AxisIndex, Drive, drive
from labseq.motion.tones import AXIS_INDICES, check_limits, keyed_time_s
from labseq.units import format_quantity

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _Batch:
    """Row and column tones that are on together. ``offset_m`` is float64 (2,), along a1 and a2."""

    rows: Ints
    columns: Ints
    offset_m: Floats


@dataclass(frozen=True, slots=True)
class _Segment:
    """A segment of each batch, with amplitudes at its two ends as fractions of the full amplitude."""

    kind: SegmentKind
    time_s: float
    row: tuple[float, float]
    column: tuple[float, float]


def hold_program(
    grid: SiteGrid,
    motion: MotionSpec,
    sites: Mask,
    offset_m: ArrayLike,
    hold_s: float,
    drop_off_s: float | None = None,
) -> ToneProgram:
    """Pick atoms up, hold them and drop them, all displaced from their sites by an offset.

    Nothing moves. The tones of a batch stay at the frequencies of their sites plus an offset. Amplitudes,
    phases and times, except for the drop-off, are as in :func:`labseq.motion.tone_program`, and the columns'
    tones are ramped. A batch holds atoms of one row that have the same offset, as many at once as the motion
    allows, so that tones cross only on requested sites. A drop-off that is fast compared with the swing of
    the atoms releases them where they are. A slow drop-off leads many of them back.

    Args:
        grid: The grid of sites.
        motion: Ramps, overheads and limits of the tweezers.
        sites: bool (n_rows, n_cols), the sites to hold.
        offset_m: Offset of each tweezer from its site, along a1 (the columns' tones) and a2 (the rows').
            Shape (2,) for all, or (n_rows, n_cols, 2).
        hold_s: Time between the ramps, in seconds, or 0.
        drop_off_s: Duration of the drop-off, in seconds. By default the drop-off of the motion.

    Returns:
        The tones of both axes, with one or more batches for each row and offset.

    Raises:
        LimitError: A tone leaves its band, comes too near to another, or breaks another limit.
        ValueError: Sites or offsets do not have the grid's shape, or a value is not a number.
    """
    _check_band(grid, motion, sites, offset_m)
    batches = list(_batches(grid, motion, sites, offset_m))
    return _program(grid, motion, batches, _segments(motion, hold_s, drop_off_s))


def all_on_program(grid: SiteGrid, motion: MotionSpec, on_s: float) -> ToneProgram:
    """Switch the tones of all rows and all columns on, at their sites, and off again.

    Args:
        grid: The grid of sites.
        motion: Ramps, amplitudes and limits of the tweezers.
        on_s: Time between the ramps, in seconds, more than 0.

    Returns:
        The tones of both axes, in one batch.

    Raises:
        LimitError: The motion does not allow all tones at once, or a tone breaks another limit.
    """
    for name, n, max_tones in zip(
        AXES, grid.shape, (motion.max_row_tones, motion.max_column_tones), strict=True
    ):
        if n > max_tones:
            limit = f"{max_tones}, `max_{name}_tones` of the profile"
            raise LimitError(f"the number of {name} tones to measure at once", n, limit)
    all_tones = _Batch(np.arange(grid.n_rows), np.arange(grid.n_cols), np.zeros(2))
    return _program(grid, replace(motion, overhead_per_batch_s=0.0), [all_tones], _segments(motion, on_s))


def hold_time_s(
    grid: SiteGrid,
    motion: MotionSpec,
    offset_m: ArrayLike,
    hold_s: float,
    drop_off_s: float | None = None,
) -> float:
    """Longest playing time of a :func:`hold_program`, which holds every site of the grid.

    Raises:
        LimitError: The offset moves the tone of a site out of its band.
    """
    all_sites = np.ones(grid.shape, np.bool_)
    _check_band(grid, motion, all_sites, offset_m)
    n_batches = sum(1 for _ in _batches(grid, motion, all_sites, offset_m))
    return n_batches * sum(segment.time_s for segment in _segments(motion, hold_s, drop_off_s))


def cross_offsets_m(shape: tuple[int, int], offset_m: ArrayLike) -> Floats:
    """Offsets of four groups of sites: +x and -x along a1 in even rows, +y and -y along a2 in odd ones.

    In each row, even columns go forward and odd columns back. So each group holds a quarter of the sites,
    spread over the whole grid.

    Args:
        shape: (n_rows, n_cols).
        offset_m: float64 (2,), x and y.

    Returns:
        float64 (n_rows, n_cols, 2).

    Example:
        >>> cross_offsets_m((2, 2), (0.9, 0.8)).tolist()
        [[[0.9, 0.0], [-0.9, 0.0]], [[0.0, 0.8], [0.0, -0.8]]]
    """
    row, col = np.indices(shape)
    sign = 1.0 - 2.0 * (col % 2)
    along = np.stack([row % 2 == 0, row % 2 == 1], axis=-1)
    return np.where(along, sign[..., None] * np.asarray(offset_m, np.float64), 0.0)


def _check_band(grid: SiteGrid, motion: MotionSpec, sites: Mask, offset_m: ArrayLike) -> None:
    """Refuse an offset at which the tone of a site leaves its band, without a kernel."""
    if np.shape(sites) != grid.shape:
        raise ValueError(f"sites has shape {np.shape(sites)}; expected {grid.shape}")
    offsets = np.broadcast_to(np.asarray(offset_m, np.float64), (*grid.shape, 2))
    if not np.isfinite(offsets).all():
        raise ValueError("an offset is not a number")
    for axis in AXIS_INDICES:
        driven = drive(grid, motion, axis)
        along_m = offsets[..., 1 - axis]
        site_hz = driven.site_hz[:, None] if axis == 0 else driven.site_hz
        hz = site_hz + driven.step_hz * along_m / grid.spacing_m
        low_hz, high_hz = (motion.rf.row_band_hz, motion.rf.column_band_hz)[axis]
        outside = np.argwhere(sites & ((hz < low_hz) | (hz > high_hz)))
        if len(outside):
            site = tuple(outside[0])
            at = format_quantity(float(along_m[site]), "length")
            raise LimitError(
                f"the frequency of the tone of {AXES[axis]} {site[axis]} at an offset of {at}",
                f"{hz[site] / 1e6:.6g} MHz",
                f"the band of {low_hz / 1e6:.6g} to {high_hz / 1e6:.6g} MHz",
                "choose a smaller offset, or sites further from the edge",
            )


def _batches(grid: SiteGrid, motion: MotionSpec, sites: Mask, offset_m: ArrayLike) -> Iterator[_Batch]:
    offsets = np.broadcast_to(np.asarray(offset_m, np.float64), (*grid.shape, 2))
    kinds, of_kind = np.unique(offsets.reshape(-1, 2), axis=0, return_inverse=True)
    of_kind = of_kind.reshape(grid.shape)
    most = min(motion.max_tweezers, motion.max_column_tones)
    for row in range(grid.n_rows):
        columns = np.flatnonzero(sites[row])
        for i in sorted({*of_kind[row, columns].tolist()}):
            together = columns[of_kind[row, columns] == i]
            for first in range(0, len(together), most):
                yield _Batch(np.array([row]), together[first : first + most], kinds[i])


def _segments(motion: MotionSpec, hold_s: float, drop_off_s: float | None = None) -> list[_Segment]:
    """The segments of a batch. The rows' tones are keyed, like the tones of the parked axis in a move."""
    drop_off_s = motion.drop_off_s if drop_off_s is None else drop_off_s
    for name, time_s in (("hold", hold_s), ("drop off", drop_off_s)):
        if not 0 <= time_s < float("inf"):
            raise ValueError(f"the time to {name} is {time_s} s; expected 0 or more")
    up_s, down_s = (keyed_time_s(time_s) for time_s in (motion.pick_up_s, drop_off_s))
    up, down = (
        math.sqrt(part_s / time_s) if time_s > 0 else 1.0
        for part_s, time_s in ((up_s, motion.pick_up_s), (down_s, drop_off_s))
    )
    segments = [
        _Segment(SegmentKind.IDLE, motion.overhead_per_batch_s, (0.0, 0.0), (0.0, 0.0)),
        _Segment(SegmentKind.PICK_UP, up_s, (0.0, 1.0), (0.0, up)),
        _Segment(SegmentKind.PICK_UP, motion.pick_up_s - up_s, (1.0, 1.0), (up, 1.0)),
        _Segment(SegmentKind.TRANSPORT, hold_s, (1.0, 1.0), (1.0, 1.0)),
        _Segment(SegmentKind.DROP_OFF, drop_off_s - down_s, (1.0, 1.0), (1.0, down)),
        _Segment(SegmentKind.DROP_OFF, down_s, (1.0, 0.0), (down, 0.0)),
    ]
    optional = SegmentKind.IDLE, SegmentKind.TRANSPORT
    return [segment for segment in segments if segment.time_s > 0 or segment.kind not in optional]


def _program(
    grid: SiteGrid, motion: MotionSpec, batches: list[_Batch], segments: list[_Segment]
) -> ToneProgram:
    """The program that plays the same segments for each batch."""
    kinds = np.array([segment.kind for segment in segments], np.int8)
    times_s = [segment.time_s for segment in segments]
    batch = np.repeat(np.arange(len(batches), dtype=np.int32), len(segments))
    rows, columns = (
        _axis(axis, drive(grid, motion, axis), motion, grid.spacing_m, batches, segments, batch)
        for axis in AXIS_INDICES
    )
    n = len(batches)
    return ToneProgram(rows, columns, np.tile(times_s, n), np.tile(kinds, n), batch)


def _axis(
    axis: AxisIndex,
    driven: Drive,
    motion: MotionSpec,
    spacing_m: float,
    batches: list[_Batch],
    segments: list[_Segment],
    batch: NDArray[np.int32],
) -> AxisTones:
    """The tones of an axis over all batches, checked against its limits."""
    sounding = np.array([segment.kind != SegmentKind.IDLE for segment in segments])
    times_s = np.array([segment.time_s for segment in segments])
    before_s = np.cumsum(np.where(sounding, times_s, 0.0)) - times_s
    columns: list[Floats] = [np.empty((5, 0))]
    n_tones: list[int] = [0]
    for current_batch in batches:
        tones = current_batch.rows if axis == 0 else current_batch.columns
        shift_hz = driven.step_hz * current_batch.offset_m[1 - axis] / spacing_m  # offsets are along a1, a2
        hz = driven.site_hz[tones] + shift_hz
        first = _first_phases(tones, driven, motion)
        for i, segment in enumerate(segments):
            n_tones.append(n_tones[-1] + (len(tones) if sounding[i] else 0))
            if sounding[i]:
                level = segment.column if axis else segment.row
                start, end = (driven.amplitude[tones] * factor for factor in level)
                columns.append(np.stack([hz, hz, start, end, (first + hz * before_s[i]) % 1.0]))
    values, offsets = np.ascontiguousarray(np.hstack(columns)), np.array(n_tones, np.int32)
    check_limits(axis, driven, motion.rf, batch, offsets, values)
    start_hz, end_hz, start, end, phase = values
    return AxisTones(offsets, start_hz, end_hz, start, end, 2 * np.pi * phase)


def _first_phases(tones: Ints, driven: Drive, motion: MotionSpec) -> Floats:
    """Phases of the tones of a batch when they switch on, in cycles."""
    from labseq.motion.tone_kernels import first_phases

    phase = np.empty(len(tones))
    both_ends = np.ascontiguousarray(np.stack([tones, tones]).astype(np.int64))
    low_crest = motion.rf.phases == "low_crest"
    first_phases(both_ends, len(tones), driven.phase, low_crest, driven.amplitude, phase)
    return phase
