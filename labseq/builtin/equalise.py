"""The step that equalises the static tweezers in a closed loop.

The power of the spot (i, j) depends on the tone of row i and the tone of column j:
``P_ij = P f_i g_j (1 + e_ij)``. The factors f and g are the *separable* part, which the tones can make even.
The residual e cannot be changed by tones. Light shifts may be used instead of powers. Tweezers with a weight
for each site, as from an SLM, have no such residual.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from labseq.builtin.spot_powers import MobileTweezerMeter, TweezerMeter
from labseq.config.profile import PowerMeterSettings
from labseq.errors import DeviceError
from labseq.model import TimelineEntry
from labseq.motion import drive
from labseq.roles import Shot, Step, StepContext

Floats = NDArray[np.float64]

DEAD: Final = 0.05
"""Light of a row or column, relative to the median, below which its tone counts as off."""


@dataclass(frozen=True, slots=True, eq=False)
class Factors:
    """Logarithms of the factors of rows and columns, each with mean 0.

    Attributes:
        row: float64 (n_rows,).
        column: float64 (n_cols,).
        residual: float64 (n_rows, n_cols), the residual of the logarithm of the power. nan where nothing was
            measured.
    """

    row: Floats
    column: Floats
    residual: Floats

    @property
    def separable_spread(self) -> float:
        """The rms of the separable part over all sites, relative."""
        return float(np.sqrt(np.mean(self.row**2) + np.mean(self.column**2)))

    @property
    def residual_spread(self) -> float:
        """The standard deviation of the residual, relative."""
        measured = self.residual[np.isfinite(self.residual)]
        n_free = len(measured) - len(self.row) - len(self.column) + 1
        return float(np.sqrt((measured**2).sum() / max(1, n_free)))


def factors(power: Floats) -> Factors:
    """Separate powers into factors of rows and columns, by a two-way analysis of variance of logarithms.

    Args:
        power: float64 (n_rows, n_cols), in any unit. nan where nothing was measured. Values of 0 or less
            count as not measured.

    Raises:
        DeviceError: A row or column has no light.

    Example:
        >>> separated = factors(np.outer([1.0, 4.0], [1.0, 1.0, 1.0]))
        >>> np.exp(separated.row).round(9).tolist(), separated.residual_spread < 1e-12
        ([0.5, 2.0], True)
    """
    power = np.asarray(power, np.float64)
    measured = np.isfinite(power) & (power > 0)
    _refuse_dead(power, measured)
    n_rows, n_cols = power.shape
    row, col = np.nonzero(measured)
    design = np.zeros((len(row) + 2, 1 + n_rows + n_cols))
    design[:-2, 0] = 1.0
    design[np.arange(len(row)), 1 + row] = design[np.arange(len(row)), 1 + n_rows + col] = 1.0
    design[-2, 1 : 1 + n_rows] = design[-1, 1 + n_rows :] = 1.0  # the means are 0
    logarithm = np.log(power[measured])
    fit = np.asarray(np.linalg.lstsq(design, np.append(logarithm, [0.0, 0.0]))[0], np.float64)
    residual = np.full(power.shape, np.nan)
    residual[measured] = logarithm - design[:-2] @ fit
    return Factors(fit[1 : 1 + n_rows], fit[1 + n_rows :], residual)


def _corrected(amplitudes: Floats, logarithm: Floats, gain: float, max_sum: float) -> Floats:
    before = np.asarray(amplitudes, np.float64)
    if not np.all(before > 0):
        raise ValueError("an amplitude is not above 0, so its tone cannot be measured")
    after = before * np.exp(-0.5 * gain * logarithm)
    after *= min(float(before.sum()), max_sum) / after.sum()
    return np.minimum(after, 1.0)


def _refuse_dead(power: Floats, measured: NDArray[np.bool_]) -> None:
    light = np.where(measured, power, 0.0)
    expected = np.isfinite(power)
    for axis, name in ((1, "row"), (0, "column")):
        n_expected = expected.sum(axis=axis)
        mean = np.divide(
            light.sum(axis=axis), n_expected, out=np.zeros(len(n_expected)), where=n_expected > 0
        )
        dead = np.flatnonzero(mean <= DEAD * np.median(mean))
        if len(dead):
            lines = ", ".join(str(line) for line in dead[:5]) + (", ..." if len(dead) > 5 else "")
            message = f"no light on {name} {lines}; check that its tone is on and the camera sees its spots"
            raise DeviceError("static_tweezers", message)


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The correction from a measurement of the powers.

    Attributes:
        values: The values to play next.
        spread: The rms of the part that the values can change, relative.
        residual_spread: The standard deviation of the residual, relative.
        off: Logarithms of the deviation of each value, like ``values``.
    """

    values: tuple[Floats, ...]
    spread: float
    residual_spread: float
    off: tuple[Floats, ...]


