"""Kernels that build tone programs and check them against limits.

The tones of an axis are rows of a float64 array, with frequency in Hz at the start and at the end of the
segment, amplitude at the start and at the end, and phase at the start, in cycles. The tones of a batch are
int64 (2, >= n_tones) with the site and the goal of each, in sites of the axis.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel, kernel
from labseq.motion.path_kernels import (
    KNOTS,
    PATHS,
    POSITIONS,
    Paths,
    Shape,
    leg_ways,
    paths_of,
    position,
    tracks_of,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Moves = NDArray[np.int16]

MOVES: Final = const("int16", 2)
SITES: Final = const("float64", 1)
TONES: Final = "int64[:, ::1]"


@helper_kernel(f"int64({MOVES}, int64, int64, int64, int64, {TONES})")
def collect_tones(moves: Moves, start: int, stop: int, axis: int, n_sites: int, tones: Ints) -> int:
    """Collect the tones that the batch ``moves[start:stop]`` needs on an axis, by site."""
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


@helper_kernel("int64(int64[:, :], int64)")
def next_arrival(tones: Ints, travelled: int) -> int:
    """Distance, in sites, at which the next tones arrive, or ``travelled`` if all have."""
    nearest = travelled
    for k in range(tones.shape[1]):
        distance = abs(tones[1, k] - tones[0, k])
        if distance > travelled and (nearest == travelled or distance < nearest):
            nearest = distance
    return nearest


@helper_kernel("int64(int64[:, :])")
def last_arrival(tones: Ints) -> int:
    """Longest displacement of all tones, in sites."""
    longest = 0
    for k in range(tones.shape[1]):
        longest = max(longest, abs(tones[1, k] - tones[0, k]))
    return longest


@kernel(f"float64({SITES}, float64, int64)")
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


@helper_kernel(f"float64({SITES}, int64)")
def amplitude(site_amplitude: Floats, site: int) -> float:
    """Amplitude of the tone of a site, or of the outermost site if it is beyond the grid."""
    return site_amplitude[min(max(site, 0), len(site_amplitude) - 1)]


@kernel(f"void({TONES}, int64, {SITES}, boolean, {SITES}, float64[::1])")
def first_phases(
    tones: Ints, n_tones: int, preassigned: Floats, low_crest: bool, site_amplitude: Floats, phase: Floats
) -> None:
    """Choose the phases of a batch's tones at pick-up, in cycles, as preassigned or for a low crest factor.

    Phases for a low crest factor follow Schroeder (IEEE Trans. Inf. Theory 16, 85, 1970): on a comb of teeth
    with relative powers p_l, the k-th has the phase ``-2 pi sum_(l < k) (k - l) p_l``. Tones that are off
    count as teeth without power.
    """
    if not low_crest:
        for k in range(n_tones):
            phase[k] = preassigned[tones[0, k]]
        return
    total = 0.0
    for k in range(n_tones):
        total += site_amplitude[tones[0, k]] ** 2
    below = now = 0.0
    for k in range(n_tones):
        if k > 0 and total > 0.0:
            now -= (tones[0, k] - tones[0, k - 1]) * below / total
        phase[k] = now % 1.0
        below += site_amplitude[tones[0, k]] ** 2


Labels = NDArray[np.int8]
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


Sites = tuple[Floats, float, Floats]
"""Frequency of each site, the step of an axis with a single one, amplitude of each site's tone."""
Segments = tuple[Labels, Offsets, Floats, Offsets]
"""Kind and course, batch and duration of each segment, and where its tones start."""
SITES_OF_AXIS: Final = f"Tuple(({SITES}, float64, {SITES}))"
SEGMENTS: Final = "Tuple((int8[:, ::1], int32[::1], float64[::1], int32[::1]))"


