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

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
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

MOVES: Final = const("int16", 2)
HZ: Final = const("float64", 1)


@kernel(f"int64({MOVES}, int64, int64, int64, int64, int64[:, ::1])")
def collect_tones(moves: Moves, start: int, stop: int, axis: int, n_sites: int, tones: Ints) -> int:
    """Collect the tones that a batch needs on an axis.

    Args:
        moves: int16 (n, 4) of the plan; the batch is ``moves[start:stop]``.
        start: Where the batch starts.
        stop: Where it stops.
        axis: 0 for rows, 1 for columns.
        n_sites: Sites of the axis.
        tones: Result, int64 (2, >= n_sites), site and goal of each tone, by site.

    Returns:
        Number of tones.
    """
    on = np.zeros(n_sites, np.bool_)
    goal = np.zeros(n_sites, np.int64)
    for i in range(start, stop):
        on[moves[i, axis]] = True
        goal[moves[i, axis]] = moves[i, axis + 2]
    n = 0
    for site in range(n_sites):
        if on[site]:
            tones[0, n] = site
            tones[1, n] = goal[site]
            n += 1
    return n


@kernel(f"float64({HZ}, float64, int64)")
def frequency(site_hz: Floats, step_hz: float, site: int) -> float:
    """Frequency of a tone at a site, continued linearly beyond the grid.

    ``step_hz`` is the step from site to site of an axis with a single one.
    """
    last = len(site_hz) - 1
    if 0 <= site <= last:
        return site_hz[site]
    if last == 0:
        return site_hz[0] + step_hz * site
    if site < 0:
        return site_hz[0] + (site_hz[1] - site_hz[0]) * site
    return site_hz[last] + (site_hz[last] - site_hz[last - 1]) * (site - last)


@kernel("int64(int64[:, ::1], int64, int64)")
def next_arrival(tones: Ints, n_tones: int, travelled: int) -> int:
    """Distance, in sites, at which the next tones arrive; ``travelled`` if all have."""
    nearest = travelled
    for k in range(n_tones):
        distance = abs(tones[1, k] - tones[0, k])
        if distance > travelled and (nearest == travelled or distance < nearest):
            nearest = distance
    return nearest


@kernel(
    f"int64(float64[:, ::1], int64, {HZ}, float64, int64[:, ::1], int64, int64, int64, float64, float64,"
    " float64, float64[::1])"
)
def add_tones(
    values: Floats,
    n: int,
    site_hz: Floats,
    step_hz: float,
    tones: Ints,
    n_tones: int,
    travelled: int,
    arriving: int,
    start_amplitude: float,
    end_amplitude: float,
    duration_s: float,
    phase: Floats,
) -> int:
    """Add one segment of an axis.

    Args:
        values: float64 (5, capacity), the axis' tones so far; updated.
        n: How many there are.
        site_hz: float64 (n_sites,), frequency of each site.
        step_hz: See :func:`frequency`.
        tones: int64 (2, >= n_tones), site and goal of each tone.
        n_tones: Number of tones.
        travelled: Sites travelled at the start; tones with a shorter way have arrived.
        arriving: Sites travelled at the end.
        start_amplitude: Of every tone.
        end_amplitude: Of every tone.
        duration_s: Duration of the segment.
        phase: float64 (>= n_tones,), phases in cycles; advanced to the segment's end.

    Returns:
        How many tones there are then.
    """
    for k in range(n_tones):
        way = tones[1, k] - tones[0, k]
        sign = 1 if way >= 0 else -1
        start_hz = frequency(site_hz, step_hz, tones[0, k] + sign * min(abs(way), travelled))
        end_hz = frequency(site_hz, step_hz, tones[0, k] + sign * min(abs(way), arriving))
        values[START_HZ, n + k] = start_hz
        values[END_HZ, n + k] = end_hz
        values[START_AMPLITUDE, n + k] = start_amplitude
        values[END_AMPLITUDE, n + k] = end_amplitude
        values[PHASE, n + k] = phase[k]
        phase[k] = (phase[k] + 0.5 * (start_hz + end_hz) * duration_s) % 1.0
    return n + n_tones


@kernel("int64(int8[::1], int32[::1], float64[::1], int32[::1], int64, int64, int64, float64, int64)")
def add_segment(
    kind: NDArray[np.int8],
    batch_of: Offsets,
    duration_s: Floats,
    offsets: Offsets,
    n: int,
    its_kind: int,
    batch: int,
    its_duration_s: float,
    n_tones: int,
) -> int:
    """Write down a segment that ends with ``n_tones`` tones in all; return how many segments there are."""
    kind[n] = its_kind
    batch_of[n] = batch
    duration_s[n] = its_duration_s
    offsets[n + 1] = n_tones
    return n + 1


