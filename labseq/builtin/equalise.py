"""The step that equalises the static tweezers in a closed loop.

The spot (i, j) has a power that goes with the tone of row i and the tone of column j:
``P_ij = P f_i g_j (1 + e_ij)``. The factors f and g are the *separable* part, which the tones can
make even; e is the rest, which they cannot, and which is left alone. A light shift serves as
well as a power.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NoReturn, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError
from labseq.model import TimelineEntry
from labseq.roles import Device, Shot, StepContext

Floats = NDArray[np.float64]

DEAD: Final = 0.05
"""Light of a row or column, over that of the others, below which its tone is taken to be off."""


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
        known = self.residual[np.isfinite(self.residual)]
        n_free = len(known) - len(self.row) - len(self.column) + 1
        return float(np.sqrt((known**2).sum() / max(1, n_free)))


@dataclass(frozen=True, slots=True, eq=False)
class Equalised:
    """Amplitudes that make the spots more even.

    Attributes:
        row_amplitudes: float64 (n_rows,), fractions of full scale.
        column_amplitudes: float64 (n_cols,), likewise.
        separable_spread: The rms of the separable part that was measured, relative.
        residual_spread: The standard deviation of what the tones cannot change, relative.
    """

    row_amplitudes: Floats
    column_amplitudes: Floats
    separable_spread: float
    residual_spread: float


def factors(power: Floats) -> Factors:
    """Part powers into factors of rows and columns: a two-way analysis of variance of their logarithms.

    Args:
        power: float64 (n_rows, n_cols), in any unit; nan where nothing was measured. What is not
            above 0 counts as not measured.

    Raises:
        DeviceError: A row or column has no light.

    Example:
        >>> found = factors(np.outer([1.0, 4.0], [1.0, 1.0, 1.0]))
        >>> np.exp(found.row).round(9).tolist(), found.residual_spread < 1e-12
        ([0.5, 2.0], True)
    """
    power = np.asarray(power, np.float64)
    known = np.isfinite(power) & (power > 0)
    _refuse_dead(power, known)
    n_rows, n_cols = power.shape
    row, col = np.nonzero(known)
    design = np.zeros((len(row) + 2, 1 + n_rows + n_cols))
    design[:-2, 0] = 1.0
    design[np.arange(len(row)), 1 + row] = design[np.arange(len(row)), 1 + n_rows + col] = 1.0
    design[-2, 1 : 1 + n_rows] = design[-1, 1 + n_rows :] = 1.0  # the means are 0
    logarithm = np.log(power[known])
    fit = np.asarray(np.linalg.lstsq(design, np.append(logarithm, [0.0, 0.0]))[0], np.float64)
    residual = np.full(power.shape, np.nan)
    residual[known] = logarithm - design[:-2] @ fit
    return Factors(fit[1 : 1 + n_rows], fit[1 + n_rows :], residual)


def equalise(
    power: Floats,
    row_amplitudes: Floats,
    column_amplitudes: Floats,
    gain: float = 1.0,
    max_sum: float = 1.0,
) -> Equalised:
    """Take the separable part out of the powers; they are taken to go as the amplitude squared.

    The sum of an axis' amplitudes stays what it was, or comes down to ``max_sum``.

    Args:
        power: float64 (n_rows, n_cols), nan where nothing was measured.
        row_amplitudes: float64 (n_rows,), those that the powers were measured at.
        column_amplitudes: float64 (n_cols,), likewise.
        gain: How much of the separable part to take out; below 1 a loop is patient with noise.
        max_sum: Most that the amplitudes of an axis may add up to, as a fraction of full scale.

    Raises:
        DeviceError: A row or column has no light.
        ValueError: Shapes do not belong together, or an amplitude is not above 0.
    """
    shape = (len(row_amplitudes), len(column_amplitudes))
    if np.shape(power) != shape:
        raise ValueError(f"powers of shape {np.shape(power)}; expected {shape}")
    found = factors(power)
    return Equalised(
        _corrected(row_amplitudes, found.row, gain, max_sum),
        _corrected(column_amplitudes, found.column, gain, max_sum),
        found.separable_spread,
        found.residual_spread,
    )


def _corrected(amplitudes: Floats, logarithm: Floats, gain: float, max_sum: float) -> Floats:
    before = np.asarray(amplitudes, np.float64)
    if not np.all(before > 0):
        raise ValueError("an amplitude is not above 0: nothing can be measured of its tone")
    after = before * np.exp(-0.5 * gain * logarithm)
    after *= min(float(before.sum()), max_sum) / after.sum()
    return np.minimum(after, 1.0)


def _refuse_dead(power: Floats, known: NDArray[np.bool_]) -> None:
    light = np.where(known, power, 0.0)
    asked = np.isfinite(power)
    for axis, name in ((1, "row"), (0, "column")):
        n_asked = asked.sum(axis=axis)
        mean = np.divide(light.sum(axis=axis), n_asked, out=np.zeros(len(n_asked)), where=n_asked > 0)
        dead = np.flatnonzero(mean <= DEAD * np.median(mean))
        if len(dead):
            which = ", ".join(str(one) for one in dead[:5]) + (", ..." if len(dead) > 5 else "")
            text = f"no light on {name} {which}: is its tone on, and are its spots where the camera looks?"
            raise DeviceError("static_tweezers", text)


QUIET: Final = 1 / 3
"""Noise of the separable part, over the spread that is aimed at, at which averaging ends."""
ROUGH: Final = 0.3
"""What a round is expected to leave of the spread."""
MIN_PROGRESS: Final = 0.9
"""By what factor the spread must fall in :data:`PATIENCE` rounds."""
PATIENCE: Final = 4


@dataclass(frozen=True, slots=True)
class LoopLimits:
    """When the loop ends.

    Attributes:
        spread: The rms of the separable part that is aimed at, relative.
        gain: How much of it a round takes out.
        max_sum: Most that an axis' amplitudes may add up to.
        max_averages: Most measurements that a round averages.
        max_rounds: Most rounds.
    """

    spread: float = 0.005
    gain: float = 0.8
    max_sum: float = 1.0
    max_averages: int = 100
    max_rounds: int = 25


@dataclass(frozen=True, slots=True, eq=False)
class LoopResult:
    """Where the loop arrived.

    Attributes:
        equalised: The amplitudes in force, and the spreads that were measured at them; the noise
            of the measurement is still in both.
        noise: Its part of the separable spread.
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
    limits: LoopLimits | None = None,
) -> LoopResult:
    """Measure and correct until the separable part of the powers is even.

    Each round averages measurements until their noise, worked out from their own scatter, is a third
    of the spread that is aimed at, or of what the round is about to leave. The part that the tones
    cannot change is left alone.

    Args:
        measure: Measures the power of each spot once, float64 (n_rows, n_cols), nan where it cannot.
        apply: Plays amplitudes of rows and columns.
        row_amplitudes: float64 (n_rows,), where to begin.
        column_amplitudes: float64 (n_cols,), likewise.
        limits: When to end.

    Raises:
        DeviceError: It does not arrive; it says why: a tone without light, too much
            noise and how many averages it would take, or a spread that does not fall.
    """
    limits = limits or LoopLimits()
    rows, cols = (np.array(each, np.float64) for each in (row_amplitudes, column_amplitudes))
    spreads: list[float] = []
    n_measured = 0
    while len(spreads) < limits.max_rounds:
        apply(rows, cols)
        wanted = QUIET * max(limits.spread, ROUGH * spreads[-1] if spreads else 0.0)
        power, noise, n = _average(measure, wanted, limits.max_averages)
        n_measured += n
        found = equalise(power, rows, cols, limits.gain, limits.max_sum)
        spreads.append(found.separable_spread)
        if found.separable_spread <= limits.spread:
            here = Equalised(rows, cols, found.separable_spread, found.residual_spread)
            return LoopResult(here, noise, tuple(spreads), n_measured)
        _refuse_standstill(spreads, power, rows, cols)
        rows, cols = found.row_amplitudes, found.column_amplitudes
    return _refuse(f"the separable spread is {spreads[-1]:.2%} after {len(spreads)} rounds")


