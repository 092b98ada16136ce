"""Amplitudes of the static tweezers' tones from the measured powers of their spots.

The spot (i, j) has a power that goes with the tone of row i and the tone of column j:
``P_ij = P f_i g_j (1 + e_ij)``. The factors f and g are the *separable* part, which the tones can
make even; e is the rest, which they cannot, and which is left alone. A light shift serves as
well as a power.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError

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
