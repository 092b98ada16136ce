"""Kernels that say what an axis plays at its sites: frequencies, amplitudes, first phases."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Moves = NDArray[np.int16]

MOVES: Final = const("int16", 2)
SITES: Final = const("float64", 1)
TONES: Final = "int64[:, ::1]"


@kernel(f"int64({MOVES}, int64, int64, int64, int64, {TONES})")
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


@kernel(f"int64({TONES}, int64, int64)")
def next_arrival(tones: Ints, n_tones: int, travelled: int) -> int:
    """Distance, in sites, at which the next tones arrive; ``travelled`` if all have."""
    nearest = travelled
    for k in range(n_tones):
        distance = abs(tones[1, k] - tones[0, k])
        if distance > travelled and (nearest == travelled or distance < nearest):
            nearest = distance
    return nearest


@kernel(f"int64({TONES}, int64)")
def last_arrival(tones: Ints, n_tones: int) -> int:
    """The longest way of all tones, in sites."""
    longest = 0
    for k in range(n_tones):
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


@kernel(f"float64({SITES}, int64, int64, int64)")
def amplitude(site_amplitude: Floats, site: int, goal: int, travelled: int) -> float:
    """Amplitude of a tone on its way: its square changes evenly from that of the site to that of the goal.

    Beyond the grid it is that of the outermost site.

    Args:
        site_amplitude: float64 (n_sites,), amplitude preassigned to each site.
        site: Where the tone starts.
        goal: Where it goes.
        travelled: Sites that it has travelled, or more if it has arrived.
    """
    last = len(site_amplitude) - 1
    start, end = site_amplitude[site], site_amplitude[min(max(goal, 0), last)]
    way = abs(goal - site)
    if travelled <= 0 or start == end:
        return start
    if travelled >= way:
        return end
    return np.sqrt(start**2 + (end**2 - start**2) * travelled / way)


@kernel(f"void({TONES}, int64, {SITES}, boolean, {SITES}, float64[::1])")
def first_phases(
    tones: Ints, n_tones: int, preassigned: Floats, low_crest: bool, site_amplitude: Floats, phase: Floats
) -> None:
    """Choose the phases of a batch's tones at pick-up.

    For a low crest factor they follow Schroeder (IEEE Trans. Inf. Theory 16, 85, 1970):
    on a comb of teeth with relative powers p_l, the k-th has the phase
    ``-2 pi sum_(l < k) (k - l) p_l``. Tones that are off count as teeth without power.

    Args:
        tones: int64 (2, >= n_tones), site and goal of each tone.
        n_tones: Number of tones.
        preassigned: float64 (n_sites,), phase of each site's tone, in cycles.
        low_crest: Whether to choose by Schroeder's rule instead.
        site_amplitude: float64 (n_sites,), amplitude of each site's tone.
        phase: Result, float64 (>= n_tones,), in cycles, 0 <= phase < 1.
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