@kernel(
    f"UniTuple(int64, 2)({MOVES}, {const('int32', 1)}, {const('bool_', 1)}, int64, int64, int64, {HZ},"
    f" float64, {HZ}, float64, float64, float64, float64, float64, int8[::1], int32[::1],"
    " float64[::1], int32[::1], float64[:, ::1])"
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
    first_phase: Floats,
    amplitude: float,
    pick_up_s: float,
    drop_off_s: float,
    site_s: float,
    batch_overhead_s: float,
    kind: NDArray[np.int8],
    batch_of: Offsets,
    duration_s: Floats,
    offsets: Offsets,
    values: Floats,
) -> tuple[int, int]:
    """Write down all segments of a plan, and the tones that one axis plays in them.

    Tones with a shorter way arrive earlier; the transport is cut there, so that
    each tone's frequency changes linearly, or not at all, within a segment. The
    axis that moves is ramped at pick-up and drop-off; the other one is on before
    and off after. A batch in which no atom moves counts as moving along its row.

    Args:
        moves: int16 (n, 4), sources on the grid.
        batch_offsets: int32 (>= n_batches + 1,).
        linked: bool (>= n_batches,).
        n_batches: How many batches to write down.
        axis: 0 for the row tones, 1 for the column tones.
        n_other_sites: Sites of the other axis.
        site_hz: float64 (n_sites,), frequency of each site of the axis.
        step_hz: See :func:`frequency`.
        first_phase: float64 (n_sites,), phase of each site's tone at pick-up, in cycles.
        amplitude: Of each tone, as a fraction of full scale.
        pick_up_s: Pick-up ramp, in seconds.
        drop_off_s: Drop-off ramp, in seconds.
        site_s: Time to move by one site, in seconds.
        batch_overhead_s: Time before each batch that is not linked, in seconds.
        kind: Result, int8 (>= n_segments,).
        batch_of: Result, int32 (>= n_segments,).
        duration_s: Result, float64 (>= n_segments,).
        offsets: Result, int32 (> n_segments,), where each segment's tones start.
        values: Result, float64 (5, >= n_tones), the tones.

    Returns:
        Number of segments and number of tones.
    """
    tones = np.empty((2, len(site_hz)), np.int64)
    others = np.empty((2, n_other_sites), np.int64)
    phase = np.zeros(len(site_hz), np.float64)
    offsets[0] = 0
    m = n = 0
    for batch in range(n_batches):
        start, stop = batch_offsets[batch], batch_offsets[batch + 1]
        n_tones = collect_tones(moves, start, stop, axis, len(site_hz), tones)
        n_others = collect_tones(moves, start, stop, 1 - axis, n_other_sites, others)
        moving = next_arrival(tones, n_tones, 0) > 0
        ramped = moving or (axis == 1 and next_arrival(others, n_others, 0) == 0)
        off = 0.0 if ramped else amplitude
        if not linked[batch]:
            for k in range(n_tones):
                phase[k] = first_phase[tones[0, k]]
            if batch_overhead_s > 0.0:
                m = add_segment(kind, batch_of, duration_s, offsets, m, IDLE, batch, batch_overhead_s, n)
            if pick_up_s > 0.0:
                n = add_tones(
                    values, n, site_hz, step_hz, tones, n_tones, 0, 0, off, amplitude, pick_up_s, phase
                )
                m = add_segment(kind, batch_of, duration_s, offsets, m, PICK_UP, batch, pick_up_s, n)
        travelled = 0
        while True:
            arriving = next_arrival(tones, n_tones, travelled)
            other = next_arrival(others, n_others, travelled)
            if arriving == travelled or (travelled < other < arriving):
                arriving = other
            if arriving == travelled:
                break
            took_s = (arriving - travelled) * site_s
            n = add_tones(
                values, n, site_hz, step_hz, tones, n_tones, travelled, arriving, amplitude, amplitude,
                took_s, phase,
            )  # fmt: skip
            m = add_segment(kind, batch_of, duration_s, offsets, m, TRANSPORT, batch, took_s, n)
            travelled = arriving
        if drop_off_s > 0.0 and not (batch + 1 < n_batches and linked[batch + 1]):
            n = add_tones(
                values, n, site_hz, step_hz, tones, n_tones, travelled, travelled, amplitude, off,
                drop_off_s, phase,
            )  # fmt: skip
            m = add_segment(kind, batch_of, duration_s, offsets, m, DROP_OFF, batch, drop_off_s, n)
    return m, n
