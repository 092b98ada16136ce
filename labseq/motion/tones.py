"""Turns a checked plan into the tones of each axis, within the limits of the AODs."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, get_args

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError, PlanError
from labseq.model import AxisTones, MotionSpec, Plan, PlanReport, RfSpec, SiteGrid, ToneProgram
from labseq.model.motion import SpeedProfile
from labseq.motion.axes import AXES, AxisIndex, Drive, drive

AXIS_INDICES: Final[tuple[AxisIndex, AxisIndex]] = (0, 1)
"""Index of the row tones, index of the column tones."""

SPEED_PROFILES: Final[tuple[SpeedProfile, ...]] = get_args(SpeedProfile)
"""The speed profiles, in the order of :class:`labseq.model.FrequencyCourse`."""


def site_time_s(grid: SiteGrid, motion: MotionSpec) -> float:
    """Time to move an atom by one site, in seconds.

    If the speed is not constant, this is the mean time over the longest path of a batch, so a batch takes
    the same time with every speed profile.

    Example:
        >>> round(site_time_s(SiteGrid(), MotionSpec()), 9)
        3.4538e-05
    """
    return grid.spacing_m / motion.speed_m_s


def keyed_time_s(ramp_s: float) -> float:
    """Time over which the tones of the parked axis are switched, within a ramp of the other axis."""
    # an abrupt switch would put more than a hundred times as much power outside the AOD's band
    return min(2e-6, 0.5 * ramp_s)


def fitting_batches(report: PlanReport, plan: Plan, window_s: float) -> int:
    """Count the leading batches that end within a time window.

    A chain of linked batches is never cut.

    Args:
        report: The checked plan's report.
        plan: The plan.
        window_s: Time from the start of the cycle, in seconds.

    Returns:
        How many batches can be played, for :meth:`Plan.first`.
    """
    in_time = report.batch_end_s <= window_s + 1e-9  # sums may be rounded up
    ends_chain = np.append(~plan.linked[1:], True)
    fitting = np.flatnonzero(in_time & ends_chain[: plan.n_batches])
    return int(fitting[-1]) + 1 if len(fitting) else 0


@lru_cache(maxsize=16)
def default_grid(n_rows: int, n_cols: int) -> SiteGrid:
    """A grid of the paper's spacing in any shape."""
    return SiteGrid(n_rows, n_cols)


@lru_cache(maxsize=16)
def path_geometry(grid: SiteGrid, motion: MotionSpec) -> NDArray[np.float64]:
    """Distances and angle that :func:`labseq.motion.check_kernels.check` and the tones need, float64 (4,)."""
    a1, a2 = grid.axes / grid.spacing_m
    clearance, cosine = motion.clearance_m / grid.spacing_m, float(a1 @ a2)
    across = clearance / math.sqrt(1.0 - cosine**2)  # lines are nearer to one another than their sites
    geometry = np.array([clearance, cosine, across, motion.empty_tweezers_may_land], np.float64)
    geometry.flags.writeable = False
    return geometry


@lru_cache(maxsize=16)
def _times_s(grid: SiteGrid, motion: MotionSpec) -> NDArray[np.float64]:
    """The times that ``build_axis`` needs."""
    ramps_s, site_s = (motion.pick_up_s, motion.drop_off_s), site_time_s(grid, motion)
    times_s = [motion.overhead_per_batch_s, ramps_s[0], site_s, ramps_s[1], *map(keyed_time_s, ramps_s)]
    return np.array(times_s)


