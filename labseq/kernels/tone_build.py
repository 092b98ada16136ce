"""Kernels that write down the tones of a plan, segment by segment.

The tones of an axis are kept as rows of a float64 array: frequency in Hz at the
start and at the end of the segment, amplitude at the start and at the end, and
phase at the start, in cycles.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel
from labseq.kernels.tone_sites import (
    MOVES,
    SITES,
    TONES,
    amplitude,
    collect_tones,
    first_phases,
    frequency,
    last_arrival,
    next_arrival,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Labels = NDArray[np.int8]
Moves = NDArray[np.int16]
Offsets = NDArray[np.int32]

START_HZ: Final = 0
END_HZ: Final = 1
START_AMPLITUDE: Final = 2
END_AMPLITUDE: Final = 3
PHASE: Final = 4
N_FIELDS: Final = 5

IDLE: Final = 0  # as labseq.model.SegmentKind
PICK_UP: Final = 1
TRANSPORT: Final = 2
DROP_OFF: Final = 3
LINEAR: Final = 0  # as labseq.model.FrequencyCourse


@kernel(
    f"int64(float64[:, ::1], int64, {SITES}, float64, {SITES}, {TONES}, int64, int64, int64, float64,"
    " float64, float64, float64[::1])"
)
def add_tones(
    values: Floats,
    n: int,
    site_hz: Floats,
    step_hz: float,
    site_amplitude: Floats,
    tones: Ints,
    n_tones: int,
    travelled: int,
    arriving: int,
    on_start: float,
    on_end: float,
    duration_s: float,
    phase: Floats,
) -> int:
    """Add one segment of an axis.

    Args:
        values: float64 (5, capacity), the axis' tones so far; updated.
        n: How many there are.
        site_hz: float64 (n_sites,), frequency of each site.
        step_hz: See :func:`frequency`.
        site_amplitude: float64 (n_sites,), amplitude of each site's tone.
        tones: int64 (2, >= n_tones), site and goal of each tone.
        n_tones: Number of tones.
        travelled: Sites travelled at the start; tones with a shorter way have arrived.
        arriving: Sites travelled at the end.
        on_start: 0 if the tones are off at the start, 1 if they are on.
        on_end: The same for the end.
        duration_s: Duration of the segment.
        phase: float64 (>= n_tones,), phases in cycles; advanced to the segment's end.

    Returns:
        How many tones there are then.
    """
    for k in range(n_tones):
        site, goal = tones[0, k], tones[1, k]
        way = goal - site
        sign = 1 if way >= 0 else -1
        start_hz = frequency(site_hz, step_hz, site + sign * min(abs(way), travelled))
        end_hz = frequency(site_hz, step_hz, site + sign * min(abs(way), arriving))
        values[START_HZ, n + k] = start_hz
        values[END_HZ, n + k] = end_hz
        values[START_AMPLITUDE, n + k] = on_start * amplitude(site_amplitude, site, goal, travelled)
        values[END_AMPLITUDE, n + k] = on_end * amplitude(site_amplitude, site, goal, arriving)
        values[PHASE, n + k] = phase[k]
        phase[k] = (phase[k] + 0.5 * (start_hz + end_hz) * duration_s) % 1.0  # right for every course
    return n + n_tones


@kernel(
    "int64(int8[:, ::1], int32[::1], float64[::1], int32[::1], int64, int64, int64, int64, float64, int64)"
)
def add_segment(
    labels: Labels,
    batch_of: Offsets,
    duration_s: Floats,
    offsets: Offsets,
    n: int,
    kind: int,
    course: int,
    batch: int,
    its_duration_s: float,
    n_tones: int,
) -> int:
    """Write down a segment that ends with ``n_tones`` tones in all; return how many segments there are."""
    labels[0, n] = kind
    labels[1, n] = course
    batch_of[n] = batch
    duration_s[n] = its_duration_s
    offsets[n + 1] = n_tones
    return n + 1


@kernel(f"int64({TONES}, int64, {TONES}, int64, int64, int64)")
def next_joint(tones: Ints, n_tones: int, others: Ints, n_others: int, travelled: int, course: int) -> int:
    """Distance, in sites, at which a transport is cut next; ``travelled`` if it is over.

    At constant speed that is where tones of either axis arrive; otherwise all start and
    stop together.
    """
    if course != LINEAR:
        return max(last_arrival(tones, n_tones), last_arrival(others, n_others))
    arriving = next_arrival(tones, n_tones, travelled)
    other = next_arrival(others, n_others, travelled)
    if arriving == travelled or (travelled < other < arriving):
        return other
    return arriving


@kernel(
    f"UniTuple(int64, 2)({MOVES}, {const('int32', 1)}, {const('bool_', 1)}, int64, int64, int64, {SITES},"
    f" float64, {SITES}, {SITES}, boolean, int64, {SITES}, int8[:, ::1], int32[::1], float64[::1],"
    " int32[::1], float64[:, ::1])"
)
def build_axis(
    moves: Moves,
    batch_offsets: Offsets,
    linked: NDArray[np.bool_],
    n_batches: int,
    axis: int,
    n_other_sites: int,
    site_hz: Floats,
    step_hz: float,
    site_amplitude: Floats,
    preassigned: Floats,
    low_crest: bool,
    course: int,
    times_s: Floats,
    labels: Labels,
    batch_of: Offsets,
    duration_s: Floats,
    offsets: Offsets,
    values: Floats,
) -> tuple[int, int]:
    """Write down all segments of a plan, and the tones that one axis plays in them.

    At constant speed, tones with a shorter way arrive earlier; the transport is cut
    there, so that each tone's frequency changes linearly, or not at all, within a
    segment. With another course a transport is one segment. The axis that moves is
    ramped at pick-up and drop-off; the other one is on before and off after. A batch
    in which no atom moves counts as moving along its row.

    Args:
        moves: int16 (n, 4), sources on the grid.
        batch_offsets: int32 (>= n_batches + 1,).
        linked: bool (>= n_batches,).
        n_batches: How many batches to write down.
        axis: 0 for the row tones, 1 for the column tones.
        n_other_sites: Sites of the other axis.
        site_hz: float64 (n_sites,), frequency of each site of the axis.
        step_hz: See :func:`frequency`.
        site_amplitude: float64 (n_sites,), amplitude of each site's tone, as a fraction of full scale.
        preassigned: float64 (n_sites,), phase of each site's tone at pick-up, in cycles.
        low_crest: See :func:`first_phases`.
        course: Of the transports, a value of :class:`labseq.model.FrequencyCourse`.
        times_s: float64 (4,): the pause before each batch that is not linked, the pick-up
            ramp, the move by one site, the drop-off ramp.
        labels: Result, int8 (2, >= n_segments), kind and course.
        batch_of: Result, int32 (>= n_segments,).
        duration_s: Result, float64 (>= n_segments,).
        offsets: Result, int32 (> n_segments,), where each segment's tones start.
        values: Result, float64 (5, >= n_tones), the tones.

    Returns:
        Number of segments and number of tones.
    """
    pause_s, pick_up_s, site_s, drop_off_s = times_s[0], times_s[1], times_s[2], times_s[3]
    tones = np.empty((2, len(site_hz)), np.int64)
    others = np.empty((2, n_other_sites), np.int64)
    phase = np.zeros(len(site_hz), np.float64)
    offsets[0] = 0
    m = n = 0
    for batch in range(n_batches):
        start, stop = batch_offsets[batch], batch_offsets[batch + 1]
        n_tones = collect_tones(moves, start, stop, axis, len(site_hz), tones)
        n_others = collect_tones(moves, start, stop, 1 - axis, n_other_sites, others)
        moving = last_arrival(tones, n_tones) > 0
        ramped = moving or (axis == 1 and last_arrival(others, n_others) == 0)
        off = 0.0 if ramped else 1.0
        if not linked[batch]:
            first_phases(tones, n_tones, preassigned, low_crest, site_amplitude, phase)
            if pause_s > 0.0:
                m = add_segment(labels, batch_of, duration_s, offsets, m, IDLE, LINEAR, batch, pause_s, n)
            if pick_up_s > 0.0:
                n = add_tones(
                    values, n, site_hz, step_hz, site_amplitude, tones, n_tones, 0, 0, off, 1.0, pick_up_s,
                    phase,
                )  # fmt: skip
                m = add_segment(
                    labels, batch_of, duration_s, offsets, m, PICK_UP, LINEAR, batch, pick_up_s, n
                )
        travelled = 0
        while True:
            arriving = next_joint(tones, n_tones, others, n_others, travelled, course)
            if arriving == travelled:
                break
            took_s = (arriving - travelled) * site_s
            n = add_tones(
                values, n, site_hz, step_hz, site_amplitude, tones, n_tones, travelled, arriving, 1.0, 1.0,
                took_s, phase,
            )  # fmt: skip
            m = add_segment(labels, batch_of, duration_s, offsets, m, TRANSPORT, course, batch, took_s, n)
            travelled = arriving
        if drop_off_s > 0.0 and not (batch + 1 < n_batches and linked[batch + 1]):
            n = add_tones(
                values, n, site_hz, step_hz, site_amplitude, tones, n_tones, travelled, travelled, 1.0, off,
                drop_off_s, phase,
            )  # fmt: skip
            m = add_segment(labels, batch_of, duration_s, offsets, m, DROP_OFF, LINEAR, batch, drop_off_s, n)
    return m, n