@helper_kernel(
    f"int64(float64[:, ::1], int64, {SITES_OF_AXIS}, int64[:, :], int64, int64, float64, float64, float64,"
    " float64[::1])"
)
def add_tones(
    values: Floats,
    n: int,
    sites: Sites,
    tones: Ints,
    travelled: int,
    arriving: int,
    on_start: float,
    on_end: float,
    duration_s: float,
    phase: Floats,
) -> int:
    """Add the tones of a segment to ``n`` tones, and return their new number.

    Args:
        values: float64 (5, capacity), the axis' tones so far. Updated.
        n: Number of tones so far.
        travelled: Sites travelled at the start. Tones with a shorter way have arrived.
        arriving: Sites travelled at the end.
        on_start: 0 if the tones are off at the start, 1 if they are on.
        on_end: The same for the end.
        phase: float64 (>= n_tones,), phases in cycles. Advanced to the segment's end.
    """
    site_hz, step_hz, site_amplitude = sites
    n_tones = tones.shape[1]
    for k in range(n_tones):
        site, goal = tones[0, k], tones[1, k]
        way = goal - site
        sign = 1 if way >= 0 else -1
        start, end = site + sign * min(abs(way), travelled), site + sign * min(abs(way), arriving)
        start_hz, end_hz = frequency(site_hz, step_hz, start), frequency(site_hz, step_hz, end)
        values[START_HZ, n + k] = start_hz
        values[END_HZ, n + k] = end_hz
        values[START_AMPLITUDE, n + k] = on_start * amplitude(site_amplitude, start)
        values[END_AMPLITUDE, n + k] = on_end * amplitude(site_amplitude, end)
        values[PHASE, n + k] = phase[k]
        phase[k] = (phase[k] + 0.5 * (start_hz + end_hz) * duration_s) % 1.0  # holds for every course
    return n + n_tones


@helper_kernel(f"int64({SEGMENTS}, int64, int64, int64, int64, float64, int64)")
def add_segment(
    segments: Segments, n: int, kind: int, course: int, batch: int, duration_s: float, n_tones: int
) -> int:
    """Add a segment that ends with ``n_tones`` tones in all, and return the number of segments."""
    labels, batch_of, durations_s, offsets = segments
    labels[0, n] = kind
    labels[1, n] = course
    batch_of[n] = batch
    durations_s[n] = duration_s
    offsets[n + 1] = n_tones
    return n + 1


@helper_kernel("int64(int64[:, :], int64[:, :], int64, int64, boolean)")
def next_joint(tones: Ints, others: Ints, travelled: int, course: int, is_uneven: bool) -> int:
    """Distance, in sites, at which a transport is cut next, or ``travelled`` if it is over.

    At constant speed it is cut where tones of either axis arrive, or at every site if amplitudes differ from
    site to site. With another course all tones start and stop together.
    """
    if course != LINEAR:
        return max(last_arrival(tones), last_arrival(others))
    arriving = next_arrival(tones, travelled)
    other = next_arrival(others, travelled)
    if is_uneven:
        return min(travelled + 1, max(arriving, other))
    if arriving == travelled or (travelled < other < arriving):
        return other
    return arriving


@helper_kernel("float64(float64, float64, boolean)")
def level(keyed_s: float, ramp_s: float, is_ramped: bool) -> float:
    """Amplitude of an axis when the parked axis is fully on. The depth changes evenly over the ramp."""
    return float(np.sqrt(keyed_s / ramp_s)) if is_ramped else 1.0


