"""From a plan to the tones that carry it out."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError, PlanError
from labseq.model import AxisTones, MotionSpec, Plan, SiteGrid, ToneProgram
from labseq.motion.timing import site_time_s

PHASE_SEED: Final = 20220711
"""Seed of the preassigned random phases; fixed, so that the same plan gives the same waveform."""

SINGLE_SITE_STEP_HZ: Final = 1.6e6
"""Step from the only site of a 1 x 1 grid to an ejection slot."""


@lru_cache(maxsize=16)
def preassigned_phases(n_rows: int, n_cols: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Random phase of each row's and each column's tone at pick-up, in cycles.

    Random phases keep the tones of an axis from adding up ("RF intermodulation" in
    the paper). A tone keeps its phase whatever the size of the grid.
    """
    rows, columns = np.random.SeedSequence(PHASE_SEED).spawn(2)
    return np.random.default_rng(rows).random(n_rows), np.random.default_rng(columns).random(n_cols)


def tone_program(
    plan: Plan,
    grid: SiteGrid | None = None,
    motion: MotionSpec | None = None,
    n_batches: int | None = None,
) -> ToneProgram:
    """Turn a checked plan into a tone program, with the paper's timing.

    For each batch: a pause without tones (the overhead of a batch; that of the cycle
    has passed before anything plays), the pick-up, the transport at constant speed, cut
    wherever a tone arrives, and the drop-off. At pick-up and drop-off the tones of
    the axis that moves are ramped; those of the other axis are on before and off
    after. Between linked batches there is no drop-off, pause and pick-up. Every
    tone has the same amplitude, such that the most tones an axis may have reach
    full scale together. Phases start from preassigned random ones and are
    continuous within a batch and a chain. Beyond the grid's edge, frequencies go
    on linearly.

    Args:
        plan: A plan that :func:`check_plan` accepted.
        grid: The grid of sites; by default the paper's.
        motion: How the tweezers move; by default as in the paper.
        n_batches: How many batches to play, from the first; by default all.

    Returns:
        The tones of both axes.

    Raises:
        PlanError: The plan does not fit onto the grid, or has fewer batches than asked for.
        LimitError: A batch needs more tones than an axis can play, or the speed
            profile is none that exists.
    """
    from labseq.kernels.tone_build import N_FIELDS, build_axis

    grid = grid or SiteGrid()
    motion = motion or MotionSpec()
    n_batches = plan.n_batches if n_batches is None else n_batches
    _refuse_misfits(plan, grid, n_batches)
    sizes = np.diff(plan.batch_offsets[: n_batches + 1]).astype(np.int64)
    n_segments = 3 * n_batches + 2 * int(sizes.sum())  # a tone may arrive on either axis
    kind = np.empty(n_segments, np.int8)
    batch = np.empty(n_segments, np.int32)
    duration_s = np.empty(n_segments, np.float64)
    site_hz = (grid.row_frequency_hz, grid.column_frequency_hz)
    max_tones = (motion.max_row_tones, motion.max_column_tones)
    axes: list[AxisTones] = []
    for axis in (0, 1):
        offsets = np.empty(n_segments + 1, np.int32)
        values = np.empty((N_FIELDS, int(((2 * sizes + 2) * sizes).sum())), np.float64)
        n_segments_used, n_tones = build_axis(
            plan.moves,
            plan.batch_offsets,
            plan.linked,
            n_batches,
            axis,
            grid.shape[1 - axis],
            site_hz[axis],
            _step_hz(site_hz[axis], site_hz[1 - axis]),
            preassigned_phases(*grid.shape)[axis],
            1.0 / max_tones[axis],
            motion.pick_up_s,
            motion.drop_off_s,
            site_time_s(grid, motion),
            motion.overhead_per_batch_s,
            kind,
            batch,
            duration_s,
            offsets,
            values,
        )
        offsets = offsets[: n_segments_used + 1]
        _refuse_too_many(offsets, batch, max_tones[axis], ("row", "column")[axis])
        start_hz, end_hz, start, end, phase = values[:, :n_tones]
        axes.append(AxisTones(offsets, start_hz, end_hz, start, end, 2 * np.pi * phase))
        n = n_segments_used
    return ToneProgram(axes[0], axes[1], duration_s[:n], kind[:n], batch[:n])


def _step_hz(site_hz: NDArray[np.float64], other_hz: NDArray[np.float64]) -> float:
    """Mean step of an axis; that of the other axis where it has a single site."""
    for values in (site_hz, other_hz):
        if len(values) > 1:
            return float(values[-1] - values[0]) / (len(values) - 1)
    return SINGLE_SITE_STEP_HZ


def _refuse_misfits(plan: Plan, grid: SiteGrid, n_batches: int) -> None:
    if not 0 <= n_batches <= plan.n_batches:
        raise PlanError(f"the plan has {plan.n_batches} batches; {n_batches} cannot be played")
    sources = plan.moves[: plan.batch_offsets[n_batches], :2]
    if len(sources) and (sources.min() < 0 or np.any(sources.max(axis=0) >= grid.shape)):
        raise PlanError(
            f"the plan does not fit onto the grid of {grid.n_rows} x {grid.n_cols} sites; check it first"
        )


def _refuse_too_many(offsets: NDArray[np.int32], batch: NDArray[np.int32], max_tones: int, axis: str) -> None:
    n_tones = np.diff(offsets)
    if len(n_tones) and n_tones.max() > max_tones:
        worst = int(n_tones.argmax())
        raise LimitError(f"the number of {axis} tones in batch {batch[worst]}", n_tones[worst], max_tones)
