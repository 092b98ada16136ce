"""The closed loop that makes the static tweezers even: measure, correct, measure again."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError
from labseq.imaging.equalising import Equalised, equalise, factors

Floats = NDArray[np.float64]

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