@helper_kernel(
    "UniTuple(int64, 2)(int64, int64, int64, int64, int64[:, :], int64[:, :], boolean, boolean,"
    f" {SITES_OF_AXIS}, int64, boolean, {SITES}, {SEGMENTS}, float64[:, ::1], float64[::1])"
)
def add_line_batch(
    m: int,
    n: int,
    batch: int,
    axis: int,
    tones: Ints,
    others: Ints,
    follows: bool,
    leads: bool,
    sites: Sites,
    course: int,
    is_uneven: bool,
    times_s: Floats,
    segments: Segments,
    values: Floats,
    phase: Floats,
) -> tuple[int, int]:
    """Add the segments of a batch along lines, and return the numbers of segments and of tones.

    ``tones`` belong to the axis, ``others`` to the other axis. A batch that ``follows`` is linked to the
    batch before and picks nothing up. A batch that ``leads`` is linked to the next and drops nothing.
    """
    pause_s, pick_up_s, site_s, drop_off_s, keyed_up_s, keyed_down_s = times_s
    ramped = last_arrival(tones) > 0 or (axis == 1 and last_arrival(others) == 0)
    if not follows:
        if pause_s > 0.0:
            m = add_segment(segments, m, IDLE, LINEAR, batch, pause_s, n)
        if pick_up_s > 0.0:
            part, ramp_s = level(keyed_up_s, pick_up_s, ramped), pick_up_s - keyed_up_s
            n = add_tones(values, n, sites, tones, 0, 0, 0.0, part, keyed_up_s, phase)
            m = add_segment(segments, m, PICK_UP, LINEAR, batch, keyed_up_s, n)
            n = add_tones(values, n, sites, tones, 0, 0, part, 1.0, ramp_s, phase)
            m = add_segment(segments, m, PICK_UP, LINEAR, batch, ramp_s, n)
    at = 0
    while True:
        goal = next_joint(tones, others, at, course, is_uneven)
        if goal == at:
            break
        took_s = (goal - at) * site_s
        n = add_tones(values, n, sites, tones, at, goal, 1.0, 1.0, took_s, phase)
        m = add_segment(segments, m, TRANSPORT, course, batch, took_s, n)
        at = goal
    if drop_off_s > 0.0 and not leads:
        part, ramp_s = level(keyed_down_s, drop_off_s, ramped), drop_off_s - keyed_down_s
        n = add_tones(values, n, sites, tones, at, at, 1.0, part, ramp_s, phase)
        m = add_segment(segments, m, DROP_OFF, LINEAR, batch, ramp_s, n)
        n = add_tones(values, n, sites, tones, at, at, part, 0.0, keyed_down_s, phase)
        m = add_segment(segments, m, DROP_OFF, LINEAR, batch, keyed_down_s, n)
    return m, n


Batch = tuple[Floats, NDArray[np.int32], Shape, int, int]
"""Positions, knots and shape of a batch as in :mod:`labseq.motion.path_kernels`, its axis and index."""
BATCH: Final = f"Tuple(({POSITIONS}, {KNOTS}, UniTuple(int64, 3), int64, int64))"


@helper_kernel(f"UniTuple(float64, 2)({SITES_OF_AXIS}, float64)")
def tone_at(sites: Sites, place: float) -> tuple[float, float]:
    """Frequency and amplitude of a tone between sites, where frequency and power change evenly."""
    site_hz, step_hz, site_amplitude = sites
    below = int(np.floor(place))
    part = place - below
    first_hz, first = frequency(site_hz, step_hz, below), amplitude(site_amplitude, below)
    if part == 0.0:
        return first_hz, first
    last_hz, last = frequency(site_hz, step_hz, below + 1), amplitude(site_amplitude, below + 1)
    power = first * first + part * (last * last - first * first)
    return first_hz + part * (last_hz - first_hz), float(np.sqrt(power))


@helper_kernel(
    f"int64(float64[:, ::1], int64, {SITES_OF_AXIS}, {BATCH}, int64, int64, float64, float64, float64,"
    " float64[::1])"
)
def add_path_tones(
    values: Floats,
    n: int,
    sites: Sites,
    of: Batch,
    knot: int,
    to_knot: int,
    start: float,
    end: float,
    duration_s: float,
    phase: Floats,
) -> int:
    """Add the tones of a segment between two knots or at one knot, and return their new number.

    Args:
        values: As in :func:`add_tones`.
        n: Number of tones so far.
        knot: Knot at the start of the segment.
        to_knot: Knot at its end.
        start: Amplitude at the start of tones that go off at ``to_knot``, relative to the amplitude of their
            place, which all other tones have.
        end: The same at the end.
        phase: float64 (>= n_tones,), phases in cycles. Advanced to the segment's end.
    """
    positions, off, shape, axis, _ = of
    for k in range(shape[1 + axis]):
        goes_off = off[axis * shape[1] + k]
        if goes_off < to_knot:
            continue
        start_hz, start_amplitude = tone_at(sites, position(positions, shape, axis, knot, k))
        end_hz, end_amplitude = tone_at(sites, position(positions, shape, axis, to_knot, k))
        values[START_HZ, n] = start_hz
        values[END_HZ, n] = end_hz
        values[START_AMPLITUDE, n] = start_amplitude * (start if goes_off == to_knot else 1.0)
        values[END_AMPLITUDE, n] = end_amplitude * (end if goes_off == to_knot else 1.0)
        values[PHASE, n] = phase[k]
        phase[k] = (phase[k] + 0.5 * (start_hz + end_hz) * duration_s) % 1.0
        n += 1
    return n


