"""The step that equalises the static tweezers in a closed loop.

The power of the spot (i, j) depends on the tone of row i and the tone of column j:
``P_ij = P f_i g_j (1 + e_ij)``. The factors f and g are the *separable* part, which the tones can
make even; e is the rest, which they cannot change. Light shifts may be used instead of powers.
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
"""Light of a row or column, relative to the median, below which its tone is taken to be off."""


@dataclass(frozen=True, slots=True, eq=False)
class Factors:
    """Logarithms of the factors of rows and columns, each with mean 0.

    Attributes:
        row: float64 (n_rows,).
        column: float64 (n_cols,).
        residual: float64 (n_rows, n_cols), what is left of the logarithm of the power; nan where
            nothing was measured.
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
        """The standard deviation of the rest, relative."""
        measured = self.residual[np.isfinite(self.residual)]
        n_free = len(measured) - len(self.row) - len(self.column) + 1
        return float(np.sqrt((measured**2).sum() / max(1, n_free)))


@dataclass(frozen=True, slots=True, eq=False)
class Equalised:
    """Amplitudes that make the spots more even.

    Attributes:
        row_amplitudes: float64 (n_rows,), fractions of full scale.
        column_amplitudes: float64 (n_cols,), likewise.
        separable_spread: The rms of the separable part that was measured, relative.
        residual_spread: The standard deviation of the part that the tones cannot change, relative.
    """

    row_amplitudes: Floats
    column_amplitudes: Floats
    separable_spread: float
    residual_spread: float


def factors(power: Floats) -> Factors:
    """Separate powers into factors of rows and columns: a two-way analysis of variance of their logarithms.

    Args:
        power: float64 (n_rows, n_cols), in any unit; nan where nothing was measured. Values
            of 0 or less count as not measured.

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


def equalise(
    power: Floats,
    row_amplitudes: Floats,
    column_amplitudes: Floats,
    gain: float = 1.0,
    max_sum: float = 1.0,
) -> Equalised:
    """Take the separable part out of the powers, which are taken as proportional to the amplitude squared.

    The sum of an axis' amplitudes stays what it was, or comes down to ``max_sum``.

    Args:
        power: float64 (n_rows, n_cols), nan where nothing was measured.
        row_amplitudes: float64 (n_rows,), those that the powers were measured at.
        column_amplitudes: float64 (n_cols,), likewise.
        gain: Fraction of the separable part to take out; below 1 a loop averages over noise.
        max_sum: Largest sum of the amplitudes of an axis, as a fraction of full scale.

    Raises:
        DeviceError: A row or column has no light.
        ValueError: Shapes do not match, or an amplitude is not above 0.
    """
    shape = (len(row_amplitudes), len(column_amplitudes))
    if np.shape(power) != shape:
        raise ValueError(f"powers of shape {np.shape(power)}; expected {shape}")
    separated = factors(power)
    return Equalised(
        _corrected(row_amplitudes, separated.row, gain, max_sum),
        _corrected(column_amplitudes, separated.column, gain, max_sum),
        separated.separable_spread,
        separated.residual_spread,
    )


def _corrected(amplitudes: Floats, logarithm: Floats, gain: float, max_sum: float) -> Floats:
    before = np.asarray(amplitudes, np.float64)
    if not np.all(before > 0):
        raise ValueError("an amplitude is not above 0: nothing can be measured of its tone")
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
            message = f"no light on {name} {lines}: is its tone on, and are its spots where the camera looks?"
            raise DeviceError("static_tweezers", message)


PATIENCE: Final = 4
"""Rounds within which the spread must fall by a tenth."""


class EqualiseSettings(PowerMeterSettings):
    """``equalise``: make the static or the mobile tweezers even, in a closed loop."""

    tweezers: Literal["static", "mobile"] = Field(
        default="static",
        description="which tweezers; all tones of the mobile ones are on for each frame of a camera",
    )
    spread: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.005, description="target rms of the part that rows and columns can even out"
    )
    gain: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.8, description="fraction of it that a round takes out"
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
        equalised: The amplitudes now in use, and the spreads measured at them; both spreads include
            the noise of the measurement.
        noise: The noise in the separable spread.
        spreads: Separable spread of each round, the last one included.
        n_measured: Measurements in all.
    """

    equalised: Equalised
    noise: float
    spreads: tuple[float, ...]
    n_measured: int


def equalise_loop(
    measure: Callable[[], Floats],
    apply: Callable[[Floats, Floats], None],
    row_amplitudes: Floats,
    column_amplitudes: Floats,
    limits: EqualiseSettings | None = None,
) -> LoopResult:
    """Measure and correct until the separable part of the powers is even.

    Each round averages measurements until their noise, estimated from their own scatter, is a third
    of the target spread, or of the spread that the round is expected to leave.

    Args:
        measure: Measures the power of each spot once, float64 (n_rows, n_cols), nan where it cannot.
        apply: Plays amplitudes of rows and columns.
        row_amplitudes: float64 (n_rows,), where to begin.
        column_amplitudes: float64 (n_cols,), likewise.
        limits: Target spread, gain, and when to end.

    Raises:
        DeviceError: The loop does not converge, and why: a tone without light, too much
            noise and how many averages it would take, or a spread that does not fall.
    """
    limits = limits or EqualiseSettings()
    rows, cols = (np.array(each, np.float64) for each in (row_amplitudes, column_amplitudes))
    spreads: list[float] = []
    n_measured = 0
    while len(spreads) < limits.max_rounds:
        apply(rows, cols)
        # 0.3 is the part of the spread that is expected to remain after a round
        noise_limit = 1 / 3 * max(limits.spread, 0.3 * spreads[-1] if spreads else 0.0)
        power, noise, n = _average(measure, noise_limit, limits.max_averages)
        n_measured += n
        corrected = equalise(power, rows, cols, limits.gain, limits.max_sum)
        spreads.append(corrected.separable_spread)
        if corrected.separable_spread <= limits.spread:
            measured = Equalised(rows, cols, corrected.separable_spread, corrected.residual_spread)
            return LoopResult(measured, noise, tuple(spreads), n_measured)
        _refuse_standstill(spreads, power, rows, cols)
        rows, cols = corrected.row_amplitudes, corrected.column_amplitudes
    return _refuse(f"the separable spread is {spreads[-1]:.2%} after {len(spreads)} rounds")


