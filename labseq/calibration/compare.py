"""Compares two calibrations of the same kind, and shows the deciding figure of a calibration as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from labseq.calibration.quality import DECIDING
from labseq.errors import ConfigError, Problem
from labseq.model import CalibrationEntry, CalibrationKind
from labseq.recording.schema import unit_of
from labseq.units import format_quantity

_DIMENSIONS: Final = {"m": "length", "Hz": "frequency", "rad": "angle", "s": "time"}


@dataclass(frozen=True, slots=True)
class Difference:
    """The difference of a value or a figure of merit between two calibrations.

    Attributes:
        name: Its name.
        unit: "Hz", "m", "px", "rad", "s" or "".
        before: The earlier figure. None for a value with many numbers.
        after: The later figure. None for a value with many numbers.
        greatest: Largest absolute change of any of its numbers. nan if the shapes differ.
        rms: Root mean square of the changes.
        mean: Mean change of each column if the last axis has two, such as (y, x), else of all numbers.
    """

    name: str
    unit: str
    before: float | None
    after: float | None
    greatest: float
    rms: float
    mean: tuple[float, ...]


def compare(before: CalibrationEntry, after: CalibrationEntry) -> tuple[list[Difference], list[Difference]]:
    """Compare two calibrations of one kind.

    Returns:
        The differences of the values, and of the figures of merit that both have.

    Raises:
        ConfigError: They are of different kinds.
    """
    if before.kind != after.kind:
        problem = f"{before.id} is of the kind '{before.kind}', but {after.id} of the kind '{after.kind}'"
        raise ConfigError(Problem(problem, expected="two calibrations of one kind"))
    values = [
        _of_values(name, before.values[name], value)
        for name, value in after.values.items()
        if name in before.values
    ]
    figures = [
        _of_figure(name, before.quality[name], value)
        for name, value in after.quality.items()
        if name in before.quality
    ]
    return values, figures


def _of_values(
    name: str,
    before: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    after: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
) -> Difference:
    if before.shape != after.shape:
        return Difference(name, unit_of(name), None, None, np.nan, np.nan, ())
    change = after - before
    is_pair = change.ndim > 0 and change.shape[-1] == 2
    mean: Sequence[float] = change.reshape(-1, 2 if is_pair else 1).mean(axis=0).tolist()
    greatest, rms = float(np.abs(change).max(initial=0.0)), float(np.sqrt(np.mean(change**2)))
    return Difference(name, unit_of(name), None, None, greatest, rms, tuple(mean))


def _of_figure(name: str, before: float, after: float) -> Difference:
    change = after - before
    return Difference(name, unit_of(name), before, after, abs(change), abs(change), (change,))


def quantity(value: float | None, name: str) -> str:
    """A value with the unit in the suffix of its name, as text.

    Example:
        >>> quantity(2.5e-8, "error_m"), quantity(84.8e6, "row_hz"), quantity(0.031, "residual_px")
        ('25 nm', '84.8 MHz', '0.031 px')
    """
    if value is None or math.isnan(value):
        return "-"
    unit = unit_of(name)
    if unit in _DIMENSIONS:
        return format_quantity(value, _DIMENSIONS[unit], 7 if unit == "Hz" else 3)
    return f"{value:.4g} {unit}".rstrip()


def quality_text(kind: CalibrationKind, quality: Mapping[str, float]) -> str:
    """The deciding figure of a calibration as text, or "-" if it has none."""
    deciding = DECIDING[kind]
    figure = quality.get(deciding.figure, math.nan)
    return "-" if math.isnan(figure) else f"{deciding.label} {quantity(figure, deciding.figure)}"