@helper_kernel(
    f"UniTuple(int64, 2)(int64, int64, {BATCH}, {SITES_OF_AXIS}, int64, float64, {SITES}, {SEGMENTS},"
    " float64[:, ::1], float64[::1])"
)
def add_path_batch(
    m: int,
    n: int,
    of: Batch,
    sites: Sites,
    course: int,
    cosine: float,
    times_s: Floats,
    segments: Segments,
    values: Floats,
    phase: Floats,
) -> tuple[int, int]:
    """Add the segments of a batch with paths of tones, and return the numbers of segments and of tones.

    At the first and at the last knot row tones are ramped while column tones are switched. At a knot in
    between the tones that go off are ramped, on both axes.
    """
    positions, off, shape, axis, batch = of
    pause_s, pick_up_s, site_s, drop_off_s, keyed_up_s, keyed_down_s = times_s
    last, ramped = shape[0] - 1, axis == 0
    if pause_s > 0.0:
        m = add_segment(segments, m, IDLE, LINEAR, batch, pause_s, n)
    if pick_up_s > 0.0:
        part = level(keyed_up_s, pick_up_s, ramped)
        for start, end, took_s in ((0.0, part, keyed_up_s), (part, 1.0, pick_up_s - keyed_up_s)):
            first = n
            n = add_path_tones(values, n, sites, of, 0, 0, 1.0, 1.0, took_s, phase)
            values[START_AMPLITUDE, first:n] *= start
            values[END_AMPLITUDE, first:n] *= end
            m = add_segment(segments, m, PICK_UP, LINEAR, batch, took_s, n)
    ways = leg_ways(tracks_of(positions, shape), off, cosine)
    for leg in range(last):
        took_s, at = ways[leg] * site_s, leg + 1
        if took_s > 0.0:
            n = add_path_tones(values, n, sites, of, leg, at, 1.0, 1.0, took_s, phase)
            m = add_segment(segments, m, TRANSPORT, course, batch, took_s, n)
        if drop_off_s == 0.0 or not (off == at).any():
            continue
        if at < last:
            n = add_path_tones(values, n, sites, of, at, at, 1.0, 0.0, drop_off_s, phase)
            m = add_segment(segments, m, DROP_OFF, LINEAR, batch, drop_off_s, n)
            continue
        part, ramp_s = level(keyed_down_s, drop_off_s, ramped), drop_off_s - keyed_down_s
        n = add_path_tones(values, n, sites, of, at, at, 1.0, part, ramp_s, phase)
        m = add_segment(segments, m, DROP_OFF, LINEAR, batch, ramp_s, n)
        n = add_path_tones(values, n, sites, of, at, at, part, 0.0, keyed_down_s, phase)
        m = add_segment(segments, m, DROP_OFF, LINEAR, batch, keyed_down_s, n)
    return m, n


@helper_kernel(f"void({BATCH}, int64, {TONES})")
def start_sites(of: Batch, n_sites: int, tones: Ints) -> None:
    """The sites nearest to where the tones of a batch with paths start, for their first phases."""
    for k in range(of[2][1 + of[3]]):
        place = np.rint(position(of[0], of[2], of[3], 0, k))
        tones[0, k] = int(min(max(place, 0.0), n_sites - 1.0))


NOT_ON_GRID: Final = -1


@kernel(
    f"UniTuple(int64, 3)({MOVES}, {const('int32', 1)}, {const('int32', 2)}, int64, boolean, int64, int64)"
)
def room_for(
    moves: NDArray[np.int16],
    batch_offsets: NDArray[np.int32],
    path_shapes: NDArray[np.int32],
    n_batches: int,
    is_uneven: bool,
    n_rows: int,
    n_cols: int,
) -> tuple[int, int, int]:
    """The most segments that a plan's batches can need, and the most tones in them on each axis.

    The first is NOT_ON_GRID if a source is not on the grid.
    """
    for k in range(batch_offsets[n_batches]):
        if not (0 <= moves[k, 0] < n_rows and 0 <= moves[k, 1] < n_cols):
            return NOT_ON_GRID, 0, 0
    widest = 0
    if is_uneven:
        for k in range(len(moves)):
            widest = max(widest, abs(moves[k, 2] - moves[k, 0]), abs(moves[k, 3] - moves[k, 1]))
    n_segments, n_lines, n_rows_on_paths, n_cols_on_paths = 5 * n_batches, 0, 0, 0
    for i in range(n_batches):
        size = batch_offsets[i + 1] - batch_offsets[i]
        n_cuts = widest if is_uneven else 2 * size  # a tone may arrive on either axis
        n_segments += n_cuts
        n_lines += (n_cuts + 4) * size
    for i in range(min(n_batches, len(path_shapes))):
        n_path_segments = 2 * path_shapes[i, 0] + 4
        n_segments += n_path_segments
        n_rows_on_paths += n_path_segments * path_shapes[i, 1]
        n_cols_on_paths += n_path_segments * path_shapes[i, 2]
    return n_segments, n_lines + n_rows_on_paths, n_lines + n_cols_on_paths