class Tones:
    """Powers that follow the amplitudes of rows (n_rows,) and of columns (n_cols,)."""

    names = ("row", "column")

    def light(self, power: Floats) -> tuple[Floats, ...]:
        """The light of each row and of each column."""
        return power.sum(axis=1), power.sum(axis=0)

    def correct(self, power: Floats, values: tuple[Floats, ...], limits: EqualiseSettings) -> Correction:
        """Amplitudes that make the spots more even, as powers go with the amplitude squared.

        The sum of an axis' amplitudes stays the same, or is reduced to ``max_sum``.

        Raises:
            DeviceError: A row or column has no light.
            ValueError: An amplitude is not above 0.
        """
        separated = factors(power)
        off = separated.row, separated.column
        axes = zip(values, off, strict=True)
        after = tuple(_corrected(each, by, limits.gain, limits.max_sum) for each, by in axes)
        return Correction(after, separated.separable_spread, separated.residual_spread, off)


class Sites:
    """Powers in proportion to the weights of the sites, (n_rows, n_cols)."""

    names = ("site",)

    def light(self, power: Floats) -> tuple[Floats, ...]:
        """The light of each site."""
        return (power.ravel(),)

    def correct(self, power: Floats, values: tuple[Floats, ...], limits: EqualiseSettings) -> Correction:
        """Weights that make the spots more even, with a mean of 1. Weights of unmeasured sites stay.

        Raises:
            DeviceError: A row or column has no light.
        """
        measured = np.isfinite(power) & (power > 0)
        _refuse_dead(power, measured)
        off = np.log(power, out=np.zeros(power.shape), where=measured)
        off = np.where(measured, off - off[measured].mean(), 0.0)
        weights = values[0] * np.exp(-limits.gain * off)
        return Correction((weights / weights.mean(),), float(np.std(off[measured])), 0.0, (off,))


PATIENCE: Final = 4
"""Rounds within which the spread must fall by a tenth."""


class EqualiseSettings(PowerMeterSettings):
    """``equalise``: make the static or the mobile tweezers even, in a closed loop."""

    tweezers: Literal["static", "mobile"] = Field(
        default="static",
        description="which tweezers. For each frame of a camera all tones of mobile tweezers are on",
    )
    spread: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.005, description="target rms of the part that rows and columns can even out"
    )
    gain: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.8, description="fraction of this part that a round corrects"
    )
    max_sum: Annotated[float, Field(gt=0)] = Field(
        default=1.0, description="largest sum of the amplitudes of an axis, as a fraction of full scale"
    )
    max_averages: int = Field(
        default=100, ge=2, description="maximum number of measurements that a round averages"
    )
    max_rounds: int = Field(default=25, ge=1, description="maximum number of rounds")


@dataclass(frozen=True, slots=True, eq=False)
class LoopResult:
    """The result of the loop.

    Attributes:
        values: Amplitudes of rows and columns now in use, or the weights of the sites.
        residual_spread: The standard deviation of the part that the values cannot change, relative.
        noise: The noise in the last spread and in the residual spread.
        spreads: Spread in each round, including the last, of the part that the values can change.
        n_measured: Total number of measurements.
    """

    values: tuple[Floats, ...]
    residual_spread: float
    noise: float
    spreads: tuple[float, ...]
    n_measured: int


