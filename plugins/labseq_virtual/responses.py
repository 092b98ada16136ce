"""How atoms respond to moves and ramps: tables made from the simulation in three dimensions.

Each table gives the loss and the ratio of the temperatures after and before, on a grid of the axes below. It
belongs to a static tweezer of ``DEPTH_K`` and ``WAIST_M``. Other depths and waists follow by the scaling of
Newton's equations: lengths in waists, energies in depths, times in periods of the static tweezer. A
temperature is that which the atom has in the static tweezer, or would have if it were brought back there
adiabatically.

``docs/make_response_tables.py`` makes them.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import MotionSpec, format_quantity
from labseq_virtual.rf_analysis import MAX_SITES, PEAK_SPEED
from labseq_virtual.settings import SimulationSettings

Floats = NDArray[np.float64]

TABLES: Final = Path(__file__).with_name("responses.npz")


DEPTH_K: Final = 300e-6
WAIST_M: Final = 0.98e-6
SITE_M: Final = 4.49e-6
"""Depth and waist of the static tweezers that the tables belong to, and their distance."""
REFERENCE_SPEED_M_S: Final = 0.13
"""The paper's speed."""
TRANSIT_S: Final = 10e-6
"""Transit time of the sound that the tables belong to."""

RAMPS_S: Final = (0.0, 10e-6, 20e-6, 40e-6, 60e-6, 80e-6, 160e-6)
AWAY: Final = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.6, 2.3)
RATIOS: Final = (1.0, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 7.0, 12.0, 25.0)
TEMPERATURES: Final = (5e-6, 10e-6, 15e-6, 20e-6, 27e-6, 36e-6, 50e-6, 75e-6, 120e-6)
SPEEDS: Final = (
    0.02, 0.06, 0.1, 0.115, 0.13, 0.145, 0.16, 0.18, 0.2, 0.22, 0.24, 0.26, 0.28, 0.3, 0.32, 0.34, 0.37, 0.4,
    0.45, 0.5, 0.6, 0.8, 1.1, 3.0,
)  # fmt: skip
START_RAMPS_S: Final = (0.0, 2e-6, 5e-6, 10e-6)
START_SPEEDS: Final = (0.0, 0.13, 0.17, 0.21, 0.25, 0.3, 0.35)
LANDING_SPEEDS: Final = (0.013, 0.13, 0.26)
PASSING_SPEEDS: Final = (0.03, 0.13, 0.4)
BESIDE: Final = (1.2, 1.4, 1.6, 1.8, 2.0, 2.2, 2.4, 2.7, 3.1)
FRACTIONS: Final = (0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.35, 0.6, 1.0)
DURATIONS_S: Final = (10e-6, 100e-6, 300e-6, 1e-3, 3e-3, 10e-3)

AXES: Final[dict[str, tuple[tuple[float, ...], ...]]] = {
    "pick_up": (RAMPS_S, AWAY, RATIOS, TEMPERATURES),
    "drop_off": (RAMPS_S, AWAY, RATIOS, TEMPERATURES),
    "transport": ((0, 1, 2), SPEEDS, RATIOS, TEMPERATURES),
    "landing": (LANDING_SPEEDS, RAMPS_S, RATIOS, TEMPERATURES),
    "passing": (PASSING_SPEEDS, BESIDE, RATIOS, TEMPERATURES),
    "start": (START_RAMPS_S, START_SPEEDS, RATIOS, TEMPERATURES),
    "stop": (START_RAMPS_S, START_SPEEDS, RATIOS, TEMPERATURES),
    "lowering": (FRACTIONS, DURATIONS_S, TEMPERATURES),
}
"""Axes of each table: duration of a ramp (s), distance from the site (waists), mobile over static depth,
temperature (K); course of the motion (:class:`labseq.model.FrequencyCourse`), mean speed (m/s; of a curved
course over four sites); speed of an empty tweezer that lands on an atom, and its ramp; speed of one that
passes an atom, and its nearest distance (waists); duration of a ramp directly before a start or after a stop,
and the speed of that move; depth after the ramp over that before."""


