"""What moves do to an atom, as plainly as it can be written: formulas, and tables looked up by scipy.

Nothing here calls a kernel; a tweezer is a record of ``labseq_virtual.tweezer_kernels.TWEEZER``.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from labseq_virtual.handover import merging_distance, noise_hz
from labseq_virtual.responses import AXES, tables
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.tweezer_kernels import HELD
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.special import ndtr

Floats = NDArray[np.float64]
Response = tuple[float, float]
"""Loss, and ratio of the temperatures after and before."""

DEPTH_K, WAIST_M, SITE_M, PAPER_M_S = 300e-6, 0.98e-6, 4.49e-6, 0.13
"""Of the static tweezers and the moves that the tables belong to."""


@cache
def table(name: str) -> RegularGridInterpolator:
    values = tables()[name].copy()
    if name == "passing":
        values[0] = np.log(np.maximum(values[0], 1e-6))  # falls by decades from distance to distance
    return RegularGridInterpolator(AXES[name], np.moveaxis(values, 0, -1))


def look_up(name: str, *place: float) -> Response:
    """Between the points of a table, and at its nearest end beyond them."""
    ends = [(axis[0], axis[-1]) for axis in AXES[name]]
    inside = [min(max(x, low), high) for x, (low, high) in zip(place, ends, strict=True)]
    loss, warmer = table(name)(inside)[0].tolist()
    if name == "passing":
        loss = math.exp(loss) if math.exp(loss) > 2e-6 else 0.0
    return loss, warmer


class NaiveMoves:
    """Moves with the settings of a simulation, cooled all the time, on a grid of ``spacing_m``."""

    def __init__(self, settings: SimulationSettings, spacing_m: float) -> None:
        self.settings, self.light, self.spacing_m = settings, settings.mobile_light, spacing_m
        self.smaller = WAIST_M / settings.static_waist

    def quicker(self, static: float) -> float:
        """Trap frequency of a static tweezer relative to that of the tables."""
        return math.sqrt(static / DEPTH_K) * self.smaller

    def speed(self, speed_m_s: float, static: float) -> float:
        return speed_m_s * self.smaller / self.quicker(static)

    def temperature(self, heat: float, static: float) -> float:
        """In the static tweezer of the tables, of an atom with this one in a tweezer of nominal depth."""
        return heat * math.sqrt(static / self.settings.static_depth) * DEPTH_K / static

    def relaxed(self, heat: float, waited_s: float) -> float:
        aim = self.settings.temperature
        return aim + (heat - aim) * math.exp(-waited_s / self.settings.cooling_time)

    def mobile_depth(self, power: Any, n_further: int) -> Any:
        return self.light.depth * power / (1 + self.light.depth_drop_per_tone * n_further)

    def takes(self, mobile: float, static: float, away_m: float) -> bool:
        log_ratio, reach_m = merging_distance(self.settings.static_waist, self.light.waist)
        return mobile > static and away_m < np.interp(math.log(mobile / static), log_ratio, reach_m)

    def pass_by(self, static: float, mobile: float, speed_m_s: float, away_m: float, heat: float) -> Response:
        away, temperature = away_m / self.settings.static_waist, self.temperature(heat, static)
        return look_up("passing", self.speed(speed_m_s, static), away, mobile / static, temperature)

    def land_on(self, static: float, mobile: float, speed_m_s: float, ramp_s: float, heat: float) -> Response:
        place = self.speed(speed_m_s, static), ramp_s * self.quicker(static), mobile / static
        return look_up("landing", *place, self.temperature(heat, static))

    def hand_over(
        self, name: str, static: float, mobile: float, away_m: float, ramp_s: float, heat: float
    ) -> Response:
        place = ramp_s * self.quicker(static), away_m / self.settings.static_waist, mobile / static
        return look_up(name, *place, self.temperature(heat, static))

    def at_once(self, name: str, tweezer: Any, speed_m_s: float, ramp_s: float, heat: float) -> None:
        """A start directly after a ramp, or a stop directly before one."""
        static = self.settings.static_depth
        if ramp_s < 10e-6:
            depth = tweezer.peak if name == "stop" else tweezer.depth
            place = ramp_s, self.speed(speed_m_s, static), depth / static, heat * DEPTH_K / static
            affect(tweezer, look_up(name, *place))

    def fall(self, mobile: float, fastest_m_s: float, n_further: int) -> float:
        """Probability that an atom falls out of a tweezer too shallow for its speed."""
        needed = self.light.adiabatic_depth * (fastest_m_s / PAPER_M_S) ** 2
        if self.light.adiabatic_depth == 0.0:
            return 0.0
        scatter = self.light.intermodulation * math.sqrt(n_further / 19) * mobile
        part = ndtr((needed - mobile) / scatter) if scatter else np.heaviside(needed - mobile, 0.5)
        return float(self.light.shallow_loss * part)

    def settle(self, tweezer: Any) -> None:
        """The pick-up, once."""
        if not tweezer.is_picked:
            tweezer.is_picked = True
            place = tweezer.site_depth, tweezer.peak, tweezer.away, tweezer.rise_s, tweezer.heat
            affect(tweezer, self.hand_over("pick_up", *place))

    def advance(
        self, tweezer: Any, power: Response, way: Response, duration_s: float, kind: int, n_further: int
    ) -> None:
        """A segment: ``power`` of the tones at its ends, ``way`` along columns and rows in sites."""
        (start, end), depth = power, tweezer.depth
        tweezer.peak = max(tweezer.peak, depth)
        rises, falls = start < 0.7 * end, end < 0.7 * start
        tweezer.rise_s += duration_s if rises else 0.0
        tweezer.fall_s = tweezer.fall_s + duration_s if falls else 0.0
        warming_hz = noise_hz(self.settings) * depth / self.settings.static_depth
        tweezer.heat *= math.exp(duration_s * warming_hz)
        before, now = np.array([tweezer.down_hz, tweezer.right_hz]), np.array(way) / duration_s
        turned = np.linalg.norm(now - before) > 0.8 * max(np.linalg.norm(now), np.linalg.norm(before))
        tweezer.down_hz, tweezer.right_hz = now
        length_m = math.hypot(*way) * self.spacing_m
        if length_m == 0.0:
            if not falls:
                tweezer.rest_s = 0.0 if rises else tweezer.rest_s + duration_s
            return
        speed_m_s = tweezer.speed = length_m / duration_s
        tweezer.stop_speed = speed_m_s if kind == 0 else 0.0
        fastest = speed_m_s * (1.0, 1.875, 1.5)[kind]
        tweezer.risk = max(tweezer.risk, self.fall(depth, fastest, n_further))
        if tweezer.state == HELD and turned:
            self.start(tweezer, speed_m_s, length_m, kind)
        tweezer.rest_s = 0.0

    def start(self, tweezer: Any, speed_m_s: float, length_m: float, kind: int) -> None:
        """A new leg of the way of an atom."""
        is_first, static = not tweezer.is_picked, self.settings.static_depth
        self.settle(tweezer)
        heat = tweezer.leg_heat = tweezer.heat
        speed = self.speed(speed_m_s, static)
        if kind > 0:  # the acceleration counts; the table's moves are over four sites
            speed *= math.sqrt(4 * SITE_M / max(length_m, 0.1 * SITE_M))
        place = kind, speed, tweezer.depth / static, heat * DEPTH_K / static
        affect(tweezer, look_up("transport", *place))
        if is_first and kind == 0:
            ramp_s = tweezer.rise_s + tweezer.rest_s
            self.at_once("start", tweezer, speed_m_s, ramp_s, heat)

    def risks(
        self, static: float, tweezer: Any, away_m: float, n_further: int, factor: float
    ) -> tuple[float, float, float, float]:
        """Of a drop-off: loss by heat, by the hand-over, and in motion; and the temperature afterwards."""
        self.settle(tweezer)
        peak, fall_s = tweezer.peak, tweezer.fall_s
        if tweezer.stop_speed > 0.0:
            ramp_s = tweezer.rest_s + fall_s
            self.at_once("stop", tweezer, tweezer.stop_speed, ramp_s, tweezer.leg_heat)
        deeper = peak / static / (self.light.depth / self.settings.static_depth)
        by_hand_over = min(1.0, factor * self.settings.transport_loss * deeper)
        per_tone = min(1.0, factor * self.settings.transport_loss_per_tone * n_further)
        place = static, peak, away_m, fall_s, tweezer.heat
        loss, warmer = self.hand_over("drop_off", *place)
        by_heat = 1 - (1 - tweezer.lost) * (1 - loss)
        in_motion = 1 - (1 - per_tone) * (1 - tweezer.risk)
        return by_heat, by_hand_over, in_motion, tweezer.heat * warmer


def affect(tweezer: Any, response: Response) -> None:
    loss, warmer = response
    tweezer.lost = 1 - (1 - tweezer.lost) * (1 - loss)
    tweezer.heat *= warmer