def _average(measure: Callable[[], Floats], wanted: float, max_averages: int) -> tuple[Floats, float, int]:
    """The mean of enough measurements, the noise of its separable part, and how many there were."""
    mean = np.asarray(measure(), np.float64)
    squares, noise, n = np.zeros_like(mean), math.inf, 1
    while noise > wanted:
        if n >= max_averages:
            needed = math.ceil(n * (noise / wanted) ** 2)
            _refuse(
                f"too much noise: {n} averages leave {noise:.2%} of the separable part unknown; "
                f"about {needed} averages are needed"
            )
        power = np.asarray(measure(), np.float64)
        n += 1
        off = power - mean
        mean = mean + off / n
        squares = squares + off * (power - mean)
        noise = _noise(mean, squares / (n - 1) / n)
    return mean, noise, n


def _noise(mean: Floats, variance: Floats) -> float:
    """The rms that noise alone gives the separable part of powers of some variance."""
    known = np.isfinite(mean) & (mean > 0)
    n_rows, n_cols = mean.shape
    if not known.any():
        return 0.0  # there is nothing to average; what that means is said by others
    relative = float((variance[known] / mean[known] ** 2).mean())
    return math.sqrt(relative * (1 / n_rows + 1 / n_cols))


def _refuse_standstill(spreads: list[float], power: Floats, rows: Floats, cols: Floats) -> None:
    if len(spreads) <= PATIENCE or spreads[-1] < MIN_PROGRESS * spreads[-1 - PATIENCE]:
        return
    found = factors(power)
    name, off, amplitudes = max(
        (("row", found.row, rows), ("column", found.column, cols)), key=lambda one: np.abs(one[1]).max()
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
"""What the names of the readings begin with that the step leaves."""


class _Settings(Protocol):
    @property
    def device(self) -> str: ...
    @property
    def value(self) -> str: ...
    @property
    def spread(self) -> float: ...
    @property
    def gain(self) -> float: ...
    @property
    def max_sum(self) -> float: ...
    @property
    def max_averages(self) -> int: ...
    @property
    def max_rounds(self) -> int: ...


class EqualiseStep:
    """Measures the power of each static tweezer, and corrects the rows' and columns' tones until it is even.

    A device of the profile measures: its value is an array (n_rows, n_cols) of spot powers on a camera, light
    shifts, or anything else that goes with the depth; nan where it cannot tell.
    """

    needs_image = False
    takes_image = False

    def __init__(self, settings: _Settings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002 - Protocol
        """One bar without a known length."""
        return [TimelineEntry(f"equalise by {self.settings.device}", 0.0, 0.0)]

    def run(self, shot: Shot) -> None:
        """Turn the array on and run the loop; what it found stays in force, and among the shot's readings.

        Raises:
            DeviceError: The loop does not arrive; it says why. Or the device's value is no such array.
        """
        settings, tweezers = self.settings, shot.static_tweezers
        limit_s, device = shot.call_timeout_s, shot.device(settings.device)
        shot.call("static_tweezers", limit_s, tweezers.start)
        limits = LoopLimits(
            settings.spread, settings.gain, settings.max_sum, settings.max_averages, settings.max_rounds
        )

        def apply(rows: Floats, cols: Floats) -> None:
            shot.call("static_tweezers", limit_s, tweezers.load, (rows, cols))

        before: list[Floats] = []

        def measure() -> Floats:
            power = self._measure(shot, device)
            before.append(power) if not before else None
            return power

        rows, cols = _in_force(shot)
        with shot.stage("equalise"):
            found = equalise_loop(measure, apply, rows, cols, limits)
            after = self._measure(shot, device)
        equalised = found.equalised
        shot.note(READINGS + "row_amplitudes", equalised.row_amplitudes.tolist())
        shot.note(READINGS + "column_amplitudes", equalised.column_amplitudes.tolist())
        shot.note(READINGS + "separable_spread", equalised.separable_spread)
        shot.note(READINGS + "residual_spread", equalised.residual_spread)
        shot.note(READINGS + "noise", found.noise)
        shot.note(READINGS + "spreads", list(found.spreads))
        shot.note(READINGS + "n_measured", found.n_measured)
        shot.note(READINGS + "power_before", before[0].tolist())
        shot.note(READINGS + "power_after", after.tolist())

    def _measure(self, shot: Shot, device: Device) -> Floats:
        """One measurement, float64 (n_rows, n_cols)."""
        name, value = self.settings.device, self.settings.value
        answer = shot.call(name, shot.call_timeout_s, device.read, value)
        try:
            power = np.asarray(answer, np.float64)
        except (TypeError, ValueError):
            power = np.array(np.nan)
        if power.shape != shot.grid.shape:
            came = power.shape if power.ndim else type(answer).__name__
            text = f"its value '{value}' is {came}; expected the power of each of {shot.grid.shape} tweezers"
            raise DeviceError(name, text)
        return power


def _in_force(shot: Shot) -> tuple[Floats, Floats]:
    """Where to begin: the calibration in use; without one all equal, full scale together."""
    entry = shot.calibrations.get("tweezers")
    if entry is not None:
        return entry.values["row_amplitudes"], entry.values["column_amplitudes"]
    n_rows, n_cols = shot.grid.shape
    return np.full(n_rows, 1 / n_rows), np.full(n_cols, 1 / n_cols)