def _average(
    measure: Callable[[], Floats], noise_limit: float, max_averages: int
) -> tuple[Floats, float, int]:
    """The mean of enough measurements, the noise of its separable part, and how many there were."""
    mean = np.asarray(measure(), np.float64)
    shares, noise = [_shares(mean)], math.inf
    while noise > noise_limit:
        n = len(shares)
        if n >= max_averages:
            needed = math.ceil(n * (noise / noise_limit) ** 2)
            _refuse(
                f"too much noise: {n} averages leave {noise:.2%} of the separable part unknown; "
                f"about {needed} averages are needed"
            )
        power = np.asarray(measure(), np.float64)
        mean = mean + (power - mean) / (n + 1)
        shares.append(_shares(power))
        noise = _noise(np.array(shares), len(mean))
    return mean, noise, len(shares)


def _shares(power: Floats) -> Floats:
    """The part of all light that each row and each column has, float64 (n_rows + n_cols,)."""
    light = np.where(np.isfinite(power), power, 0.0)
    return np.concatenate([light.sum(axis=1), light.sum(axis=0)]) / max(float(light.sum()), 1e-300)


def _noise(shares: Floats, n_rows: int) -> float:
    """The rms of the separable part of a mean of measurements that is due to noise, from their scatter.

    Args:
        shares: float64 (n_measurements, n_rows + n_cols), those of rows and columns in each measurement.
        n_rows: Number of rows.
    """
    mean, variance = shares.mean(axis=0), shares.var(axis=0, ddof=1)
    lit = mean > DEAD * np.median(mean)  # `factors` refuses the others
    relative = np.where(lit, variance, 0.0) / np.where(lit, mean, 1.0) ** 2
    return math.sqrt(float(relative[:n_rows].mean() + relative[n_rows:].mean()) / len(shares))


def _refuse_standstill(spreads: list[float], power: Floats, rows: Floats, cols: Floats) -> None:
    if len(spreads) <= PATIENCE or spreads[-1] < 0.9 * spreads[-1 - PATIENCE]:
        return
    separated = factors(power)
    name, off, amplitudes = max(
        (("row", separated.row, rows), ("column", separated.column, cols)),
        key=lambda axis: np.abs(axis[1]).max(),
    )
    worst = int(np.abs(off).argmax())
    _refuse(
        f"the separable spread stays at {spreads[-1]:.2%}; the spots of {name} {worst} have "
        f"{math.exp(off[worst]):.3g} times the power of the others at an amplitude of "
        f"{amplitudes[worst]:.3g} of full scale: do they follow it, or is an amplifier at its limit?"
    )


def _refuse(why: str) -> NoReturn:
    raise DeviceError("static_tweezers", f"not equalised: {why}")


READINGS: Final = "equalise."
"""Prefix of the names of the readings that the step records."""


class EqualiseStep(Step):
    """Measures the power of each static tweezer, and corrects the rows' and columns' tones until it is even.

    A camera measures, or another device of the profile; see :class:`labseq.builtin.spot_powers.TweezerMeter`.
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
        """Turn the array on and run the loop; its result stays in use and is recorded in the shot's readings.

        Raises:
            DeviceError: The loop does not converge, and why; or the device's value is not such an array.
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

        rows, cols = _mobile_in_force(shot) if is_mobile else _in_force(shot)
        with shot.stage("equalise"):
            result = equalise_loop(measure, meter.apply, rows, cols, settings)
            after = meter.measure()
        equalised = result.equalised
        shot.note(READINGS + "row_amplitudes", equalised.row_amplitudes.tolist())
        shot.note(READINGS + "column_amplitudes", equalised.column_amplitudes.tolist())
        shot.note(READINGS + "separable_spread", equalised.separable_spread)
        shot.note(READINGS + "residual_spread", equalised.residual_spread)
        shot.note(READINGS + "noise", result.noise)
        shot.note(READINGS + "spreads", list(result.spreads))
        shot.note(READINGS + "n_measured", result.n_measured)
        shot.note(READINGS + "power_before", before[0].tolist())
        shot.note(READINGS + "power_after", after.tolist())


def _in_force(shot: Shot) -> tuple[Floats, Floats]:
    """The amplitudes to begin with: those of the calibration; else all equal, adding up to full scale."""
    entry = shot.calibrations.get("tweezers")
    if entry is not None:
        return entry.values["row_amplitudes"], entry.values["column_amplitudes"]
    n_rows, n_cols = shot.grid.shape
    return np.full(n_rows, 1 / n_rows), np.full(n_cols, 1 / n_cols)


def _mobile_in_force(shot: Shot) -> tuple[Floats, Floats]:
    """The amplitudes of the mobile tweezers' tones: calibrated, of the profile, or all equal."""
    return drive(shot.grid, shot.motion, 0).amplitude, drive(shot.grid, shot.motion, 1).amplitude