@kernel(
    f"UniTuple(int64, 2)({MOVES}, {const('int32', 1)}, {const('bool_', 1)}, {PATHS}, float64, int64, int64,"
    f" int64, {SITES_OF_AXIS}, {SITES}, {SITES}, boolean, int64, boolean, {SITES}, {SEGMENTS},"
    " float64[:, ::1])"
)
def build_axis(
    moves: Moves,
    batch_offsets: Offsets,
    linked: NDArray[np.bool_],
    paths: Paths,
    cosine: float,
    n_batches: int,
    axis: int,
    n_other_sites: int,
    sites: Sites,
    path_amplitude: Floats,
    preassigned: Floats,
    low_crest: bool,
    course: int,
    is_uneven: bool,
    times_s: Floats,
    segments: Segments,
    values: Floats,
) -> tuple[int, int]:
    """Build all segments of a plan, and the tones of one axis in them.

    At constant speed, tones with a shorter way arrive earlier. The transport is cut there, so each tone's
    frequency changes linearly, or not at all, within a segment. Where amplitudes differ, it is cut at every
    site. With another course a transport is one segment. The axis that moves is ramped at pick-up and
    drop-off. The other axis is switched on in the first microseconds of the pick-up, and off in the last of
    the drop-off, which are segments of their own. A batch in which no atom moves counts as moving along its
    row. For batches with paths of tones see :func:`add_path_batch`.

    Args:
        moves: int16 (n, 4), sources on the grid.
        batch_offsets: int32 (>= n_batches + 1,).
        linked: bool (>= n_batches,).
        paths: Paths of the plan.
        cosine: Cosine of the angle between rows and columns.
        n_batches: Number of batches to build.
        axis: 0 for the row tones, 1 for the column tones.
        n_other_sites: Sites of the other axis.
        path_amplitude: float64 (n_sites,), amplitude of each site's tone in batches with paths.
        preassigned: float64 (n_sites,), phase of each site's tone at pick-up, in cycles.
        low_crest: See :func:`first_phases`.
        course: A :class:`labseq.model.FrequencyCourse`, the course of the transports.
        is_uneven: True if amplitudes differ from site to site, on either axis.
        times_s: float64 (6,), durations of the pause before each batch that is not linked, the pick-up ramp,
            the move by one site, the drop-off ramp, and the switching of the parked axis within the two
            ramps.
        segments: Result, arrays of sufficient length.
        values: Result, float64 (5, >= n_tones), the tones.

    Returns:
        Number of segments and number of tones.
    """
    n_sites = most = len(preassigned)
    for number in range(len(paths[0])):
        most = max(most, paths[0][number, 1 + axis])
    tones = np.empty((2, most), np.int64)
    others = np.empty((2, n_other_sites), np.int64)
    phase = np.zeros(most, np.float64)
    path_sites = sites[0], sites[1], path_amplitude
    segments[3][0] = 0
    m = n = at_position = at_knot = 0
    for batch in range(n_batches):
        positions, off, shape = paths_of(paths, batch, at_position, at_knot)
        if len(positions) > 0:
            at_position, at_knot = at_position + len(positions), at_knot + len(off)
            of = positions, off, shape, axis, batch
            start_sites(of, n_sites, tones)
            first_phases(tones, shape[1 + axis], preassigned, low_crest, sites[2], phase)
            m, n = add_path_batch(m, n, of, path_sites, course, cosine, times_s, segments, values, phase)
            continue
        start, stop = batch_offsets[batch], batch_offsets[batch + 1]
        n_tones = collect_tones(moves, start, stop, axis, n_sites, tones)
        n_others = collect_tones(moves, start, stop, 1 - axis, n_other_sites, others)
        follows = linked[batch]
        leads = batch + 1 < n_batches and linked[batch + 1]
        if not follows:
            first_phases(tones, n_tones, preassigned, low_crest, sites[2], phase)
        m, n = add_line_batch(
            m, n, batch, axis, tones[:, :n_tones], others[:, :n_others], follows, leads, sites, course,
            is_uneven, times_s, segments, values, phase,
        )  # fmt: skip
    return m, n


