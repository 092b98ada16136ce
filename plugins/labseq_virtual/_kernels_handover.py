"""Kernels of the laws of ``handover.py``, for one atom, and of pick-up and drop-off. Depths are in kelvin.

``law`` stands for the constants of a world, see :func:`labseq_virtual.handover.constants`; ``reach`` for
the logarithm of the mobile over the static depth and the distance in m below which both wells are one
(2, n). For the other arrays see ``_kernels_transport.py``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel
from labseq_virtual.axis_tones import DARK, EMPTY, END, HELD, NEW, ON_END, START
from labseq_virtual.handover import (
    ADIABATIC_DEPTH,
    DEPTH_DROP,
    INTERMODULATION,
    MOBILE_DEPTH,
    PER_TONE,
    REFERENCE_SPEED_M_S,
    REFERENCE_TONES,
    SHALLOW_LOSS,
    SKEW,
    SLOW,
    SPACING,
    STATIC_DEPTH,
    STATIC_WAIST,
    SUDDEN_S,
    TEMPERATURE,
    TRANSPORT_LOSS,
)
from labseq_virtual.transport import COLLISION, EJECTED, HAND_OVER, TRANSPORT

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
States = NDArray[np.int8]
Mask = NDArray[np.bool_]

TABLE = const("float64", 2)
LIST = const("float64", 1)
SITES = "boolean[:, ::1]"
STATES = "int8[:, ::1]"
NUMBERS = "int64[::1]"


@kernel(f"float64(float64, {TABLE})")
def interpolate(x: float, table: Floats) -> float:
    """Go along straight lines through the points (x rising, y) of a table (2, n); flat beyond its ends."""
    if x <= table[0, 0]:
        return float(table[1, 0])
    for k in range(1, table.shape[1]):
        if x < table[0, k]:
            slope = (table[1, k] - table[1, k - 1]) / (table[0, k] - table[0, k - 1])
            return float(table[1, k - 1] + slope * (x - table[0, k - 1]))
    return float(table[1, -1])


@kernel("float64(float64)")
def exceeds(energy_over_kt: float) -> float:
    """Probability that the thermal energy in a harmonic well in three dimensions exceeds a value."""
    x = max(energy_over_kt, 0.0)
    return math.exp(-x) * (1.0 + x + x * x / 2.0)


@kernel("float64(float64)")
def kinetic_exceeds(energy_over_kt: float) -> float:
    """Probability that the kinetic energy in three dimensions exceeds a value (Maxwell's law)."""
    root = math.sqrt(max(energy_over_kt, 0.0))
    return math.erfc(root) + 2.0 / math.sqrt(math.pi) * root * math.exp(-root * root)


@kernel(f"float64(float64, int64, {LIST})")
def mobile_depth(power: float, n_further: int, law: Floats) -> float:
    """Depth of a mobile tweezer in kelvin; ``power``: of its tones over the one meant."""
    return float(law[MOBILE_DEPTH] * power / (1.0 + law[DEPTH_DROP] * n_further))


@kernel(f"boolean(float64, float64, float64, {TABLE})")
def takes(mobile: float, static: float, distance_m: float, reach: Floats) -> bool:
    """Whether a mobile tweezer that comes on takes the atom of a static one; depths in kelvin."""
    if mobile <= static:
        return False
    log_ratio = math.log(mobile / static) if static > 0.0 else math.inf
    return distance_m < interpolate(log_ratio, reach)


@kernel(f"float64(float64, float64, int64, {LIST})")
def shallow(mobile: float, speed_m_s: float, n_further: int, law: Floats) -> float:
    """Probability that an atom falls out of a mobile tweezer that is too shallow for its speed."""
    if law[ADIABATIC_DEPTH] == 0.0:
        return 0.0
    missing = law[ADIABATIC_DEPTH] * (speed_m_s / REFERENCE_SPEED_M_S) ** 2 - mobile
    scatter = law[INTERMODULATION] * math.sqrt(n_further / REFERENCE_TONES) * mobile
    if scatter > 0.0:
        part = 0.5 * math.erfc(-missing / scatter / math.sqrt(2.0))
    elif missing == 0.0:
        part = 0.5
    else:
        part = 1.0 if missing > 0.0 else 0.0
    return float(law[SHALLOW_LOSS] * part)


@kernel(f"float64(float64, float64, float64, float64, {LIST})")
def spilled(static: float, ratio: float, distance_m: float, ramp_s: float, law: Floats) -> float:
    """Probability that an atom that is let go beside a site does not stay there.

    Args:
        static: Depth of the site, in kelvin.
        ratio: The mobile tweezer's depth over it, while it was on.
        distance_m: Distance of the atom from the site.
        ramp_s: Duration of the drop-off.
        law: The constants.
    """
    waists = distance_m / law[STATIC_WAIST]
    slow = max(interpolate(waists, SLOW), exceeds(static / law[TEMPERATURE]))
    left = static * math.exp(-2.0 * waists * waists)
    sudden = kinetic_exceeds(left / (law[TEMPERATURE] * math.sqrt(1.0 + ratio)))
    part = math.exp(-((ramp_s / SUDDEN_S) ** 2))
    return slow + part * (max(sudden, slow) - slow)


@kernel(f"UniTuple(float64, 3)(float64, float64, float64, float64, int64, float64, float64, {LIST})")
def risks(
    static: float,
    mobile: float,
    distance_m: float,
    fallen: float,
    n_further: int,
    ramp_s: float,
    factor: float,
    law: Floats,
) -> tuple[float, float, float]:
    """Probabilities that an atom that is let go near a site is lost.

    Args:
        static: Depth of the site, in kelvin.
        mobile: Depth of the mobile tweezer while it was on.
        distance_m: Distance of the atom from the site.
        fallen: Probability of :func:`shallow` on the way.
        n_further: Tones that were on beyond one per axis.
        ramp_s: Duration of the drop-off, in seconds.
        factor: The shot's factor on the losses.
        law: The constants.

    Returns:
        That it falls beside the site or out of it; by pick-up and drop-off; on the way.
    """
    ratio = math.inf if mobile > 0.0 else 0.0
    if static > 0.0:
        ratio = mobile / static
    hand_over = 0.0
    if law[TRANSPORT_LOSS] * factor > 0.0:
        nominal = law[MOBILE_DEPTH] / law[STATIC_DEPTH]
        hand_over = min(1.0, factor * law[TRANSPORT_LOSS] * ratio / nominal)
    per_tone = min(1.0, factor * law[PER_TONE] * n_further)
    return spilled(static, ratio, distance_m, ramp_s, law), hand_over, 1.0 - (1.0 - per_tone) * (1.0 - fallen)


@kernel(f"Tuple((int64, int64, float64, boolean))(float64, float64, {TABLE}, {LIST})")
def nearest_site(row: float, col: float, static: Floats, law: Floats) -> tuple[int, int, float, bool]:
    """The site nearest to a place, how far it is in metres, and whether the place is in the grid."""
    r, c = round(row), round(col)
    down, right = row - r, col - c
    away_m = math.sqrt(
        (down * down + right * right) * (law[SPACING] * law[SPACING]) + down * right * law[SKEW]
    )
    inside = 0 <= r < static.shape[0] and 0 <= c < static.shape[1]
    r, c = min(max(r, 0), static.shape[0] - 1), min(max(c, 0), static.shape[1] - 1)
    return r, c, away_m, inside


@kernel(f"void({SITES}, {TABLE}, {TABLE}, {TABLE}, {STATES}, {TABLE}, {LIST}, {TABLE})")
def pick_up(
    occupied: Mask,
    static: Floats,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    law: Floats,
    reach: Floats,
) -> None:
    """Rule 2: crossings that come on take the atoms of the sites near to them, row by row."""
    for i in range(len(row)):
        for j in range(len(col)):
            if state[i, j] != NEW:
                continue
            state[i, j] = EMPTY
            r, c, away_m, inside = nearest_site(row[i, START], col[j, START], static, law)
            if inside and occupied[r, c] and takes(depth[i, j], static[r, c], away_m, reach):
                state[i, j] = HELD
                occupied[r, c] = False


@kernel("int64(boolean[:, ::1], int64[::1], int64)")
def land(occupied: Mask, sites: Ints, n: int) -> int:
    """Put n atoms on their sites, all at once; where two meet, all are lost; returns how many."""
    n_lost = 0
    for k in range(n):
        site, n_here = int(sites[k]), 0
        if site < 0:
            continue
        for other in range(k, n):
            if sites[other] == site:
                sites[other] = -1
                n_here += 1
        r, c = site // occupied.shape[1], site % occupied.shape[1]
        n_here += int(occupied[r, c])
        occupied[r, c] = n_here == 1
        n_lost += n_here if n_here > 1 else 0
    return n_lost


@kernel(
    f"int64({SITES}, {TABLE}, {TABLE}, {TABLE}, {STATES}, {TABLE}, {TABLE}, int64, float64, float64, "
    f"{TABLE}, int64, {LIST}, {NUMBERS}, {NUMBERS})"
)
def set_down(
    occupied: Mask,
    static: Floats,
    row: Floats,
    col: Floats,
    state: States,
    depth: Floats,
    risk: Floats,
    n_further: int,
    ramp_s: float,
    factor: float,
    draws: Floats,
    n_drawn: int,
    law: Floats,
    work: Ints,
    lost: Ints,
) -> int:
    """Rule 5: crossings that go out set their atoms down; returns how many draws are used up by now."""
    n = 0
    for i in range(len(row)):
        for j in range(len(col)):
            if row[i, ON_END] * col[j, ON_END] > 0.0:
                continue
            held, state[i, j] = state[i, j] == HELD, DARK
            if not held:
                continue
            r, c, away_m, inside = nearest_site(row[i, END], col[j, END], static, law)
            spilled, hand_over, transport = risks(
                static[r, c], depth[i, j], away_m, risk[i, j], n_further, ramp_s, factor, law
            )
            draw = draws[n_drawn]
            n_drawn += 1
            if not inside:
                lost[EJECTED] += 1
            elif draw[0] < spilled or draw[1] < hand_over:
                lost[HAND_OVER] += 1
            elif draw[2] < transport:
                lost[TRANSPORT] += 1
            else:
                work[n] = r * static.shape[1] + c
                n += 1
    lost[COLLISION] += land(occupied, work, n)
    return n_drawn