def tone_program(
    plan: Plan,
    grid: SiteGrid | None = None,
    motion: MotionSpec | None = None,
    n_batches: int | None = None,
) -> ToneProgram:
    """Turn a checked plan into a tone program, with the paper's timing.

    Each batch has a pause without tones, the pick-up, the transport and the drop-off. The pause is the
    overhead of a batch. The overhead of the cycle has passed before anything plays. A transport at constant
    speed is cut wherever a tone arrives. With another speed profile all tones start and arrive together, each
    on its own path. The longest path of the batch has the mean speed of the setting, so the batch lasts
    as long as at constant speed. At pick-up and drop-off the tones of the axis that moves are ramped,
    linearly in trap depth. The tones of the other axis are switched on and off over 2 us at the two ends of
    the batch. There is no drop-off, pause or pick-up between linked batches.

    In a batch with paths of tones each leg is a segment, whose longest path has the set mean speed.
    Frequency and amplitude squared are interpolated between sites. Row tones are ramped. At a knot before the
    last, the tones that go off there are ramped while the others wait. The row tones are weaker by the square
    root of ``path_depth``.

    Each site's tone has a preassigned amplitude. By default all are equal, and the largest number of tones of
    an axis reaches full scale. During a transport at constant speed the amplitude squared changes linearly
    from each site to the next, and with another speed profile from the source to the goal. Phases start as
    preassigned or chosen and are continuous within a batch and a chain. Beyond the grid's edge frequencies
    continue linearly, and amplitudes stay constant. Calibrated tones that are all within ``rf.snap_within_m``
    of a comb are played on it (see :func:`labseq.motion.drive` for how far they were moved).

    Args:
        plan: A plan that :func:`check_plan` accepted.
        grid: The grid of sites. By default the grid of the paper.
        motion: How the tweezers move. By default as in the paper.
        n_batches: How many batches to play, from the first. By default all.

    Returns:
        The tones of both axes.

    Raises:
        PlanError: The plan does not fit on the grid, or has fewer batches than requested.
        LimitError: Tones break a limit of AOD or amplifier (band, number, spacing, sum of amplitudes, peak
            voltage, mean power), or the number of amplitudes is not the number of sites.
    """
    from labseq.motion.tone_kernels import N_FIELDS, NOT_ON_GRID, PHASE, build_axis, room_for

    grid = grid or default_grid(20, 20)
    motion = motion or MotionSpec()
    n_batches = plan.n_batches if n_batches is None else n_batches
    if not 0 <= n_batches <= plan.n_batches:
        raise PlanError(f"the plan has {plan.n_batches} batches, so {n_batches} cannot be played")
    times_s = _times_s(grid, motion)
    course = SPEED_PROFILES.index(motion.speed_profile)
    drives = [drive(grid, motion, axis) for axis in AXIS_INDICES]
    is_uneven = any(driven.is_uneven for driven in drives)
    n_segments, *n_values = room_for(
        plan.moves, plan.batch_offsets, plan.path_shapes, n_batches, is_uneven, *grid.shape
    )
    if n_segments == NOT_ON_GRID:
        size = f"{grid.n_rows} x {grid.n_cols} sites"
        raise PlanError(f"the plan does not fit on the grid of {size}; check it first")
    cosine = float(path_geometry(grid, motion)[1])
    labels = np.empty((2, n_segments), np.int8)
    batch = np.empty(n_segments, np.int32)
    duration_s = np.empty(n_segments, np.float64)
    axes: list[AxisTones] = []
    n = 0
    for axis in AXIS_INDICES:
        driven = drives[axis]
        offsets = np.empty(n_segments + 1, np.int32)
        values = np.empty((N_FIELDS, n_values[axis]), np.float64)
        n, n_tones = build_axis(
            plan.moves,
            plan.batch_offsets,
            plan.linked,
            (plan.path_shapes, plan.path_positions, plan.path_off),
            cosine,
            n_batches,
            axis,
            grid.shape[1 - axis],
            (driven.site_hz, driven.step_hz, driven.amplitude),
            driven.amplitude if axis else driven.amplitude * math.sqrt(motion.path_depth),
            driven.phase,
            motion.rf.phases == "low_crest",
            course,
            is_uneven,
            times_s,
            (labels, batch, duration_s, offsets),
            values,
        )
        offsets = offsets[: n + 1]
        check_limits(axis, driven, motion.rf, batch, offsets, values)
        values = values[:, :n_tones]
        values[PHASE] *= 2 * np.pi
        for array in (values, offsets):
            array.flags.writeable = False  # so that they are not copied
        axes.append(AxisTones(offsets, *values))
    for array in (labels, batch, duration_s):
        array.flags.writeable = False
    kind, courses = labels[:, :n]
    return ToneProgram(axes[0], axes[1], duration_s[:n], kind, batch[:n], courses)


def check_limits(
    axis: AxisIndex,
    drive: Drive,
    rf: RfSpec,
    batch: NDArray[np.int32],
    offsets: NDArray[np.int32],
    values: NDArray[np.float64],
) -> None:
    """Raise an error if the tones of an axis break a limit.

    Args:
        axis: 0 for the rows' tones, 1 for the columns'.
        drive: Frequencies, amplitudes and limits of the axis.
        rf: The limits, as the profile states them.
        batch: int32 (>= n_segments,), batch of each segment.
        offsets: int32 (n_segments + 1,), where each segment's tones start.
        values: float64 (5, >= n_tones), the tones, see :mod:`labseq.motion.tone_kernels`.

    Raises:
        LimitError: Too many tones, a tone outside the AOD's band, two tones too close together, amplitudes
            that exceed full scale or the amplifier's limit, or too much mean power. It names the batch and
            the tone.
    """
    from labseq.motion.tone_kernels import WITHIN, first_excess

    n_tones = offsets[1:] - offsets[:-1]
    if len(n_tones) and n_tones.max() > drive.max_tones:
        worst = int(n_tones.argmax())
        quantity = f"the number of {AXES[axis]} tones in batch {batch[worst]}"
        raise LimitError(quantity, n_tones[worst], drive.max_tones)
    fault, tone, value = first_excess(offsets, values, drive.limits)
    if fault != WITHIN:
        from labseq.motion.faults import raise_limit_error  # tones within their limits need no explanation

        segment = int(np.searchsorted(offsets, tone, side="right")) - 1
        first, last = (int(n) for n in offsets[segment : segment + 2])
        raise_limit_error(fault, value, axis, tone - first, last - first, int(batch[segment]), rf)
