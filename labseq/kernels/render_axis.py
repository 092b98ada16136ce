"""The kernel that renders any stretch of an axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import kernel
from labseq.kernels.render_comb_segment import render_comb
from labseq.kernels.render_direct import add_ramped_tone, add_steep, add_tone, fill_nodes, is_steep
from labseq.kernels.render_paths import (
    DIRECT,
    END,
    END_AMPLITUDE,
    PHASE,
    SILENT,
    START,
    START_AMPLITUDE,
    envelope,
)
from labseq.kernels.render_store import apply_envelope, store
from labseq.kernels.render_tables import LANES
from labseq.kernels.render_types import AXIS, FULL_SCALE, ROOM, SAMPLES, Axis, Room, strip_samples


@kernel(f"void({AXIS}, int64, int64, float64, int64, boolean, {ROOM})")
def add_direct(axis: Axis, i: int, k: int, x: float, n: int, shared: bool, room: Room) -> None:
    """Add tone ``k`` of segment ``i`` to ``n`` samples, the first of them ``x`` samples after its start."""
    tones, _, course, _, _, _, _, _, _, length, _, _ = axis
    work, nodes = room[1], room[7]
    a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
    if shared:
        a = b = max(a, b)
    phase, frequency, sweep = tones[PHASE, k], tones[START, k], tones[END, k] - tones[START, k]
    slope = FULL_SCALE**2 * (b * b - a * a) / length[i]
    start = FULL_SCALE**2 * a * a + slope * x
    if is_steep(course[i], sweep, length[i]):
        add_steep(work[SAMPLES], n, course[i], phase, frequency, sweep, length[i], x, start, slope)
        return
    n_nodes = (n + LANES - 1) // LANES
    fill_nodes(course[i], phase, frequency, sweep, length[i], x, n_nodes, nodes)
    if a == b:
        add_tone(work[SAMPLES], n_nodes, nodes, FULL_SCALE * a)
    else:
        add_ramped_tone(work[SAMPLES], n_nodes, nodes, start, slope)


@kernel(f"void({AXIS}, int64, int64, int16[::1], {ROOM})")
def render_direct(axis: Axis, i: int, skip: int, out: NDArray[np.int16], room: Room) -> None:
    """Render a stretch of segment ``i`` tone by tone; see :func:`render_comb`."""
    tones, offsets, _, _, _, _, _, _, delta, length, _, block = axis
    work = room[1]
    shared, first, last = envelope(tones, offsets[i], offsets[i + 1])
    slope = (last - first) / length[i]
    strip = strip_samples(block)
    for s in range(skip // strip, (skip + len(out) - 1) // strip + 1):
        x = s * strip + delta[i]
        start, stop = max(0, skip - s * strip), min(strip, skip + len(out) - s * strip)
        work[SAMPLES, :stop] = np.float32(0.0)
        for k in range(offsets[i], offsets[i + 1]):
            add_direct(axis, i, k, x, stop, shared, room)
        if first != last:
            apply_envelope(work[SAMPLES], stop, first + slope * x, slope)
        store(out[s * strip + start - skip :], stop - start, work[SAMPLES], start)


@kernel(f"void({AXIS}, int64, int16[::1], {ROOM})")
def render(axis: Axis, start: int, out: NDArray[np.int16], room: Room) -> None:
    """Render a stretch of an axis; what lies after its end is silent.

    Args:
        axis: The axis.
        start: First sample, counted from the start of the program.
        out: Result, int16 (n,).
        room: Room to work in, for this thread alone.
    """
    path, first = axis[3], axis[7]
    stop = start + len(out)
    i = int(np.searchsorted(first, start, "right")) - 1
    at = start
    while at < stop and i < len(path):
        until = min(stop, first[i + 1])
        if at < until:
            piece = out[at - start : until - start]
            if path[i] == SILENT:
                piece[:] = 0
            elif path[i] == DIRECT:
                render_direct(axis, i, at - first[i], piece, room)
            else:
                render_comb(axis, i, at - first[i], piece, room)
            at = until
        i += 1
    out[at - start :] = 0
