"""The error that a fitted parameter may have, relative to its value or in its unit."""

from __future__ import annotations

import math
from typing import NamedTuple

from labseq.data.fits import Fit
from labseq.data.numbers import Parameter
from labseq.messages import clean
from labseq.units import dimension_of, parse_any, split_quantity


class ErrorLimit(NamedTuple):
    """The largest acceptable error of a parameter.

    Attributes:
        value: The error in SI. A fraction if it is relative to the parameter's value.
        is_relative: Whether it is relative.
    """

    value: float
    is_relative: bool

    def is_met_by(self, parameter: Parameter) -> bool:
        """Whether a parameter's error is within this limit."""
        return parameter.error <= self.value * (abs(parameter.value) if self.is_relative else 1.0)


def read_limit(written: float | str, unit: str) -> ErrorLimit:
    """Read a limit for a parameter's error, given in per cent of its value or in its unit.

    Args:
        written: The limit as the sequence has it.
        unit: SI unit of the parameter, see :func:`labseq.data.fits.parameter_unit`.

    Raises:
        ValueError: It is neither of the two, or not above 0. The message says why.

    Example:
        >>> read_limit("2 %", "s"), read_limit("0.5 ms", "s")
        (ErrorLimit(value=0.02, is_relative=True), ErrorLimit(value=0.0005, is_relative=False))
    """
    text = str(written)
    number, written_unit = split_quantity(text)
    dimension = "" if dimension_of(unit) == "fraction" else dimension_of(unit)
    if math.isnan(number) or number <= 0:
        raise ValueError(f"'{clean(text)}' is not a valid error")
    if written_unit == "":
        if dimension:
            raise ValueError(f"'{clean(text)}' has no unit")
        return ErrorLimit(number, is_relative=False)
    value, written_dimension = parse_any(text)
    if written_dimension not in ("fraction", dimension):
        raise ValueError(f"'{clean(text)}' does not have the unit of the parameter")
    return ErrorLimit(value, is_relative=written_dimension == "fraction")


def follows(fit: Fit) -> bool:
    """Whether the points have errors and follow the model."""
    # points with a larger reduced chi-square do not follow a model: errors are too small by a factor of 2
    return fit.reduced_chi_square <= 4.0
