"""Kernels that look up how atoms respond to the stages of a move (``responses.py``), and to time.

``tables``: the tables of a move, one after the other, see
:func:`labseq_virtual.responses.move_tables`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel
from labseq_virtual.handover import COOLING_HZ, NOISE_HZ, STATIC_DEPTH, STATIC_WAIST, TEMPERATURE
from labseq_virtual.responses import (
    AWAY,
    BESIDE,
    DEPTH_K,
    LANDING_SPEEDS,
    LEAST_LOSS,
    PASSING_SPEEDS,
    RAMPS_S,
    RATIOS,
    SITE_M,
    SPEEDS,
    START_RAMPS_S,
    START_SPEEDS,
    TEMPERATURES,
    WAIST_M,
)

Floats = NDArray[np.float64]

VECTOR = const("float64", 1)

RAMP_AXIS, AWAY_AXIS, SPEED_AXIS = np.array(RAMPS_S), np.array(AWAY), np.array(SPEEDS)
RATIO_AXIS, TEMPERATURE_AXIS = np.array(RATIOS), np.array(TEMPERATURES)
N_RAMP = len(RAMPS_S) * len(AWAY) * len(RATIOS) * len(TEMPERATURES)
LANDING_AXIS, PASSING_AXIS, BESIDE_AXIS = np.array(LANDING_SPEEDS), np.array(PASSING_SPEEDS), np.array(BESIDE)
N_LANDING = len(LANDING_SPEEDS) * len(RAMPS_S) * len(RATIOS) * len(TEMPERATURES)
N_PASSING = len(PASSING_SPEEDS) * len(BESIDE) * len(RATIOS) * len(TEMPERATURES)
N_TRANSPORT = 3 * len(SPEEDS) * len(RATIOS) * len(TEMPERATURES)
START_RAMP_AXIS, START_SPEED_AXIS = np.array(START_RAMPS_S), np.array(START_SPEEDS)
N_START = len(START_RAMPS_S) * len(START_SPEEDS) * len(RATIOS) * len(TEMPERATURES)
TRANSPORT_AT = 4 * N_RAMP
LANDING_AT = TRANSPORT_AT + 2 * N_TRANSPORT
PASSING_AT = LANDING_AT + 2 * N_LANDING
START_AT = PASSING_AT + 2 * N_PASSING
"""Where the tables after those of pick-up and drop-off begin."""
CURVED_SITES = 4.0
"""Length of the moves in the table of a curved course, in sites."""


@helper_kernel(f"Tuple((int64, float64))({VECTOR}, float64)")
def locate(axis: Floats, x: float) -> tuple[int, float]:
    """The interval of an axis that a value is in, and where in it; the nearest end if it is beyond."""
    if not x > axis[0]:
        return 0, 0.0
    for k in range(1, len(axis)):
        if x <= axis[k]:
            return k - 1, (x - axis[k - 1]) / (axis[k] - axis[k - 1])
    return len(axis) - 2, 1.0


@helper_kernel(
    f"UniTuple(float64, 2)({VECTOR}, int64, int64, float64, float64, {VECTOR}, float64, float64, float64)"
)
def respond(
    tables: Floats,
    first: int,
    n: int,
    one: float,
    x: float,
    axis: Floats,
    ratio: float,
    temperature: float,
    steps: float,
) -> tuple[float, float]:
    """Loss, and ratio of the temperatures after and before, by linear interpolation.

    Args:
        tables: The tables.
        first: Where the table starts.
        n: Number of its points.
        one: Place on its first axis, in steps.
        x: Value on its second one, ``axis``.
        axis: That axis.
        ratio: Mobile over static depth.
        temperature: In the static tweezer of the tables.
        steps: Number of points on the first axis.
    """
    i, a = int(min(one, steps - 2.0)), one - int(min(one, steps - 2.0))
    j, b = locate(axis, x)
    k, c = locate(RATIO_AXIS, ratio)
    m, d = locate(TEMPERATURE_AXIS, temperature)
    loss = warmer = 0.0
    for corner in range(16):
        p, q, r, s = corner & 1, (corner >> 1) & 1, (corner >> 2) & 1, corner >> 3
        weight = (a if p else 1 - a) * (b if q else 1 - b) * (c if r else 1 - c) * (d if s else 1 - d)
        if weight > 0.0:
            at = (((i + p) * len(axis) + j + q) * len(RATIO_AXIS) + k + r) * len(TEMPERATURE_AXIS) + m + s
            loss += weight * tables[first + at]
            warmer += weight * tables[first + n + at]
    return loss, warmer


@helper_kernel(f"float64(float64, {VECTOR})")
def quicker(static: float, constants: Floats) -> float:
    """Trap frequency of a static tweezer relative to that of the tables; ``static``: its depth in kelvin."""
    return math.sqrt(static / DEPTH_K) * WAIST_M / constants[STATIC_WAIST]


@helper_kernel(
    f"UniTuple(float64, 2)(int64, float64, float64, float64, float64, float64, {VECTOR}, {VECTOR})"
)
def hand_over(
    stage: int,
    static: float,
    mobile: float,
    away_m: float,
    ramp_s: float,
    heat: float,
    constants: Floats,
    tables: Floats,
) -> tuple[float, float]:
    """Loss and ratio of temperatures at pick-up (stage 0) or drop-off (stage 1).

    Args:
        stage: Which.
        static: Depth of the static tweezer, in kelvin.
        mobile: Greatest depth of the mobile one.
        away_m: Distance between both, in metres.
        ramp_s: Duration of the ramp.
        heat: Temperature of the atom in a static tweezer of the nominal depth.
        constants: The constants.
        tables: The tables.
    """
    if not static > 0.0:
        return 1.0, 1.0
    temperature = heat * math.sqrt(static / constants[STATIC_DEPTH]) * DEPTH_K / static
    i, part = locate(RAMP_AXIS, ramp_s * quicker(static, constants))
    away = away_m / constants[STATIC_WAIST]
    first = 2 * N_RAMP * stage
    return respond(
        tables, first, N_RAMP, i + part, away, AWAY_AXIS, mobile / static, temperature, len(RAMP_AXIS)
    )


@helper_kernel(f"UniTuple(float64, 2)(int64, float64, float64, float64, float64, {VECTOR}, {VECTOR})")
def carry(
    course: int,
    speed_m_s: float,
    length_m: float,
    mobile: float,
    heat: float,
    constants: Floats,
    tables: Floats,
) -> tuple[float, float]:
    """Loss and ratio of temperatures of a move; ``speed_m_s``: the mean one over ``length_m``."""
    static = constants[STATIC_DEPTH]
    speed = speed_m_s * WAIST_M / constants[STATIC_WAIST] / quicker(static, constants)
    if course > 0:  # what counts is the acceleration
        speed *= math.sqrt(CURVED_SITES * SITE_M / max(length_m, 0.1 * SITE_M))
    temperature = heat * DEPTH_K / static
    return respond(
        tables, TRANSPORT_AT, N_TRANSPORT, float(course), speed, SPEED_AXIS, mobile / static, temperature, 3.0
    )


@helper_kernel(f"UniTuple(float64, 2)(float64, float64, float64, float64, float64, {VECTOR}, {VECTOR})")
def land_on(
    static: float,
    mobile: float,
    speed_m_s: float,
    ramp_s: float,
    heat: float,
    constants: Floats,
    tables: Floats,
) -> tuple[float, float]:
    """Loss and ratio of temperatures of an atom on which an empty tweezer lands and goes off.

    Args:
        static: Depth of its static tweezer, in kelvin.
        mobile: Greatest depth of the mobile one.
        speed_m_s: Speed at which this one came.
        ramp_s: Duration of its ramp.
        heat: Temperature of the atom in a static tweezer of the nominal depth.
        constants: The constants.
        tables: The tables.
    """
    if not static > 0.0:
        return 1.0, 1.0
    temperature = heat * math.sqrt(static / constants[STATIC_DEPTH]) * DEPTH_K / static
    faster = quicker(static, constants)
    speed = speed_m_s * WAIST_M / constants[STATIC_WAIST] / faster
    i, part = locate(LANDING_AXIS, speed)
    return respond(
        tables, LANDING_AT, N_LANDING, i + part, ramp_s * faster, RAMP_AXIS,
        mobile / static, temperature, len(LANDING_AXIS),
    )  # fmt: skip


@helper_kernel(f"UniTuple(float64, 2)(float64, float64, float64, float64, float64, {VECTOR}, {VECTOR})")
def pass_by(
    static: float,
    mobile: float,
    speed_m_s: float,
    away_m: float,
    heat: float,
    constants: Floats,
    tables: Floats,
) -> tuple[float, float]:
    """Loss and ratio of temperatures of an atom that a tweezer passes; ``away_m``: its nearest distance.

    The other arguments are those of :func:`land_on`.
    """
    if not static > 0.0:
        return 1.0, 1.0
    temperature = heat * math.sqrt(static / constants[STATIC_DEPTH]) * DEPTH_K / static
    speed = speed_m_s * WAIST_M / constants[STATIC_WAIST] / quicker(static, constants)
    i, part = locate(PASSING_AXIS, speed)
    log_loss, warmer = respond(
        tables, PASSING_AT, N_PASSING, i + part,
        away_m / constants[STATIC_WAIST], BESIDE_AXIS, mobile / static, temperature, len(PASSING_AXIS),
    )  # fmt: skip
    loss = math.exp(log_loss)
    return (loss if loss > 2 * LEAST_LOSS else 0.0), warmer


@helper_kernel(f"UniTuple(float64, 2)(int64, float64, float64, float64, float64, {VECTOR}, {VECTOR})")
def at_once(
    stage: int,
    mobile: float,
    speed_m_s: float,
    ramp_s: float,
    heat: float,
    constants: Floats,
    tables: Floats,
) -> tuple[float, float]:
    """Further loss, and ratio of temperatures, where a start follows a ramp at once, or a ramp a stop.

    Args:
        stage: 0 for a start, 1 for a stop.
        mobile: Greatest depth of the mobile tweezer, in kelvin.
        speed_m_s: Speed of the move, constant.
        ramp_s: Time from the beginning of the ramp to the start, or from the stop to the end of the ramp.
        heat: Temperature of the atom before the move, in a static tweezer of the nominal depth.
        constants: The constants.
        tables: The tables.
    """
    if not ramp_s < START_RAMP_AXIS[-1]:
        return 0.0, 1.0
    static = constants[STATIC_DEPTH]
    speed = speed_m_s * WAIST_M / constants[STATIC_WAIST] / quicker(static, constants)
    i, part = locate(START_RAMP_AXIS, ramp_s)  # compared with the sound, whose transit does not scale
    first = START_AT + 2 * N_START * stage
    return respond(
        tables, first, N_START, i + part, speed, START_SPEED_AXIS, mobile / static, heat * DEPTH_K / static,
        len(START_RAMP_AXIS),
    )  # fmt: skip


@helper_kernel(f"float64(float64, float64, {VECTOR})")
def relaxed(heat: float, elapsed_s: float, constants: Floats) -> float:
    """Temperature after a time in a static tweezer: cooled, or heated by the noise of the intensity."""
    if constants[COOLING_HZ] > 0.0:
        aim = constants[TEMPERATURE]
        return float(aim + (heat - aim) * math.exp(-elapsed_s * constants[COOLING_HZ]))
    return float(heat * math.exp(min(elapsed_s * constants[NOISE_HZ], 20.0)))
