"""Jumps of the phase of a tone, and of the depth of a tweezer."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from labseq_virtual.rf_analysis import HOPS, Tracks

Floats = NDArray[np.float64]


JUMPS: Final = np.dtype(
    [
        ("t_s", np.float64),
        ("kind", "S5"),
        ("row", np.float32),
        ("col", np.float32),
        ("size", np.float32),
    ],
    metadata={
        "descriptions": {
            "t_s": "time from the start of the shot",
            "kind": "phase (of a tone) or depth (of a tweezer)",
            "row": "row in sites, nan for the phase of a column's tone",
            "col": "column in sites, nan for the phase of a row's tone",
            "size": "in rad, or as a fraction of the full depth",
        }
    },
)
"""A jump of the phase of a tone, or of the depth of a tweezer."""

INNER: Final = 3 * HOPS // 4
OUTER: Final = 2 * HOPS
"""A jump is found by extrapolating fits to the frames from OUTER to INNER before it and from INNER to
OUTER after it. Closer frames are blurred by the jump itself."""
MIN_RAD: Final = 0.75
"""Smallest reported phase jump (ours), because a steadily changing chirp looks like 0.6 rad."""
RESIDUAL_RAD: Final = 0.02
"""Largest residual of the fits. A larger one means something else, such as a second start."""
CHIRP_RAD: Final = 0.3
"""Smallest phase that a change of the chirp must add within the inner frames for its time to be known."""
MIN_DEPTH: Final = 0.6
"""Smallest reported change of the depth within a transit time. A ramp of 60 us makes a sixth."""


def phase_jumps(tracks: Tracks, j: int) -> list[tuple[float, int, float]]:
    """The phase jumps of one of the tones.

    The phase before and the phase after are each fitted by a quadratic in time (constant chirp). The jump
    is the difference of the two fits. If the chirp also changes, the difference is taken at the time
    when both have the same frequency, because the tweezer's motion is continuous.

    Returns:
        Time, frame and size in rad of each jump.
    """
    hz, phase = tracks.frequency_hz[:, j], tracks.phase_rad[:, j]
    n_span = 2 * OUTER + 1
    if len(hz) < n_span:
        return []
    step_s = float(tracks.t_s[1] - tracks.t_s[0])
    advance = np.pi * step_s * (hz[1:] + hz[:-1])
    advance += _wrapped(np.diff(phase) - advance)
    # Relative to the frequency in the middle of each window.
    steps = sliding_window_view(advance, n_span - 1) - 2 * np.pi * step_s * hz[OUTER:-OUTER, None]
    courses = np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)
    before, after = np.arange(OUTER - INNER + 1), np.arange(OUTER + INNER, n_span)
    at_s = np.arange(-OUTER, OUTER + 1, dtype=np.float64) * step_s
    first, residual_before = _fit(courses[:, before], at_s[before])
    second, residual_after = _fit(courses[:, after], at_s[after])
    shift, slope, bend = (second - first).T
    inner_s = INNER * step_s
    changes_chirp = np.abs(bend) * inner_s**2 > CHIRP_RAD
    place_s = np.where(changes_chirp, -slope / np.where(changes_chirp, 2 * bend, 1.0), 0.0)
    size = _wrapped(shift + slope * place_s + bend * place_s**2)
    is_clear = (np.maximum(residual_before, residual_after) < RESIDUAL_RAD) & (np.abs(place_s) <= inner_s)
    middles = peaks(np.where(is_clear, np.abs(size), 0.0), MIN_RAD, 2 * INNER)
    return [(float(tracks.t_s[k + OUTER] + place_s[k]), k + OUTER, float(size[k])) for k in middles]


def depth_jumps(depth: Floats) -> list[tuple[int, float]]:
    """The jumps of a tweezer's depth.

    Returns:
        Frame and size of each jump.
    """
    change = depth[HOPS:] - depth[:-HOPS]
    return [(k + HOPS // 2, float(change[k])) for k in peaks(np.abs(change), MIN_DEPTH, HOPS)]


def peaks(values: Floats, least: float, apart: int) -> list[int]:
    """Middle of each run of values above ``least``. Gaps of at most ``apart`` do not end a run."""
    above = np.flatnonzero(values > least)
    if not len(above):
        return []
    groups = np.split(above, np.flatnonzero(np.diff(above) > apart) + 1)
    return [int(group[len(group) // 2]) for group in groups]


def _fit(courses: Floats, at_s: Floats) -> tuple[Floats, Floats]:
    """Coefficients of quadratics fitted to each course, and their largest residuals."""
    powers = np.vander(at_s, 3, increasing=True)
    fit = courses @ np.linalg.pinv(powers).T
    return fit, np.abs(courses - fit @ powers.T).max(axis=1)


def _wrapped(phase_rad: Floats) -> Floats:
    return (phase_rad + np.pi) % (2 * np.pi) - np.pi


def find_jumps(
    tracks_of_axes: list[Tracks], sites: list[Floats], depths: list[Floats], bright: NDArray[np.bool_]
) -> list[tuple[Any, ...]]:
    """The jumps of the row and the column tones, and of their tweezers, each as a row of :data:`JUMPS`.

    Args:
        tracks_of_axes: Tones of the rows and of the columns.
        sites: Positions of these tones in sites, (n_frames, n_tones) each.
        depths: Depth factors of these tones, (n_frames, n_tones) each.
        bright: bool (n_frames,), whether a tweezer is deep. Atoms do not feel a phase jump in the dark.
    """
    jumps: list[tuple[Any, ...]] = []
    for axis, tracks in enumerate(tracks_of_axes):
        for j in range(sites[axis].shape[1]):
            for time_s, k, size in phase_jumps(tracks, j):
                if not bright[max(0, k - HOPS) : k + HOPS + 1].all():
                    continue
                place = sites[axis][min(k, len(sites[axis]) - 1), j]
                sites_of_jump = (place, math.nan) if axis == 0 else (math.nan, place)
                jumps.append((time_s, b"phase", *sites_of_jump, size))
    rows, cols = (np.nan_to_num(depth) for depth in depths)
    for i in range(rows.shape[1]):
        for j in range(cols.shape[1]):
            for k, size in depth_jumps(rows[:, i] * cols[:, j]):
                near = slice(max(0, k - HOPS), k + HOPS + 1)
                sites_of_jump = (_first_known(sites[0][near, i]), _first_known(sites[1][near, j]))
                jumps.append((float(tracks_of_axes[0].t_s[k]), b"depth", *sites_of_jump, size))
    return jumps


def _first_known(values: Floats) -> float:
    finite = values[~np.isnan(values)]
    return float(finite[0]) if len(finite) else math.nan
