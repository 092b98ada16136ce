"""Kernels for one mobile tweezer and its atom: its depth, what it takes, and what a move does to the atom.

Arguments that occur in several kernels:

- ``constants``: the constants of the simulation, see :func:`labseq_virtual.handover.constants`.
- ``tables``: how atoms respond, see :func:`labseq_virtual.responses.move_tables`.
- ``tweezer``: the crossing of a row tone and a column tone, and its course since it switched on (N_TWEEZER,),
  with the columns below.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel
from labseq.plugin.motion import FrequencyCourse
from labseq_virtual.handover import (
    ADIABATIC_DEPTH,
    DEPTH_DROP,
    HELD,
    INTERMODULATION,
    MOBILE_DEPTH,
    NOISE_HZ,
    PER_TONE,
    REFERENCE_TONES,
    SHALLOW_LOSS,
    SPACING,
    STATIC_DEPTH,
    TRANSPORT_LOSS,
)
from labseq_virtual.response_kernels import at_once, carry, hand_over
from labseq_virtual.responses import REFERENCE_SPEED_M_S
from labseq_virtual.transport import FASTEST

Floats = NDArray[np.float64]

TABLE, VECTOR = const("float64", 2), const("float64", 1)
TWEEZER = "float64[::1]"

(
    STATE,
    DEPTH,
    RISK,
    PEAK,
    RISE_S,
    FALL_S,
    SITE_DEPTH,
    AWAY,
    HEAT,
    LOST,
    IS_PICKED,
    DOWN,
    RIGHT,
    SPEED,
    STOP_SPEED,
    LEG_HEAT,
    REST_S,
) = range(17)
"""Columns of a tweezer: its state (``handover.py``); its greatest depth in the segment in kelvin; the
probability that the atom fell out because the tweezer was too shallow; the greatest depth so far; the
durations of the ramps at start and end; depth and distance of the site that the atom came from; its
temperature, as it would be in a static tweezer of nominal depth; the probability that it was lost so far;
whether the pick-up is contained in both; the velocity, in sites per second; the speed of the last motion, in
m/s, and the same if it stopped at once, else 0; the temperature at its start; the time at rest since the last
ramp up or motion."""
N_TWEEZER = 17
LINEAR = int(FrequencyCourse.LINEAR)
NEW_LEG = 0.8
"""Change of the velocity, relative to the greater one, from which on a tweezer has started again; smaller
ones are the bends of a curve, each with less than a third of the energy of a start and a stop."""
RAMP = 0.7
"""Ratio of the powers at the two ends of a segment below which it is part of a ramp: tones that give depths
that differ from site to site change less."""
INSTANT_S = 1e-12
"""Duration assumed for a segment of duration 0, in seconds."""


@helper_kernel(f"float64(float64, {TABLE})")
def interpolate(x: float, table: Floats) -> float:
    """Linear interpolation in a table (2, n) of x, rising, and y; constant beyond its ends."""
    if x <= table[0, 0]:
        return float(table[1, 0])
    for k in range(1, table.shape[1]):
        if x < table[0, k]:
            slope = (table[1, k] - table[1, k - 1]) / (table[0, k] - table[0, k - 1])
            return float(table[1, k - 1] + slope * (x - table[0, k - 1]))
    return float(table[1, -1])


@helper_kernel(f"float64(float64, int64, {VECTOR})")
def mobile_depth(power: float, n_further: int, constants: Floats) -> float:
    """Depth of a mobile tweezer in kelvin; ``power``: power of its tones relative to the intended one."""
    return float(constants[MOBILE_DEPTH] * power / (1.0 + constants[DEPTH_DROP] * n_further))


@helper_kernel(f"boolean(float64, float64, float64, {TABLE})")
def takes(mobile: float, static: float, distance_m: float, merging: Floats) -> bool:
    """Whether a mobile tweezer that switches on takes the atom of a static one; depths in kelvin.

    ``merging`` has the logarithm of the ratio of mobile to static depth, and the distance in metres below
    which the two wells are one (2, n).
    """
    if mobile <= static:
        return False
    log_ratio = math.log(mobile / static) if static > 0.0 else math.inf
    return distance_m < interpolate(log_ratio, merging)


@helper_kernel(f"float64(float64, float64, int64, {VECTOR})")
def shallow(mobile: float, speed_m_s: float, n_further: int, constants: Floats) -> float:
    """Probability that an atom falls out of a mobile tweezer that is too shallow for its speed."""
    if constants[ADIABATIC_DEPTH] == 0.0:
        return 0.0
    missing = constants[ADIABATIC_DEPTH] * (speed_m_s / REFERENCE_SPEED_M_S) ** 2 - mobile
    scatter = constants[INTERMODULATION] * math.sqrt(n_further / REFERENCE_TONES) * mobile
    if scatter > 0.0:
        part = 0.5 * math.erfc(-missing / scatter / math.sqrt(2.0))
    elif missing == 0.0:
        part = 0.5
    else:
        part = 1.0 if missing > 0.0 else 0.0
    return float(constants[SHALLOW_LOSS] * part)


@helper_kernel(f"void({TWEEZER}, float64, float64)")
def affect(tweezer: Floats, loss: float, warmer: float) -> None:
    """Add a loss, and a ratio of temperatures, to the course of a tweezer."""
    tweezer[LOST] = 1.0 - (1.0 - tweezer[LOST]) * (1.0 - loss)
    tweezer[HEAT] *= warmer


@helper_kernel(f"void({TWEEZER}, {VECTOR}, {VECTOR})")
def settle(tweezer: Floats, constants: Floats, tables: Floats) -> None:
    """Add the pick-up to the course of a tweezer that holds an atom, unless it is contained."""
    if tweezer[IS_PICKED] > 0.0:
        return
    tweezer[IS_PICKED] = 1.0
    depth, peak, away, rise_s = tweezer[SITE_DEPTH], tweezer[PEAK], tweezer[AWAY], tweezer[RISE_S]
    loss, warmer = hand_over(0, depth, peak, away, rise_s, tweezer[HEAT], constants, tables)
    affect(tweezer, loss, warmer)


@helper_kernel(
    f"void({TWEEZER}, float64, float64, float64, float64, float64, int64, int64, {VECTOR}, {VECTOR})"
)
def advance(
    tweezer: Floats, start: float, end: float, down: float, right: float, duration_s: float, kind: int,
    n_further: int, constants: Floats, tables: Floats,
) -> None:  # fmt: skip
    """Continue the course of a tweezer over a segment.

    Args:
        tweezer: The tweezer; changed in place.
        start: Power of its tones at the start, relative to the intended one.
        end: The same at the end.
        down: Its displacement along the columns, in sites.
        right: Its displacement along a row.
        duration_s: Duration of the segment.
        kind: Course of the frequencies.
        n_further: Tones that are on beyond one per axis.
        constants: The constants.
        tables: The tables.
    """
    duration_s, depth = max(duration_s, INSTANT_S), tweezer[DEPTH]
    tweezer[PEAK] = max(tweezer[PEAK], depth)
    rises, falls = start < RAMP * end, end < RAMP * start
    if rises:
        tweezer[RISE_S] += duration_s
    tweezer[FALL_S] = tweezer[FALL_S] + duration_s if falls else 0.0
    ratio = depth / constants[STATIC_DEPTH]
    tweezer[HEAT] *= math.exp(min(duration_s * constants[NOISE_HZ] * ratio, 20.0))
    down_hz, right_hz = down / duration_s, right / duration_s
    change = math.hypot(down_hz - tweezer[DOWN], right_hz - tweezer[RIGHT])
    starts = change > NEW_LEG * max(math.hypot(down_hz, right_hz), math.hypot(tweezer[DOWN], tweezer[RIGHT]))
    tweezer[DOWN], tweezer[RIGHT] = down_hz, right_hz
    length_m = math.hypot(down, right) * constants[SPACING]
    if length_m == 0.0:
        if not falls:
            tweezer[REST_S] = 0.0 if rises else tweezer[REST_S] + duration_s
        return
    tweezer[SPEED] = length_m / duration_s
    tweezer[STOP_SPEED] = tweezer[SPEED] if kind == LINEAR else 0.0
    risk = shallow(depth, length_m / duration_s * FASTEST[kind], n_further, constants)
    tweezer[RISK] = max(tweezer[RISK], risk)
    if tweezer[STATE] == HELD and starts:
        is_first = tweezer[IS_PICKED] == 0.0
        settle(tweezer, constants, tables)
        heat = tweezer[LEG_HEAT] = tweezer[HEAT]
        loss, warmer = carry(kind, tweezer[SPEED], length_m, depth, heat, constants, tables)
        affect(tweezer, loss, warmer)
        if is_first and tweezer[STOP_SPEED] > 0.0:
            ramp_s = tweezer[RISE_S] + tweezer[REST_S]
            loss, warmer = at_once(0, depth, tweezer[SPEED], ramp_s, heat, constants, tables)
            affect(tweezer, loss, warmer)
    tweezer[REST_S] = 0.0


@helper_kernel(f"UniTuple(float64, 4)(float64, {TWEEZER}, float64, int64, float64, {VECTOR}, {VECTOR})")
def risks(
    static: float, tweezer: Floats, distance_m: float, n_further: int, factor: float, constants: Floats,
    tables: Floats,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Probabilities that an atom dropped off near a site is lost.

    Args:
        static: Depth of the site, in kelvin.
        tweezer: The tweezer that holds it.
        distance_m: Distance of the atom from the site.
        n_further: Tones that were on beyond one per axis.
        factor: The shot's factor on the losses.
        constants: The constants.
        tables: The tables.

    Returns:
        The probabilities of losing it to heat, to pick-up and drop-off, and in motion; and its temperature.
    """
    settle(tweezer, constants, tables)
    peak, stop_speed, fall_s = tweezer[PEAK], tweezer[STOP_SPEED], tweezer[FALL_S]
    if stop_speed > 0.0:
        ramp_s = tweezer[REST_S] + fall_s
        loss, warmer = at_once(1, peak, stop_speed, ramp_s, tweezer[LEG_HEAT], constants, tables)
        affect(tweezer, loss, warmer)
    ratio = math.inf if peak > 0.0 else 0.0
    if static > 0.0:
        ratio = peak / static
    by_hand_over = 0.0
    if constants[TRANSPORT_LOSS] * factor > 0.0:
        nominal = constants[MOBILE_DEPTH] / constants[STATIC_DEPTH]
        by_hand_over = min(1.0, factor * constants[TRANSPORT_LOSS] * ratio / nominal)
    per_tone = min(1.0, factor * constants[PER_TONE] * n_further)
    loss, warmer = hand_over(1, static, peak, distance_m, fall_s, tweezer[HEAT], constants, tables)
    return (
        1.0 - (1.0 - tweezer[LOST]) * (1.0 - loss),
        by_hand_over,
        1.0 - (1.0 - per_tone) * (1.0 - tweezer[RISK]),
        tweezer[HEAT] * warmer,
    )
