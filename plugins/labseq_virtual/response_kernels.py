"""Kernels that look up how atoms respond to the stages of a move (``responses.py``), and to time.

Arguments that occur in several kernels:

- ``tables``: the tables of a move, one after the other, see :func:`labseq_virtual.responses.move_tables`.
- ``static``, ``mobile``: depth of the static tweezer, and greatest depth of the mobile one, in kelvin.
- ``heat``: temperature of the atom in a static tweezer of the nominal depth.
- ``constants``: see :func:`labseq_virtual.handover.constants`.

All return the loss, and the ratio of the temperatures after and before.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel
from labseq_virtual.handover import COOLING_HZ, NOISE_HZ, STATIC_DEPTH, STATIC_WAIST, TEMPERATURE
from labseq_virtual.responses import (
    AXES,
    DEPTH_K,
    LEAST_LOSS,
    MOVE_TABLES,
    RATIOS,
    SITE_M,
    START_RAMPS_S,
    TEMPERATURES,
    WAIST_M,
)

Floats = NDArray[np.float64]

VECTOR = const("float64", 1)
RESPONSE = "UniTuple(float64, 2)"

TRANSPORT, LANDING, PASSING, STARTING = range(2, 6)
"""Places in ``MOVE_TABLES``; those of pick-up and drop-off are 0 and 1, that of stopping follows STARTING."""
RATIO_AXIS, TEMPERATURE_AXIS = np.array(RATIOS), np.array(TEMPERATURES)
AXIS_LENGTH = np.array([[len(axis) for axis in AXES[name][:2]] for name in MOVE_TABLES])
AXIS_VALUES = np.concatenate([np.array(axis, np.float64) for name in MOVE_TABLES for axis in AXES[name][:2]])
"""The first and the second axis of each table, one after the other."""
AXIS_AT = np.concatenate([[0], np.cumsum(AXIS_LENGTH.ravel())])[:-1].reshape(-1, 2)
N_POINTS = AXIS_LENGTH.prod(axis=1) * len(RATIOS) * len(TEMPERATURES)
TABLE_AT = 2 * np.concatenate([[0], np.cumsum(N_POINTS)])[:-1]
"""Where each table begins: first its losses, then its ratios of temperatures."""
LONGEST_START_S = START_RAMPS_S[-1]
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


@helper_kernel(f"{RESPONSE}(int64, float64, float64, float64, float64, {VECTOR})")
def respond(
    table: int, first: float, second: float, ratio: float, temperature: float, tables: Floats
) -> tuple[float, float]:
    """Interpolate a table linearly.

    Args:
        table: Which.
        first: Value on its first axis.
        second: Value on its second one.
        ratio: Mobile over static depth.
        temperature: In the static tweezer of the tables.
        tables: The tables.
    """
    n_first, n_second = AXIS_LENGTH[table, 0], AXIS_LENGTH[table, 1]
    firsts = AXIS_VALUES[AXIS_AT[table, 0] : AXIS_AT[table, 0] + n_first]
    seconds = AXIS_VALUES[AXIS_AT[table, 1] : AXIS_AT[table, 1] + n_second]
    i, part = locate(firsts, first)
    one = i + part
    i, a = int(min(one, n_first - 2.0)), one - int(min(one, n_first - 2.0))
    j, b = locate(seconds, second)
    k, c = locate(RATIO_AXIS, ratio)
    m, d = locate(TEMPERATURE_AXIS, temperature)
    loss = warmer = 0.0
    for corner in range(16):
        p, q, r, s = corner & 1, (corner >> 1) & 1, (corner >> 2) & 1, corner >> 3
        weight = (a if p else 1 - a) * (b if q else 1 - b) * (c if r else 1 - c) * (d if s else 1 - d)
        if weight > 0.0:
            at = (((i + p) * n_second + j + q) * len(RATIO_AXIS) + k + r) * len(TEMPERATURE_AXIS) + m + s
            loss += weight * tables[TABLE_AT[table] + at]
            warmer += weight * tables[TABLE_AT[table] + N_POINTS[table] + at]
    return float(loss), float(warmer)


@helper_kernel(f"float64(float64, {VECTOR})")
def quicker(static: float, constants: Floats) -> float:
    """Trap frequency of a static tweezer relative to that of the tables."""
    return math.sqrt(static / DEPTH_K) * WAIST_M / constants[STATIC_WAIST]


@helper_kernel(f"float64(float64, float64, {VECTOR})")
def speed_in_table(speed_m_s: float, static: float, constants: Floats) -> float:
    """The speed that does in the tables' tweezer what this one does in a static tweezer."""
    return speed_m_s * WAIST_M / constants[STATIC_WAIST] / quicker(static, constants)