WITHIN: Final = 0
BAND: Final = 1
SPACING: Final = 2
AMPLITUDES: Final = 3
POWER: Final = 4

HALVINGS: Final = 40
VALUES: Final = "float64[:, ::1]"


@helper_kernel(f"UniTuple(float64, 2)({VALUES}, int64, int64, float64)")
def amplitudes_at(values: Floats, first: int, last: int, u: float) -> tuple[float, float]:
    """Sum of the amplitudes of tones at a fraction of their segment, and the sign of its slope."""
    total = slope = 0.0
    for i in range(first, last):
        start, end = values[START_AMPLITUDE, i] ** 2, values[END_AMPLITUDE, i] ** 2
        now = np.sqrt(start + (end - start) * u)
        total += now
        if now > 0.0:
            slope += (end - start) / now
    return total, slope


@kernel(f"float64({VALUES}, int64, int64, float64)")
def greatest_sum(values: Floats, first: int, last: int, limit: float) -> float:
    """The largest sum of the amplitudes in a segment, exact only if it exceeds ``limit``.

    Amplitudes squared are linear in time, so the sum is concave. If some rise and others fall, it may be
    greatest in between, where its slope is 0.
    """
    at_start = at_end = bound = 0.0
    for i in range(first, last):
        start, end = values[START_AMPLITUDE, i], values[END_AMPLITUDE, i]
        at_start += start
        at_end += end
        bound += max(start, end)
    if bound <= limit:
        return bound
    most = max(at_start, at_end)
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        u = 0.5 * (low + high)
        total, slope = amplitudes_at(values, first, last, u)
        most = max(most, total)
        if slope > 0.0:
            low = u
        else:
            high = u
    return most


@kernel(f"Tuple((int64, int64, float64))({const('int32', 1)}, {VALUES}, {const('float64', 1)})")
def first_excess(offsets: Offsets, values: Floats, limits: Floats) -> tuple[int, int, float]:
    """Find the first tone of an axis that breaks a limit.

    Frequencies all follow the same course in a segment, so the distance of two tones is least at its start or
    its end, unless they pass one another and its sign changes. The power is linear in time, so it is greatest
    at the start or the end.

    Args:
        offsets: int32 (n_segments + 1,), where each segment's tones start.
        values: float64 (5, n_tones), the tones.
        limits: float64 (6,) with lowest and highest frequency, least spacing, 1 or -1 where frequencies rise
            or fall from tone to tone, greatest sum of the amplitudes, greatest sum of their squares.

    Returns:
        The limit (WITHIN if none is broken), the tone, which is a segment's first if all its tones are at
        fault, and the value.
    """
    low_hz, high_hz, spacing_hz, direction = limits[0], limits[1], limits[2], limits[3]
    for segment in range(len(offsets) - 1):
        first, last = offsets[segment], offsets[segment + 1]
        power_start = power_end = 0.0
        for i in range(first, last):
            for end in (START_HZ, END_HZ):
                hz = values[end, i]
                if not low_hz <= hz <= high_hz:
                    return BAND, i, hz
                if i > first:
                    gap = direction * (hz - values[end, i - 1])
                    if not gap >= spacing_hz:
                        return SPACING, i, gap
            power_start += values[START_AMPLITUDE, i] ** 2
            power_end += values[END_AMPLITUDE, i] ** 2
        total = greatest_sum(values, first, last, limits[4])
        if not total <= limits[4]:
            return AMPLITUDES, first, total
        power = max(power_start, power_end)
        if not power <= limits[5]:
            return POWER, first, power
    return WITHIN, -1, 0.0
