"""Kernels for one mobile tweezer and its atom: its depth, what it takes, and what a move does to the atom.

Arguments that occur in several kernels:

- ``constants``: the machine, and the tables of moves.
- ``tweezer``: the crossing of a row tone and a column tone, and its course since it switched on.

Another loss of moved atoms is a setting in ``settings.py``; here what it depends on (a column of ``Tweezer``
that ``advance`` fills), its probability (``Risks``, ``risks``), its cause (``Losses``), and the draw that
decides (``survives``).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import SiteGrid, helper_kernel
from labseq.plugin.motion import FrequencyCourse
from labseq_virtual.handover import noise_hz, pair_survival
from labseq_virtual.records import record
from labseq_virtual.response_kernels import (
    DROP_OFF,
    PICK_UP,
    STARTING,
    STOPPING,
    at_once,
    carry,
    hand_over,
)
from labseq_virtual.responses import REFERENCE_SPEED_M_S, move_tables
from labseq_virtual.settings import SimulationSettings

Floats = NDArray[np.float64]


class Constants(NamedTuple):
    """The machine, in SI; numbers that are not explained here are settings of the same name.

    Attributes:
        tables: The tables of a move, one after the other.
        spacing: Distance of neighbouring sites.
        skew: Twice the scalar product of the steps from site to site along a row and along a column.
        mobile_depth: Depth of a mobile tweezer whose tones have their intended powers.
        cooling_hz: Rate at which the cooling light brings atoms back to their temperature; 0 without light.
        noise_hz: Rate at which noise of the intensity heats an atom in a static tweezer of nominal depth.
    """

    tables: NDArray[np.float64]
    spacing: float
    skew: float
    static_depth: float
    static_waist: float
    temperature: float
    transport_loss: float
    transport_loss_per_tone: float
    mobile_depth: float
    depth_drop_per_tone: float
    intermodulation: float
    adiabatic_depth: float
    shallow_loss: float
    cooling_hz: float
    noise_hz: float
    pair_survival: float


def constants(grid: SiteGrid, settings: SimulationSettings) -> Constants:
    """The constants of a machine."""
    a1, a2 = grid.axes
    light = settings.mobile_light
    return Constants(
        tables=move_tables(),
        spacing=grid.spacing_m,
        skew=2 * float(a1 @ a2),
        static_depth=settings.static_depth,
        static_waist=settings.static_waist,
        temperature=settings.temperature,
        transport_loss=settings.transport_loss,
        transport_loss_per_tone=settings.transport_loss_per_tone,
        mobile_depth=light.depth,
        depth_drop_per_tone=light.depth_drop_per_tone,
        intermodulation=light.intermodulation,
        adiabatic_depth=light.adiabatic_depth,
        shallow_loss=light.shallow_loss,
        cooling_hz=1 / settings.cooling_time,
        noise_hz=noise_hz(settings),
        pair_survival=pair_survival(settings),
    )


DARK, NEW, EMPTY, HELD = range(4)
"""States of a tweezer: off, just switched on, on without an atom, on with an atom."""


class Tweezer:
    """A mobile tweezer and its course.

    Attributes:
        state: Whether it is on, and holds an atom.
        row: Its place at the start of the segment, in sites.
        col: Likewise.
        to_row: Its place at the end.
        to_col: Likewise.
        power_start: Power of its tones at the start, relative to the intended one.
        power_end: At the end.
        stays_on: Whether both are on at the end.
        depth: Its greatest depth in the segment, in kelvin.
        peak: Its greatest depth so far.
        risk: Probability that the atom fell out because the tweezer was too shallow.
        rise_s: Duration of the ramps at the start.
        fall_s: Duration of the ramps at the end.
        site_depth: Depth of the site that the atom came from, in kelvin.
        away: Distance of that site, in metres.
        is_picked: Whether the pick-up is contained in the next two.
        heat: Temperature of the atom, as it would be in a static tweezer of nominal depth.
        lost: Probability that the atom was lost so far.
        down_hz: Velocity along the columns, in sites per second.
        right_hz: Velocity along a row.
        speed: Speed of the last motion, in m/s.
        stop_speed: The same if it stopped at once, else 0.
        leg_heat: Temperature of the atom at the start of the last motion.
        rest_s: Time at rest since the last ramp up or motion.
    """

    state: int
    row: float
    col: float
    to_row: float
    to_col: float
    power_start: float
    power_end: float
    stays_on: bool
    depth: float
    peak: float
    risk: float
    rise_s: float
    fall_s: float
    site_depth: float
    away: float
    is_picked: bool
    heat: float
    lost: float
    down_hz: float
    right_hz: float
    speed: float
    stop_speed: float
    leg_heat: float
    rest_s: float


class Losses:
    """Number of atoms that each cause has cost.

    Attributes:
        hand_over: Pick-up and drop-off, and heat.
        transport: On the way.
        collision: With another atom, or with a tweezer that passed or landed.
        ejected: Dropped outside of the grid.
        program: The atom's tweezer switched off or jumped.
    """

    hand_over: int
    transport: int
    collision: int
    ejected: int
    program: int


TWEEZER: Final = record(Tweezer)
LOSSES: Final = record(Losses)
N_NUMBERS: Final = len(Constants._fields) - 1
CAUSES: Final[tuple[str, ...]] = LOSSES.names or ()

REFERENCE_TONES = 19
"""Further tones that the setting ``intermodulation`` belongs to: the paper measured it on 20 tweezers."""
LINEAR = int(FrequencyCourse.LINEAR)
FASTEST: Final = np.array([course.fastest for course in FrequencyCourse])
"""Greatest speed relative to the mean speed, for each course."""
NEW_LEG = 0.8
"""Change of the velocity, relative to the greater one, from which on a tweezer has started again; smaller
ones are the bends of a curve, each with less than a third of the energy of a start and a stop."""
RAMP = 0.7
"""Ratio of the powers at the two ends of a segment below which it is part of a ramp: tones that give depths
that differ from site to site change less."""
INSTANT_S = 1e-12
"""Duration assumed for a segment of duration 0, in seconds."""


@helper_kernel()
def interpolate(x: float, table: Floats) -> float:
    """Linear interpolation in a table (2, n) of x, rising, and y; constant beyond its ends."""
    if x <= table[0, 0]:
        return float(table[1, 0])
    for k in range(1, table.shape[1]):
        if x < table[0, k]:
            slope = (table[1, k] - table[1, k - 1]) / (table[0, k] - table[0, k - 1])
            return float(table[1, k - 1] + slope * (x - table[0, k - 1]))
    return float(table[1, -1])


@helper_kernel()
def mobile_depth(power: float, n_further: int, constants: Constants) -> float:
    """Depth of a mobile tweezer in kelvin; ``power``: power of its tones relative to the intended one."""
    return float(constants.mobile_depth * power / (1.0 + constants.depth_drop_per_tone * n_further))


@helper_kernel()
def takes(mobile: float, static: float, distance_m: float, merging: Floats) -> bool:
    """Whether a mobile tweezer that switches on takes the atom of a static one; depths in kelvin.

    ``merging`` has the logarithm of the ratio of mobile to static depth, and the distance in metres below
    which the two wells are one (2, n).
    """
    if mobile <= static:
        return False
    log_ratio = math.log(mobile / static) if static > 0.0 else math.inf
    return distance_m < interpolate(log_ratio, merging)


@helper_kernel()
def shallow(mobile: float, speed_m_s: float, n_further: int, constants: Constants) -> float:
    """Probability that an atom falls out of a mobile tweezer that is too shallow for its speed."""
    if constants.adiabatic_depth == 0.0:
        return 0.0
    missing = constants.adiabatic_depth * (speed_m_s / REFERENCE_SPEED_M_S) ** 2 - mobile
    scatter = constants.intermodulation * math.sqrt(n_further / REFERENCE_TONES) * mobile
    if scatter > 0.0:
        part = 0.5 * math.erfc(-missing / scatter / math.sqrt(2.0))
    elif missing == 0.0:
        part = 0.5
    else:
        part = 1.0 if missing > 0.0 else 0.0
    return float(constants.shallow_loss * part)


@helper_kernel()
def affect(tweezer: Tweezer, response: tuple[float, float]) -> None:
    """Add a loss, and a ratio of temperatures, to the course of a tweezer."""
    loss, warmer = response
    tweezer.lost = 1.0 - (1.0 - tweezer.lost) * (1.0 - loss)
    tweezer.heat *= warmer


@helper_kernel()
def settle(tweezer: Tweezer, constants: Constants) -> None:
    """Add the pick-up to the course of a tweezer that holds an atom, unless it is contained."""
    if tweezer.is_picked:
        return
    tweezer.is_picked = True
    depth, peak, away, rise_s = tweezer.site_depth, tweezer.peak, tweezer.away, tweezer.rise_s
    affect(tweezer, hand_over(PICK_UP, depth, peak, away, rise_s, tweezer.heat, constants))


@helper_kernel()
def way_of(tweezer: Tweezer) -> tuple[float, float]:
    """Its displacement in the segment, along the columns and along a row, in sites."""
    return tweezer.to_row - tweezer.row, tweezer.to_col - tweezer.col


@helper_kernel()
def advance(tweezer: Tweezer, duration_s: float, course: int, n_further: int, constants: Constants) -> None:
    """Continue the course of a tweezer over a segment.

    Args:
        tweezer: The tweezer; changed in place.
        duration_s: Duration of the segment.
        course: Course of the frequencies.
        n_further: Tones that are on beyond one per axis.
        constants: The constants.
    """
    duration_s, depth = max(duration_s, INSTANT_S), tweezer.depth
    tweezer.peak = max(tweezer.peak, depth)
    start, end = tweezer.power_start, tweezer.power_end
    rises, falls = start < RAMP * end, end < RAMP * start
    if rises:
        tweezer.rise_s += duration_s
    tweezer.fall_s = tweezer.fall_s + duration_s if falls else 0.0
    ratio = depth / constants.static_depth
    tweezer.heat *= math.exp(min(duration_s * constants.noise_hz * ratio, 20.0))
    down, right = way_of(tweezer)
    down_hz, right_hz = down / duration_s, right / duration_s
    change = math.hypot(down_hz - tweezer.down_hz, right_hz - tweezer.right_hz)
    starts = change > NEW_LEG * max(
        math.hypot(down_hz, right_hz), math.hypot(tweezer.down_hz, tweezer.right_hz)
    )
    tweezer.down_hz, tweezer.right_hz = down_hz, right_hz
    length_m = math.hypot(down, right) * constants.spacing
    if length_m == 0.0:
        if not falls:
            tweezer.rest_s = 0.0 if rises else tweezer.rest_s + duration_s
        return
    tweezer.speed = length_m / duration_s
    tweezer.stop_speed = tweezer.speed if course == LINEAR else 0.0
    risk = shallow(depth, length_m / duration_s * FASTEST[course], n_further, constants)
    tweezer.risk = max(tweezer.risk, risk)
    if tweezer.state == HELD and starts:
        begin_leg(tweezer, course, length_m, constants)
    tweezer.rest_s = 0.0


@helper_kernel()
def begin_leg(tweezer: Tweezer, course: int, length_m: float, constants: Constants) -> None:
    """Add a motion to the course of a tweezer that holds an atom."""
    is_first = not tweezer.is_picked
    settle(tweezer, constants)
    heat = tweezer.leg_heat = tweezer.heat
    affect(tweezer, carry(course, tweezer.speed, length_m, tweezer.depth, heat, constants))
    if is_first and tweezer.stop_speed > 0.0:
        ramp_s = tweezer.rise_s + tweezer.rest_s
        affect(tweezer, at_once(STARTING, tweezer.depth, tweezer.speed, ramp_s, heat, constants))


class Risks(NamedTuple):
    """Probabilities that an atom which is dropped off is lost.

    Attributes:
        heat: To the heat of pick-up, transport and drop-off.
        hand_over: To pick-up and drop-off otherwise.
        motion: On the way.
        temperature: Not a risk: the temperature of the atom that stays.
    """

    heat: float
    hand_over: float
    motion: float
    temperature: float


N_DRAWS = 3
"""Random numbers of an atom that is dropped off: one for each risk."""


@helper_kernel()
def risks(
    static: float, tweezer: Tweezer, distance_m: float, n_further: int, factor: float, constants: Constants
) -> Risks:
    """What may happen to an atom that is dropped off near a site.

    Args:
        static: Depth of the site, in kelvin.
        tweezer: The tweezer that holds it.
        distance_m: Distance of the atom from the site.
        n_further: Tones that were on beyond one per axis.
        factor: The shot's factor on the losses.
        constants: The constants.
    """
    settle(tweezer, constants)
    peak, fall_s = tweezer.peak, tweezer.fall_s
    if tweezer.stop_speed > 0.0:
        ramp_s = tweezer.rest_s + fall_s
        affect(tweezer, at_once(STOPPING, peak, tweezer.stop_speed, ramp_s, tweezer.leg_heat, constants))
    ratio = math.inf if peak > 0.0 else 0.0
    if static > 0.0:
        ratio = peak / static
    by_hand_over = 0.0
    if constants.transport_loss * factor > 0.0:
        nominal = constants.mobile_depth / constants.static_depth
        by_hand_over = min(1.0, factor * constants.transport_loss * ratio / nominal)
    per_tone = min(1.0, factor * constants.transport_loss_per_tone * n_further)
    loss, warmer = hand_over(DROP_OFF, static, peak, distance_m, fall_s, tweezer.heat, constants)
    by_heat = 1.0 - (1.0 - tweezer.lost) * (1.0 - loss)
    in_motion = 1.0 - (1.0 - per_tone) * (1.0 - tweezer.risk)
    return Risks(by_heat, by_hand_over, in_motion, tweezer.heat * warmer)


@helper_kernel()
def survives(risk: Risks, draw: Floats, lost: Losses) -> bool:
    """Whether an atom that is dropped off stays; if not, the loss is counted.

    Args:
        risk: Its risks.
        draw: Uniform random numbers (N_DRAWS,).
        lost: The losses; changed in place.
    """
    if draw[0] < risk.heat or draw[1] < risk.hand_over:
        lost.hand_over += 1
    elif draw[2] < risk.motion:
        lost.transport += 1
    else:
        return True
    return False
