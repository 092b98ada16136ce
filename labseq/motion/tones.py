"""From a plan to the tones that carry it out."""

from __future__ import annotations

import numpy as np

from labseq.errors import PlanError
from labseq.model import AxisTones, MotionSpec, Plan, SiteGrid, ToneProgram
from labseq.motion.axes import AxisIndex, drive
from labseq.motion.limits import refuse_excess
from labseq.motion.timing import SPEED_PROFILES, default_grid, site_time_s

BOTH: tuple[AxisIndex, AxisIndex] = (0, 1)


def tone_program(
    plan: Plan,
    grid: SiteGrid | None = None,
    motion: MotionSpec | None = None,
    n_batches: int | None = None,
) -> ToneProgram:
    """Turn a checked plan into a tone program, with the paper's timing.

    For each batch: a pause without tones (the overhead of a batch; that of the cycle
    has passed before anything plays), the pick-up, the transport, and the drop-off. A
    transport at constant speed is cut wherever a tone arrives. With another speed
    profile all tones start and arrive together, each with its own way; the longest way of
    the batch has the mean speed of the setting, so that the batch lasts as long as at
    constant speed. At pick-up and drop-off the tones of the axis that moves are ramped,
    linearly in trap depth; those of the other axis are on before and off after.
    Between linked batches there is no drop-off, pause and pick-up.

    Each site's tone has a preassigned amplitude; by default all are equal, such that
    the most tones an axis may have reach full scale together. During a transport the
    amplitude squared goes evenly from that of the source to that of the goal. Phases
    start as preassigned or chosen and are continuous within a batch and a chain. Beyond
    the grid's edge frequencies go on linearly, amplitudes stay. Calibrated tones that are
    all within ``rf.snap_within_m`` of a comb are played on it (see
    :func:`labseq.motion.drive` for how far they were moved).

    Args:
        plan: A plan that :func:`check_plan` accepted.
        grid: The grid of sites; by default the paper's.
        motion: How the tweezers move; by default as in the paper.
        n_batches: How many batches to play, from the first; by default all.

    Returns:
        The tones of both axes.

    Raises:
        PlanError: The plan does not fit onto the grid, or has fewer batches than asked for.
        LimitError: Tones break a limit of AOD or amplifier (band, number, spacing, sum of
            amplitudes, peak voltage, mean power), the amplitudes are not one per site, or the
            speed profile is none that exists.
    """
    from labseq.kernels.tone_build import N_FIELDS, build_axis

    grid = grid or default_grid(20, 20)
    motion = motion or MotionSpec()
    n_batches = plan.n_batches if n_batches is None else n_batches
    _refuse_misfits(plan, grid, n_batches)
    site_s = site_time_s(grid, motion)
    times_s = np.array([motion.overhead_per_batch_s, motion.pick_up_s, site_s, motion.drop_off_s])
    course = SPEED_PROFILES.index(motion.speed_profile)
    sizes = np.diff(plan.batch_offsets[: n_batches + 1]).astype(np.int64)
    n_segments = 3 * n_batches + 2 * int(sizes.sum())  # a tone may arrive on either axis
    labels = np.empty((2, n_segments), np.int8)
    batch = np.empty(n_segments, np.int32)
    duration_s = np.empty(n_segments, np.float64)
    axes: list[AxisTones] = []
    n = 0
    for axis in BOTH:
        driven = drive(grid, motion, axis)
        offsets = np.empty(n_segments + 1, np.int32)
        values = np.empty((N_FIELDS, int(((2 * sizes + 2) * sizes).sum())), np.float64)
        n, n_tones = build_axis(
            plan.moves,
            plan.batch_offsets,
            plan.linked,
            n_batches,
            axis,
            grid.shape[1 - axis],
            driven.site_hz,
            driven.step_hz,
            driven.amplitude,
            driven.phase,
            motion.rf.phases == "low_crest",
            course,
            times_s,
            labels,
            batch,
            duration_s,
            offsets,
            values,
        )
        offsets = offsets[: n + 1]
        refuse_excess(axis, driven, motion.rf, batch, offsets, values)
        start_hz, end_hz, start, end, phase = values[:, :n_tones]
        axes.append(AxisTones(offsets, start_hz, end_hz, start, end, 2 * np.pi * phase))
    kind, courses = labels[:, :n]
    return ToneProgram(axes[0], axes[1], duration_s[:n], kind, batch[:n], courses)


def _refuse_misfits(plan: Plan, grid: SiteGrid, n_batches: int) -> None:
    if not 0 <= n_batches <= plan.n_batches:
        raise PlanError(f"the plan has {plan.n_batches} batches; {n_batches} cannot be played")
    sources = plan.moves[: plan.batch_offsets[n_batches], :2]
    if len(sources) and (sources.min() < 0 or np.any(sources.max(axis=0) >= grid.shape)):
        raise PlanError(
            f"the plan does not fit onto the grid of {grid.n_rows} x {grid.n_cols} sites; check it first"
        )
