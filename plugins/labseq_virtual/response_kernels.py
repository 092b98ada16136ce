"""Kernels that look up how atoms respond to the stages of a move (``responses.py``), and to time.

Arguments that occur in several kernels:

- ``static``, ``mobile``: depth of the static tweezer, and greatest depth of the mobile one, in kelvin.
- ``heat``: temperature of the atom in a static tweezer of the nominal depth.
- ``constants``: the machine and the tables, see :class:`labseq_virtual.tweezer_kernels.Constants`.

All return the loss, and the ratio of the temperatures after and before.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import helper_kernel
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

if TYPE_CHECKING:
    from labseq_virtual.tweezer_kernels import Constants

Floats = NDArray[np.float64]

PICK_UP, DROP_OFF, TRANSPORT, LANDING, PASSING, STARTING, STOPPING = range(7)
"""Places in ``MOVE_TABLES``."""
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


@helper_kernel()
def locate(axis: Floats, x: float) -> tuple[int, float]:
    """The interval of an axis that a value is in, and where in it; the nearest end if it is beyond."""
    if not x > axis[0]:
        return 0, 0.0
    for k in range(1, len(axis)):
        if x <= axis[k]:
            return k - 1, (x - axis[k - 1]) / (axis[k] - axis[k - 1])
    return len(axis) - 2, 1.0


@helper_kernel()
def respond(
    table: int, first: float, second: float, ratio: float, temperature: float, constants: Constants
) -> tuple[float, float]:
    """Interpolate a table linearly.

    Args:
        table: Which.
        first: Value on its first axis.
        second: Value on its second one.
        ratio: Mobile over static depth.
        temperature: In the static tweezer of the tables.
        constants: The constants.
    """
    n_first, n_second, tables = AXIS_LENGTH[table, 0], AXIS_LENGTH[table, 1], constants.tables
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


@helper_kernel()
def quicker(static: float, constants: Constants) -> float:
    """Trap frequency of a static tweezer relative to that of the tables."""
    return math.sqrt(static / DEPTH_K) * WAIST_M / constants.static_waist


@helper_kernel()
def speed_in_table(speed_m_s: float, static: float, constants: Constants) -> float:
    """The speed that does in the tables' tweezer what this one does in a static tweezer."""
    return speed_m_s * WAIST_M / constants.static_waist / quicker(static, constants)


@helper_kernel()
def temperature_in_table(heat: float, static: float, constants: Constants) -> float:
    """The temperature that an atom has in the tables' tweezer."""
    return heat * math.sqrt(static / constants.static_depth) * DEPTH_K / static


@helper_kernel()
def hand_over(
    table: int, static: float, mobile: float, away_m: float, ramp_s: float, heat: float, constants: Constants
) -> tuple[float, float]:
    """Response to pick-up or drop-off.

    Args:
        table: ``PICK_UP`` or ``DROP_OFF``.
        static: Depth of the static tweezer.
        mobile: Greatest depth of the mobile one.
        away_m: Distance between both, in metres.
        ramp_s: Duration of the ramp.
        heat: Temperature of the atom.
        constants: The constants.
    """
    if not static > 0.0:
        return 1.0, 1.0
    temperature = temperature_in_table(heat, static, constants)
    ramp, away = ramp_s * quicker(static, constants), away_m / constants.static_waist
    return respond(table, ramp, away, mobile / static, temperature, constants)


@helper_kernel()
def carry(
    course: int, speed_m_s: float, length_m: float, mobile: float, heat: float, constants: Constants,
) -> tuple[float, float]:  # fmt: skip
    """Response to a move over empty sites; ``speed_m_s``: the mean one over ``length_m``."""
    static = constants.static_depth
    speed = speed_in_table(speed_m_s, static, constants)
    if course > 0:  # what counts is the acceleration
        speed *= math.sqrt(CURVED_SITES * SITE_M / max(length_m, 0.1 * SITE_M))
    return respond(TRANSPORT, float(course), speed, mobile / static, heat * DEPTH_K / static, constants)


@helper_kernel()
def land_on(
    static: float, mobile: float, speed_m_s: float, ramp_s: float, heat: float, constants: Constants,
) -> tuple[float, float]:  # fmt: skip
    """Response of an atom on which an empty tweezer lands at a speed, and goes off in a ramp."""
    if not static > 0.0:
        return 1.0, 1.0
    temperature = temperature_in_table(heat, static, constants)
    speed, ramp = speed_in_table(speed_m_s, static, constants), ramp_s * quicker(static, constants)
    return respond(LANDING, speed, ramp, mobile / static, temperature, constants)


@helper_kernel()
def pass_by(
    static: float, mobile: float, speed_m_s: float, away_m: float, heat: float, constants: Constants,
) -> tuple[float, float]:  # fmt: skip
    """Response of an atom that a tweezer passes; ``away_m``: its nearest distance."""
    if not static > 0.0:
        return 1.0, 1.0
    temperature = temperature_in_table(heat, static, constants)
    speed, away = speed_in_table(speed_m_s, static, constants), away_m / constants.static_waist
    log_loss, warmer = respond(PASSING, speed, away, mobile / static, temperature, constants)
    loss = math.exp(log_loss)
    return (loss if loss > 2 * LEAST_LOSS else 0.0), warmer


@helper_kernel()
def at_once(
    table: int, mobile: float, speed_m_s: float, ramp_s: float, heat: float, constants: Constants
) -> tuple[float, float]:
    """Further response where a start follows a ramp at once, or a ramp a stop.

    Args:
        table: ``STARTING`` or ``STOPPING``.
        mobile: Greatest depth of the mobile tweezer.
        speed_m_s: Speed of the move, constant.
        ramp_s: Time from the beginning of the ramp to the start, or from the stop to the end of the ramp:
            compared with the transit time of the sound, which does not scale.
        heat: Temperature of the atom before the move.
        constants: The constants.
    """
    if not ramp_s < LONGEST_START_S:
        return 0.0, 1.0
    static = constants.static_depth
    speed = speed_in_table(speed_m_s, static, constants)
    temperature = heat * DEPTH_K / static
    return respond(table, ramp_s, speed, mobile / static, temperature, constants)


@helper_kernel()
def relaxed(heat: float, elapsed_s: float, constants: Constants) -> float:
    """Temperature after a time in a static tweezer: cooled, or heated by the noise of the intensity."""
    if constants.cooling_hz > 0.0:
        aim = constants.temperature
        return float(aim + (heat - aim) * math.exp(-elapsed_s * constants.cooling_hz))
    return float(heat * math.exp(min(elapsed_s * constants.noise_hz, 20.0)))