def equalise_loop(
    measure: Callable[[], Floats],
    apply: Callable[..., None],
    values: tuple[Floats, ...],
    limits: EqualiseSettings | None = None,
    control: Tones | Sites | None = None,
) -> LoopResult:
    """Measure and correct until the part of the powers that can be changed is even.

    Each round averages measurements until their noise, estimated from their scatter, is a third of the target
    spread, or of the expected spread after the round.

    Args:
        measure: Measures the power of each spot once, float64 (n_rows, n_cols), nan for unmeasured spots.
        apply: Plays such values.
        values: Initial amplitudes of rows (n_rows,) and of columns (n_cols,), or weights of the sites
            (n_rows, n_cols).
        limits: Target spread, gain, and limits of the loop.
        control: How the powers follow the values. None for tones.

    Raises:
        DeviceError: The loop does not converge. The message says why: a tone without light, too much noise
            (with the number of averages that it would take), or a spread that does not fall.
    """
    limits, control = limits or EqualiseSettings(), control or Tones()
    spreads: list[float] = []
    n_measured = 0
    while len(spreads) < limits.max_rounds:
        apply(*values)
        # 0.3 is the expected remaining fraction of the spread after a round
        noise_limit = 1 / 3 * max(limits.spread, 0.3 * spreads[-1] if spreads else 0.0)
        power, noise, n = _average(measure, control, noise_limit, limits.max_averages)
        n_measured += n
        corrected = control.correct(power, values, limits)
        spreads.append(corrected.spread)
        if corrected.spread <= limits.spread:
            return LoopResult(values, corrected.residual_spread, noise, tuple(spreads), n_measured)
        _refuse_standstill(spreads, control, values, corrected.off)
        values = corrected.values
    return _refuse(f"the separable spread is {spreads[-1]:.2%} after {len(spreads)} rounds")


def _average(
    measure: Callable[[], Floats], control: Tones | Sites, noise_limit: float, max_averages: int
) -> tuple[Floats, float, int]:
    """The mean of enough measurements, the noise of its changeable part, and their number."""
    mean = np.asarray(measure(), np.float64)
    shares, noise = [_shares(mean, control)], math.inf
    while noise > noise_limit:
        n = len(shares)
        if n >= max_averages:
            needed = math.ceil(n * (noise / noise_limit) ** 2)
            _refuse(
                f"there is too much noise, as {n} averages leave {noise:.2%} of the separable part unknown; "
                f"about {needed} averages are needed"
            )
        power = np.asarray(measure(), np.float64)
        mean = mean + (power - mean) / (n + 1)
        shares.append(_shares(power, control))
        noise = _noise(shares)
    return mean, noise, len(shares)


def _shares(power: Floats, control: Tones | Sites) -> tuple[Floats, ...]:
    """The fraction of all light in each row and each column, or in each site."""
    light = np.where(np.isfinite(power), power, 0.0)
    return tuple(each / max(float(light.sum()), 1e-300) for each in control.light(light))


def _noise(shares: list[tuple[Floats, ...]]) -> float:
    """The rms noise in the changeable part of a mean of measurements, from their scatter.

    Args:
        shares: Fractions of rows and of columns, or of sites, in each measurement.
    """
    total = 0.0
    for each in zip(*shares, strict=True):
        mean, variance = np.mean(each, axis=0), np.var(each, axis=0, ddof=1)
        lit = mean > DEAD * np.median(mean)  # values without light are refused later
        total += float(np.mean(np.where(lit, variance, 0.0) / np.where(lit, mean, 1.0) ** 2))
    return math.sqrt(total / len(shares))


