"""Where a tone jumps: in phase, or faster in depth than any ramp."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from labseq_virtual.tones import HOPS, Tracks

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
            "t_s": "when, from the start of the shot",
            "kind": "phase, of a tone; or depth, of a tweezer",
            "row": "row in sites; nan for the phase of a column's tone",
            "col": "column in sites; nan for the phase of a row's tone",
            "size": "in rad, or as a fraction of the full depth",
        }
    },
)
"""A jump: when, of which kind, where in sites, and how large.

A "phase" jump is that of one tone, in rad: of the column's tone where ``row`` is nan, and the other
way round. A "depth" jump is that of a tweezer, as a fraction of the full depth.
"""

INNER: Final = 3 * HOPS // 4
OUTER: Final = 2 * HOPS
"""Frames on each side of a place, from which to which a tone is looked at: the nearer ones see the jump."""
MIN_RAD: Final = 0.5
RESIDUAL_RAD: Final = 0.02
"""Greatest misfit of a smooth course; where it is worse, something else happens, such as a second start."""
CHIRP_RAD: Final = 0.3
"""What a change of the chirp must amount to within the inner frames to tell its place."""
MIN_DEPTH: Final = 0.6
"""Change of the depth in a transit time; a ramp of 60 us makes a sixth."""


def phase_jumps(tracks: Tracks, j: int) -> list[tuple[float, int, float]]:
    """The phase jumps of one of the tones.

    A phase jump is the difference between what a tone's course before and after leads one to expect.
    Both courses are quadratic in time (constant chirp). Where the chirp changes too, the jump is taken
    where both have the same frequency: motion is continuous.

    Args:
        tracks: The tones.
        j: Which one.

    Returns:
        Time, frame and size in rad of each.
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
    first, setting_error = _fit(courses[:, before], at_s[before])
    second, other_misfit = _fit(courses[:, after], at_s[after])
    shift, slope, bend = (second - first).T
    inner_s = INNER * step_s
    bent = np.abs(bend) * inner_s**2 > CHIRP_RAD
    place_s = np.where(bent, -slope / np.where(bent, 2 * bend, 1.0), 0.0)
    size = _wrapped(shift + slope * place_s + bend * place_s**2)
    fine = (np.maximum(setting_error, other_misfit) < RESIDUAL_RAD) & (np.abs(place_s) <= inner_s)
    found = peaks(np.where(fine, np.abs(size), 0.0), MIN_RAD, 2 * INNER)
    return [(float(tracks.t_s[k + OUTER] + place_s[k]), k + OUTER, float(size[k])) for k in found]


def depth_jumps(depth: Floats) -> list[tuple[int, float]]:
    """The jumps of a tweezer's depth.

    Args:
        depth: Fraction of the full depth in each frame, (n_frames,), 0 where off.

    Returns:
        Frame and size of each.
    """
    change = depth[HOPS:] - depth[:-HOPS]
    return [(k + HOPS // 2, float(change[k])) for k in peaks(np.abs(change), MIN_DEPTH, HOPS)]


def peaks(values: Floats, least: float, apart: int) -> list[int]:
    """The middle of each stretch of values above a limit; what is at most ``apart`` apart is one stretch."""
    above = np.flatnonzero(values > least)
    if not len(above):
        return []
    groups = np.split(above, np.flatnonzero(np.diff(above) > apart) + 1)
    return [int(group[len(group) // 2]) for group in groups]


def _fit(courses: Floats, at_s: Floats) -> tuple[Floats, Floats]:
    """Coefficients of the quadratics through some courses, and their worst misfits."""
    powers = np.vander(at_s, 3, increasing=True)
    fit = courses @ np.linalg.pinv(powers).T
    return fit, np.abs(courses - fit @ powers.T).max(axis=1)


def _wrapped(phase_rad: Floats) -> Floats:
    return (phase_rad + np.pi) % (2 * np.pi) - np.pi