@helper_kernel(f"float64(float64, float64, {VECTOR})")
def temperature_in_table(heat: float, static: float, constants: Floats) -> float:
    """The temperature that an atom has in the tables' tweezer."""
    return heat * math.sqrt(static / constants[STATIC_DEPTH]) * DEPTH_K / static


@helper_kernel(f"{RESPONSE}(int64, float64, float64, float64, float64, float64, {VECTOR}, {VECTOR})")
def hand_over(
    stage: int, static: float, mobile: float, away_m: float, ramp_s: float, heat: float,
    constants: Floats, tables: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Response to pick-up (stage 0) or drop-off (stage 1).

    Args:
        stage: Which.
        static: Depth of the static tweezer.
        mobile: Greatest depth of the mobile one.
        away_m: Distance between both, in metres.
        ramp_s: Duration of the ramp.
        heat: Temperature of the atom.
        constants: The constants.
        tables: The tables.
    """
    if not static > 0.0:
        return 1.0, 1.0
    temperature = temperature_in_table(heat, static, constants)
    ramp, away = ramp_s * quicker(static, constants), away_m / constants[STATIC_WAIST]
    return respond(stage, ramp, away, mobile / static, temperature, tables)


@helper_kernel(f"{RESPONSE}(int64, float64, float64, float64, float64, {VECTOR}, {VECTOR})")
def carry(
    course: int, speed_m_s: float, length_m: float, mobile: float, heat: float, constants: Floats,
    tables: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Response to a move over empty sites; ``speed_m_s``: the mean one over ``length_m``."""
    static = constants[STATIC_DEPTH]
    speed = speed_in_table(speed_m_s, static, constants)
    if course > 0:  # what counts is the acceleration
        speed *= math.sqrt(CURVED_SITES * SITE_M / max(length_m, 0.1 * SITE_M))
    return respond(TRANSPORT, float(course), speed, mobile / static, heat * DEPTH_K / static, tables)


@helper_kernel(f"{RESPONSE}(float64, float64, float64, float64, float64, {VECTOR}, {VECTOR})")
def land_on(
    static: float, mobile: float, speed_m_s: float, ramp_s: float, heat: float, constants: Floats,
    tables: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Response of an atom on which an empty tweezer lands at a speed, and goes off in a ramp."""
    if not static > 0.0:
        return 1.0, 1.0
    temperature = temperature_in_table(heat, static, constants)
    speed, ramp = speed_in_table(speed_m_s, static, constants), ramp_s * quicker(static, constants)
    return respond(LANDING, speed, ramp, mobile / static, temperature, tables)


@helper_kernel(f"{RESPONSE}(float64, float64, float64, float64, float64, {VECTOR}, {VECTOR})")
def pass_by(
    static: float, mobile: float, speed_m_s: float, away_m: float, heat: float, constants: Floats,
    tables: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Response of an atom that a tweezer passes; ``away_m``: its nearest distance."""
    if not static > 0.0:
        return 1.0, 1.0
    temperature = temperature_in_table(heat, static, constants)
    speed, away = speed_in_table(speed_m_s, static, constants), away_m / constants[STATIC_WAIST]
    log_loss, warmer = respond(PASSING, speed, away, mobile / static, temperature, tables)
    loss = math.exp(log_loss)
    return (loss if loss > 2 * LEAST_LOSS else 0.0), warmer


@helper_kernel(f"{RESPONSE}(int64, float64, float64, float64, float64, {VECTOR}, {VECTOR})")
def at_once(
    stage: int, mobile: float, speed_m_s: float, ramp_s: float, heat: float, constants: Floats, tables: Floats
) -> tuple[float, float]:
    """Further response where a start follows a ramp at once (stage 0), or a ramp a stop (stage 1).

    Args:
        stage: Which.
        mobile: Greatest depth of the mobile tweezer.
        speed_m_s: Speed of the move, constant.
        ramp_s: Time from the beginning of the ramp to the start, or from the stop to the end of the ramp:
            compared with the transit time of the sound, which does not scale.
        heat: Temperature of the atom before the move.
        constants: The constants.
        tables: The tables.
    """
    if not ramp_s < LONGEST_START_S:
        return 0.0, 1.0
    static = constants[STATIC_DEPTH]
    speed = speed_in_table(speed_m_s, static, constants)
    temperature = heat * DEPTH_K / static
    return respond(STARTING + stage, ramp_s, speed, mobile / static, temperature, tables)


@helper_kernel(f"float64(float64, float64, {VECTOR})")
def relaxed(heat: float, elapsed_s: float, constants: Floats) -> float:
    """Temperature after a time in a static tweezer: cooled, or heated by the noise of the intensity."""
    if constants[COOLING_HZ] > 0.0:
        aim = constants[TEMPERATURE]
        return float(aim + (heat - aim) * math.exp(-elapsed_s * constants[COOLING_HZ]))
    return float(heat * math.exp(min(elapsed_s * constants[NOISE_HZ], 20.0)))