def _refuse_standstill(
    spreads: list[float], control: Tones | Sites, values: tuple[Floats, ...], off: tuple[Floats, ...]
) -> None:
    if len(spreads) <= PATIENCE or spreads[-1] < 0.9 * spreads[-1 - PATIENCE]:
        return
    name, off_by, played = max(
        zip(control.names, off, values, strict=True), key=lambda axis: np.abs(axis[1]).max()
    )
    place = np.unravel_index(int(np.abs(off_by).argmax()), off_by.shape)
    worst = ", ".join(map(str, place))
    share, cause = f"an amplitude of {played[place]:.3g} of full scale", "no amplifier is at its limit"
    if off_by.ndim > 1:
        worst, share, cause = f"({worst})", f"a weight of {played[place]:.3g}", "no other spot overlaps"
    _refuse(
        f"the separable spread stays at {spreads[-1]:.2%}, and the spots of {name} {worst} have "
        f"{math.exp(off_by[place]):.3g} times the power of the others at {share}; "
        f"check that they follow it and that {cause}"
    )


def _refuse(why: str) -> NoReturn:
    raise DeviceError("static_tweezers", f"not equalised: {why}")


READINGS: Final = "equalise."
"""Prefix of the names of the readings that the step records."""


class EqualiseStep(Step):
    """Measures the power of each static tweezer, and corrects the tones of rows and columns until it is even.

    If the static tweezers have a weight for each site, it corrects the weights instead. The meter is a camera
    or another device of the profile (see :class:`labseq.builtin.spot_powers.TweezerMeter`).
    """

    takes_time = False
    device_setting = "device"
    device_may_be_camera = True
    notes = (READINGS,)

    def __init__(self, settings: EqualiseSettings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002 - of the role
        """One entry without a known length."""
        return [TimelineEntry(f"equalise by {self.settings.device}", 0.0, 0.0)]

    def run(self, shot: Shot) -> None:
        """Turn the array on and run the loop. Its result stays in use and is recorded in the shot's readings.

        Raises:
            DeviceError: The loop does not converge, or the device's value does not have the right shape.
        """
        settings, before = self.settings, list[Floats]()
        is_mobile = settings.tweezers == "mobile"
        if not is_mobile:
            shot.call("static_tweezers", shot.call_timeout_s, shot.static_tweezers.start)
        meter = (MobileTweezerMeter if is_mobile else TweezerMeter)(shot, settings)

        def measure() -> Floats:
            power = meter.measure()
            before.append(power) if not before else None
            return power

        has_weights = not is_mobile and shot.static_tweezers.facts.control == "sites"
        in_force = _mobile_in_force if is_mobile else _weights_in_force if has_weights else _in_force
        with shot.stage("equalise"):
            control = Sites() if has_weights else Tones()
            result = equalise_loop(measure, meter.apply, in_force(shot), settings, control)
            after = meter.measure()
        names = ("weights",) if has_weights else ("row_amplitudes", "column_amplitudes")
        for name, values in zip(names, result.values, strict=True):
            shot.note(READINGS + name, values.tolist())
        shot.note(READINGS + "separable_spread", result.spreads[-1])
        shot.note(READINGS + "residual_spread", result.residual_spread)
        shot.note(READINGS + "noise", result.noise)
        shot.note(READINGS + "spreads", list(result.spreads))
        shot.note(READINGS + "n_measured", result.n_measured)
        shot.note(READINGS + "power_before", before[0].tolist())
        shot.note(READINGS + "power_after", after.tolist())


def _weights_in_force(shot: Shot) -> tuple[Floats]:
    """The initial weights, from the calibration or all equal."""
    entry = shot.calibrations.get("tweezers")
    weights = None if entry is None else entry.values.get("weights")
    return (np.ones(shot.grid.shape) if weights is None else weights,)


def _in_force(shot: Shot) -> tuple[Floats, Floats]:
    """The initial amplitudes, from the calibration, or all equal with a sum of full scale."""
    entry = shot.calibrations.get("tweezers")
    if entry is not None:
        return entry.values["row_amplitudes"], entry.values["column_amplitudes"]
    n_rows, n_cols = shot.grid.shape
    return np.full(n_rows, 1 / n_rows), np.full(n_cols, 1 / n_cols)


def _mobile_in_force(shot: Shot) -> tuple[Floats, Floats]:
    """The amplitudes of the mobile tweezers' tones, from the calibration or the profile, or all equal."""
    return drive(shot.grid, shot.motion, 0).amplitude, drive(shot.grid, shot.motion, 1).amplitude