def beyond(motion: MotionSpec, settings: SimulationSettings) -> list[str]:
    """Which settings are beyond the range of the tables, in the words of a warning."""
    static, light = settings.static_depth, settings.mobile_light
    time = math.sqrt(static / DEPTH_K) * WAIST_M / settings.static_waist  # periods of the tables per second
    length = WAIST_M / settings.static_waist
    ranges = [
        ("mobile_tweezers.pick_up", motion.pick_up_s, RAMPS_S, 1 / time, "time"),
        ("mobile_tweezers.drop_off", motion.drop_off_s, RAMPS_S, 1 / time, "time"),
        ("mobile_tweezers.speed", motion.speed_m_s, (0.0, SPEEDS[-1]), time / length, "speed"),
        ("simulation.mobile_light.depth", light.depth, RATIOS, static, "temperature"),
        ("simulation.temperature", settings.temperature, TEMPERATURES, static / DEPTH_K, "temperature"),
        ("simulation.mobile_light.waist", light.waist, (0.97, 1.03), settings.static_waist, "length"),
        ("simulation.mobile_light.transit_time", light.transit_time, (0.8, 1.25), TRANSIT_S, "time"),
    ]
    texts: list[str] = []
    for name, value, axis, unit, dimension in ranges:
        low, high = axis[0] * unit, axis[-1] * unit
        if not low * (1 - 1e-9) <= value <= high * (1 + 1e-9):
            came, first, last = (format_quantity(each, dimension) for each in (value, low, high))
            what = f"profile.{name} is {came}; the virtual lab knows heat and loss from {first} to {last}"
            texts.append(f"{what} only, and takes the nearest end: its losses are not to be trusted")
    clear_m_s = MAX_SITES * SITE_M / TRANSIT_S / PEAK_SPEED[motion.speed_profile] * time / length
    if clear_m_s < motion.speed_m_s <= SPEEDS[-1] * time / length:
        came, last = (format_quantity(each, "speed") for each in (motion.speed_m_s, clear_m_s))
        what = f"profile.mobile_tweezers.speed is {came}; above {last} the sound's chirp blurs the tweezers"
        texts.append(f"{what}: that more atoms are lost is right, how many is not to be trusted")
    return texts


MOVE_TABLES: Final = ("pick_up", "drop_off", "transport", "landing", "passing", "start", "stop")
"""Tables of a move, in the order in which the kernels take them."""
LEAST_LOSS: Final = 1e-6
"""Loss by passing that counts as none."""


@cache
def tables() -> dict[str, Floats]:
    """Name -> float64 (2, ...): loss, and ratio of the temperatures, on its :data:`AXES`."""
    with np.load(TABLES) as file:
        return {name: file[name].astype(np.float64) for name in AXES}


@cache
def move_tables() -> Floats:
    """The tables of a move as the kernels take them, float64 (n,); of passing the logarithm of the loss."""
    moves = {name: tables()[name] for name in MOVE_TABLES}
    passing = moves["passing"].copy()
    passing[0] = np.log(np.maximum(passing[0], LEAST_LOSS))  # falls by decades from distance to distance
    flat = np.concatenate([one.ravel() for one in (moves | {"passing": passing}).values()])
    flat.flags.writeable = False
    return flat


def lowering(
    fraction: float, duration_s: float, depth_k: Floats, temperature_k: Floats
) -> tuple[Floats, Floats]:
    """The effect on atoms of a ramp of the static tweezers to a lower depth.

    Args:
        fraction: Depth after the ramp over that before, up to 1.
        duration_s: Duration of the ramp.
        depth_k: Depths before, in kelvin (n_atoms,).
        temperature_k: Temperatures before (n_atoms,).

    Returns:
        Losses, and temperatures of the atoms that stay relative to an adiabatic change, (n_atoms,).
    """
    if fraction < FRACTIONS[0] / 2:  # off: nothing stays
        return np.ones(len(depth_k)), np.ones(len(depth_k))
    duration = np.log(np.maximum(duration_s * np.sqrt(depth_k / DEPTH_K), DURATIONS_S[0]))
    places = np.full(len(depth_k), fraction), duration, temperature_k * DEPTH_K / depth_k
    axes = np.array(FRACTIONS), np.log(DURATIONS_S), np.array(TEMPERATURES)
    upper, part = list[NDArray[np.intp]](), list[Floats]()
    for axis, place in zip(axes, places, strict=True):
        upper.append(np.clip(np.searchsorted(axis, place), 1, len(axis) - 1))
        below, above = axis[upper[-1] - 1], axis[upper[-1]]
        part.append(np.clip((place - below) / (above - below), 0.0, 1.0))
    table = tables()["lowering"]
    found = np.zeros((2, len(depth_k)))
    for corner in product((0, 1), repeat=3):  # linear between the points
        weight = np.prod([p if up else 1 - p for up, p in zip(corner, part, strict=True)], axis=0)
        i, j, k = (u - 1 + up for up, u in zip(corner, upper, strict=True))
        found += weight * table[:, i, j, k]
    return found[0], found[1]
